"""Take a lens out of the images of a scene, so that all after it are pinholes."""

from __future__ import annotations

from collections.abc import Collection

from flowsplat.common.errors import InputError
from flowsplat.geometry.lens import Lens
from flowsplat.scenes import Scene
from flowsplat.scenes.replacing import replace_images

_FOLLOWS_IMAGES = ("cameras", "masks", "objects")
"""Priors that may be there when images are straightened: cameras are found anew, masks straightened, objects go with depth."""


def describe_lens(lens: Lens) -> str:
    """Return a sentence about a lens that was taken out of the images."""
    k1 = (*lens.distortion.coefficients, 0.0)[0]
    kind = "a fisheye, " if lens.distortion.is_fisheye else ""
    return (
        f"The lens moved points of the border by up to {lens.shift:.1f} pixels ({kind}k1 = {k1:.3f}): "
        "frames and given masks were straightened."
    )


def require_lens_in_images(scene: Scene, cure: str, unwanted: Collection[str] = ()) -> None:
    """Refuse to straighten images that something else was made for.

    Args:
        cure: what to do instead.
        unwanted: priors that are about to be forgotten.

    Raises:
        InputError: names what was made for the images.
    """
    if scene.truth is not None or scene.views:
        raise InputError(f"{scene.name} is rendered by pinholes: {cure}.")
    made = [name for name in scene.info.priors if name not in _FOLLOWS_IMAGES and name not in unwanted]
    if made:
        raise InputError(
            f"{' and '.join(made).capitalize()} of {scene.name} were made for the images as they came: {cure}, or let them be "
            "computed."
        )


def resume_straightening(scene: Scene) -> None:
    """Replace frames and masks by those that a pinhole sees, and note that the cameras are finished; nothing where no lens is
    being taken out (``Scene.begin_straightening``)."""
    if scene.info.straightening is not None:
        lens = scene.lens
        assert lens is not None
        replace_images(scene, lens.straighten)
        scene.finish_straightening(describe_lens(lens))

"""Cameras: structure from motion, the user's, or true ones."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import asdict
from functools import partial
from pathlib import Path

from flowsplat.common.errors import InputError
from flowsplat.common.progress import report
from flowsplat.priors.cameras import CameraOptions, camera_stage
from flowsplat.priors.cameras.stage import OWN, WITHOUT_LENS, straightens
from flowsplat.priors.cameras.straightening import describe_lens, require_lens_in_images, resume_straightening
from flowsplat.priors.given.camera_check import fit_to_images
from flowsplat.priors.given.cameras import read_cameras
from flowsplat.priors.given.fitting import verdict_of
from flowsplat.priors.prior import GIVEN, Kind, PriorRequest
from flowsplat.scenes import Scene
from flowsplat.scenes.layers import Layers

MAKER = "maker of the cameras"
"""Key of ``Request.memory``: whose the given cameras are."""


def _differs(request: PriorRequest, asked: str | None) -> bool:
    """Return whether our own cameras are there, but were computed with other settings than those that differ from the defaults.

    Given, true or calibrated cameras are not replaced: the options say how cameras are computed, and not whether.
    """
    if asked is not None or request.method("cameras") != OWN:
        return False
    used, usual = (request.scene.prior("cameras") or {}).get("options", {}), asdict(CameraOptions())
    return any(value not in (usual[name], used.get(name)) for name, value in asdict(request.options.cameras).items())


def _check_renewal(request: PriorRequest, stale: Collection[str]) -> None:
    """Refuse to replace cameras under what was made for them and stays."""
    method = request.method("depth")
    if method is not None and "depth" not in stale:
        raise InputError(
            f"The depth of {request.scene.name} ({method}) belongs to the cameras that are there, and these options would not make "
            "it anew: start from the clip, or leave out what asks for other cameras."
        )
    if straightens(request.scene, request.options.cameras):
        require_lens_in_images(request.scene, WITHOUT_LENS, stale)


def _read_true(scene: Scene, truth: Layers) -> bool:
    scene.write_cameras(truth.cameras)
    return True


def _read_given(request: PriorRequest, path: Path) -> None:
    scene = request.scene
    given = read_cameras(path, scene, request.options.given.allow_pickle)
    lens, is_straight = given.lens, scene.info.lens is not None
    if is_straight and (lens is None or lens.to_json() != scene.info.lens):
        raise InputError(f"The images of {scene.name} were straightened for another lens than that of {path}. Start from the clip.")
    if lens is not None and not is_straight:
        require_lens_in_images(scene, f"give cameras without a lens instead of {path}")
    cameras, told = fit_to_images(given.cameras, scene, None if is_straight else lens)
    scene.write_cameras(cameras)
    about = "" if lens is None else describe_lens(lens).rstrip(".").replace("The", "the", 1)
    prior = {"method": GIVEN, "verdict": "; ".join(filter(None, (verdict_of(path, given.maker), given.told, told, about)))}
    request.memory[MAKER] = given.maker
    if lens is None or is_straight:
        scene.finish_prior("cameras", **prior)
    else:
        scene.begin_straightening(lens.to_json(), prior)
        resume_straightening(scene)
        report(scene.info.notes[-1])


CAMERAS = Kind(
    compute=lambda request: partial(camera_stage, request.scene, request.options.cameras),
    options=("cameras",),
    files=("cameras.json",),
    own=(OWN,),
    differs=_differs,
    check_renewal=_check_renewal,
    replaces_images=lambda request: straightens(request.scene, request.options.cameras),
    overwrites=True,
    read_true=_read_true,
    asks_truth=lambda request: True,
    read_given=_read_given,
)

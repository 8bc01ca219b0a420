"""The lens of given cameras: one for all frames, which is taken out of the images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.geometry import Camera
from flowsplat.geometry.lens import Distortion, Lens, compute_shift
from flowsplat.scenes.formats.lens import MAX_DISTORTION

MAX_LENS_DIFFERENCE = 1.0
"""Pixels by which the lens of a frame may show a point of the border of the straightened image elsewhere than the common one does,
as ``MAX_DISTORTION``. Chosen by eye."""


def find_lens(path: Path, cameras: Sequence[Camera], distortions: Mapping[int, Distortion]) -> Lens | None:
    """Return the one lens of all frames; None where it bends so little that they count as pinholes.

    Args:
        cameras: one a frame, at its size.
        distortions: of the frames that the file holds.

    Raises:
        InputError: lenses that differ, or one that is none.
    """
    size = cameras[0].width, cameras[0].height
    seen = {(cameras[i].K.tobytes(), distortion): (cameras[i].K, distortion) for i, distortion in distortions.items()}
    lenses = list(seen.values())
    # Written so that NaN is none that is small.
    if all(not distortion.is_fisheye and compute_shift(K, distortion, *size) <= MAX_DISTORTION for K, distortion in lenses):
        return None
    if len({(distortion.is_fisheye, len(distortion.coefficients)) for _, distortion in lenses}) > 1:
        raise InputError(f"{path} describes lenses of several kinds: give cameras with one lens.")
    # Where frames were calibrated one by one, the common lens is that of their medians.
    common = Distortion(
        tuple(np.median([distortion.coefficients for _, distortion in lenses], axis=0).tolist()), lenses[0][1].is_fisheye
    )
    try:
        lens = Lens.of(np.median([K for K, _ in lenses], axis=0), common, *size)
        off = max(lens.compute_difference(K, distortion) for K, distortion in lenses)
    except ValueError as error:
        raise InputError(
            f"{path} describes a lens that cannot be: {error}. Look at k1, k2, ..., or leave the cameras out."
        ) from error
    if not off <= MAX_LENS_DIFFERENCE:
        raise InputError(
            f"{path} describes lenses that differ by {off:.1f} pixels at the border of the images: calibrate all frames with one "
            "lens (in COLMAP, --ImageReader.single_camera 1)."
        )
    return lens

"""A trained scene as the few megabytes that the player unpacks: a header that says what is there, and quantized arrays.

Gaussians at rest come first, then those that move, each part along a space-filling curve, so that neighbors in the file
look alike. Which bits each parameter gets was chosen by the PSNR of the images (docs/formats.md).
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree

from flowsplat.gaussians.confidence_fade import MAX_DIRECTION_DIFFERENCE, MIN_FADE_REACH, reach
from flowsplat.gaussians.gaussians4d import NEAR_PLANE, Gaussians4D
from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.render import FILLED_FROM, FILLED_TO
from flowsplat.geometry import Camera
from flowsplat.geometry.rotations import normalize_quats, principal_axes
from flowsplat.output.player.chebyshev import MIN_LOG_PRECISION, ChebyshevMotion, find_seen_in_clip, fit_motion
from flowsplat.output.player.quantization import (
    QuantizedArray,
    quantize,
    quantize_in_chunks,
    quantize_to_range,
    quantize_to_step,
)
from flowsplat.splatting.harmonics import harmonics_count
from flowsplat.splatting.rules import ALPHA_MAX, ALPHA_MIN, EPS2D

VERSION = 1
CHUNK_GAUSSIANS = 256
"""Gaussians that share a box of positions. Chosen by eye."""
PIXEL_TOLERANCE = 1 / 32
"""Pixels of the clip by which rounding may move a Gaussian. Chosen by eye."""
QUAT_TOLERANCE = 0.004
"""Largest error of the series of a unit quaternion: half a degree."""
_MIN_SCALE, _MAX_SCALE = 1e-5, 1e2
"""Median depths between which the scales of Gaussians are kept, so that their logarithms fit the steps. Round numbers."""
_MAX_LOG_LAMBDA = 18.0
"""Log precision beyond which a Gaussian is seen for less than a ten-thousandth of the clip."""


@dataclass(frozen=True)
class Packed:
    """What goes into the page.

    Attributes:
        about: the header, JSON-able; ``camera_paths`` adds the cameras to it.
        data: the arrays behind one another, zlib-compressed.
    """

    about: dict[str, Any]
    data: bytes


def pack(model: SceneModel, times: Sequence[float], cameras: Sequence[Camera], title: str) -> Packed:
    """Round and compress a scene.

    Args:
        model: the scene.
        times: [T] seconds of the clip's frames.
        cameras: [T] its cameras, in the coordinates of the scene.
        title: name of the clip.
    """
    inner = [model.similarity.camera(camera) for camera in cameras]
    gaussians = model.gaussians.select(torch.nonzero(find_seen_in_clip(model.gaussians)).squeeze(1))
    resting = _along_curve(gaussians, torch.nonzero(gaussians.at_rest).squeeze(1))
    moving = _along_curve(gaussians, torch.nonzero(~gaussians.at_rest).squeeze(1))
    gaussians = gaussians.select(torch.cat([resting, moving]))
    arrays = _arrays(gaussians, len(resting), _resolution(gaussians, inner))
    encoded = [array.encode() for array in arrays]
    about = {
        "version": VERSION, "title": title, "width": cameras[0].width, "height": cameras[0].height,
        "first": model.first, "last": model.last, "frames": len(times), "fill": model.fill,
        "resting": len(resting), "moving": len(moving), "objects": [list(pair) for pair in gaussians.object_counts.items()],
        "shDegree": gaussians.sh_degree, "gains": gaussians.config.gains,
        "pMin": gaussians.config.p_min, "near": NEAR_PLANE, "eps2d": EPS2D, "focal": model.focal,
        "alphaMin": ALPHA_MIN, "alphaMax": ALPHA_MAX, "filledFrom": FILLED_FROM, "filledTo": FILLED_TO,
        "similarity": model.similarity.to_json(), "arrays": [header for header, _ in encoded],
    }  # fmt: skip
    data = zlib.compress(b"".join(body for _, body in encoded), 9)
    return Packed(about, data)


def estimate_bytes(gaussians: Gaussians4D) -> int:
    """Return about how large the packed arrays become as base64, from what was measured on trained scenes."""
    seen = find_seen_in_clip(gaussians)
    resting = int((gaussians.at_rest & seen).sum())
    moving = int(seen.sum()) - resting
    harmonics = 3 * (harmonics_count(gaussians.sh_degree) - 1)
    common = 11.5 + 0.75 * harmonics + 1.5 * gaussians.has_slopes
    return round(4 / 3 * (resting * (common + 0.8 * gaussians.config.gains) + moving * (common + 9.5)))


def _arrays(gaussians: Gaussians4D, resting: int, resolution: np.ndarray) -> list[QuantizedArray]:
    """Return all parameters of Gaussians that are in order, those at rest first."""
    params, degree = gaussians.params, gaussians.sh_degree
    moving = torch.arange(resting, len(gaussians))
    times = quantize_to_range("times", _column(params["times"][moving]), 16, tail=0)
    precisions = gaussians.motion.log_precision(params)[moving].clamp(MIN_LOG_PRECISION, _MAX_LOG_LAMBDA)
    log_lambdas = quantize_to_range("logLambdas", _column(precisions), 16, tail=0)
    step = float(np.quantile(resolution, 0.1)) if len(resolution) else 1.0
    motion = fit_motion(
        gaussians, moving, torch.from_numpy(times.values[:, 0]), torch.from_numpy(log_lambdas.values[:, 0]), step,
        QUAT_TOLERANCE,
    )  # fmt: skip
    rest_quats, rest_scales = _at_rest(gaussians, resting)
    means = torch.cat([params["means"][:resting], motion.means[:, 0]])
    quats = torch.cat([rest_quats, motion.quats[:, 0]])
    log_scales = torch.cat([rest_scales, motion.log_scales]).clamp(np.log(_MIN_SCALE), np.log(_MAX_SCALE))
    sh = params["sh"][:, : harmonics_count(degree)].numpy()
    arrays = [
        quantize_in_chunks("means", means.numpy(), resolution, CHUNK_GAUSSIANS),
        quantize("quats", quats.numpy(), 8, -1.0, 1.0),
        quantize_to_range("logScales", log_scales.numpy(), 8, tail=0),
        quantize("opacities", _column(torch.sigmoid(params["logit_opacities"])), 8, 0.0, 1.0),
        quantize_to_range("colors", sh[:, 0], 8),
    ]
    if degree:
        arrays.append(quantize_to_range("harmonics", sh[:, 1:].reshape(len(sh), -1), 8))
    if gaussians.has_slopes:
        arrays.append(quantize_to_range("slopes", params["slopes"].numpy(), 8))
    if gaussians.config.gains:
        arrays.append(quantize_to_range("gains", params["log_gains"][:resting].numpy(), 8))
    if gaussians.object_ids.any():
        arrays.append(quantize("object_ids", _column(gaussians.object_ids), 8, 0.0, 255.0))
    if gaussians.seen is not None:
        reaches = torch.log(reach(gaussians.seen[:resting])).clamp(np.log(MIN_FADE_REACH), np.log(MAX_DIRECTION_DIFFERENCE))
        arrays.append(quantize("logReaches", _column(reaches), 8, np.log(MIN_FADE_REACH), np.log(MAX_DIRECTION_DIFFERENCE)))
    return [*arrays, times, log_lambdas, *_motion_arrays(motion, step)]


def _motion_arrays(motion: ChebyshevMotion, step: float) -> list[QuantizedArray]:
    means, quats = motion.means[:, 1:], motion.quats[:, 1:]
    return [
        # In boxes, too: what crosses the image between two frames goes further than 16 bits of such steps.
        quantize_in_chunks("meanCoefficients", means.flatten(1).numpy(), np.full(len(means), step), CHUNK_GAUSSIANS),
        quantize_to_step("quatCoefficients", quats.flatten(1).numpy(), QUAT_TOLERANCE),
    ]


def _at_rest(gaussians: Gaussians4D, resting: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return rotations [R, 4] with w >= 0 and log scales [R, 3] of the first ones."""
    params = {name: value[:resting] for name, value in gaussians.params.items()}
    shape, kept = gaussians.motion.at_rest(params), gaussians.motion.log_scales(params)
    if shape.covars is not None:
        quats, log_scales = principal_axes(shape.covars)
    else:
        assert shape.quats is not None
        assert shape.scales is not None
        quats, log_scales = normalize_quats(shape.quats), torch.log(shape.scales) if kept is None else kept
    return torch.where(quats[:, :1] < 0, -quats, quats), log_scales


def _column(values: torch.Tensor) -> np.ndarray:
    return values.numpy()[:, None]


def _resolution(gaussians: Gaussians4D, cameras: Sequence[Camera]) -> np.ndarray:
    """Return [N] the distance in the scene that is ``PIXEL_TOLERANCE`` in the nearest camera."""
    tree = cKDTree(np.array([camera.center for camera in cameras]))
    distance = tree.query(gaussians.params["means"].numpy())[0]
    focal = max(camera.K[0, 0] for camera in cameras)
    return PIXEL_TOLERANCE / focal * np.maximum(distance, NEAR_PLANE)


def _along_curve(gaussians: Gaussians4D, rows: torch.Tensor) -> torch.Tensor:
    """Return rows in the order of a Morton curve through the ranks of their coordinates, which no outlier can stretch."""
    means = gaussians.params["means"][rows].numpy()
    code = np.zeros(len(means), np.int64)
    for axis in range(3):
        ranks = np.empty(len(means), np.int64)
        ranks[np.argsort(means[:, axis], kind="stable")] = np.arange(len(means))
        cells = ranks * 1024 // max(len(means), 1)
        for bit in range(10):
            code |= ((cells >> bit) & 1) << (3 * bit + axis)
    return rows[torch.from_numpy(np.argsort(code, kind="stable"))]

"""A trained scene as the few megabytes that the player unpacks: a header that says what is there, and quantized arrays.

Gaussians at rest come first, then those that move, each part along a space-filling curve, so that neighbors in the file
look alike. How coarsely each parameter may be rounded follows from how much the images of the clip change with it: neighbors share
a step, and what all of them cost the images together is measured: ``MIN_PSNR`` (docs/formats.md).
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree

from flowsplat.common.progress import report
from flowsplat.common.spread import spread
from flowsplat.gaussians.confidence_fade import MAX_DIRECTION_DIFFERENCE, MIN_FADE_REACH, reach
from flowsplat.gaussians.flow import blend_features
from flowsplat.gaussians.gaussians4d import NEAR_PLANE, Gaussians4D
from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.render import FILLED_FROM, FILLED_TO, render
from flowsplat.gaussians.slicing import Slice
from flowsplat.gaussians.slopes import image_slopes
from flowsplat.geometry import Camera
from flowsplat.geometry.morton import order_along_curve
from flowsplat.geometry.rotations import normalize_quats, principal_axes
from flowsplat.output.page_reader import PageScene
from flowsplat.output.player.chebyshev import MIN_LOG_PRECISION, find_seen_in_clip, fit_motion
from flowsplat.output.player.quantization import QuantizedArray, means_of_chunks, quantize, quantize_in_chunks, round_steps
from flowsplat.output.player.sensitivity import Sensitivity, measure_sensitivity
from flowsplat.splatting import blend, project
from flowsplat.splatting.harmonics import colors_from_harmonics, harmonics_count
from flowsplat.splatting.rules import ALPHA_MAX, ALPHA_MIN, EPS2D

VERSION = 2
CHUNK_GAUSSIANS = 256
"""Gaussians that share their steps. Chosen by eye."""
MIN_PSNR = 45.0
"""dB between images of the clip before and after rounding, at least, of those that are looked at together (docs/formats.md)."""
ROUNDING_PSNR = 44.5
"""dB that are asked for first, were images to change in proportion to what is rounded: enough for bear (docs/formats.md)."""
_CHECKED_VIEWS, _MAX_TRIES, _PSNR_MARGIN = 3, 4, 0.5
"""Images that are looked at, how often steps are chosen, and dB that are asked for beyond what is missing. Chosen by eye."""
_BLOCK_LEVEL = 6
"""Of zlib's memory: 16 thousand numbers share a code. Bear takes 17.39 bytes a Gaussian with 6, 17.42 with 5, 17.45 with 7."""
MAX_STEPS = {
    "quats": 0.2, "logScales": 0.4, "opacities": 0.2, "colors": 1.0, "harmonics": 1.0, "slopes": 1.0, "gains": 0.3,
    "logLambdas": 0.4,
}  # fmt: skip
"""Steps beyond which images change otherwise than in proportion, or a view that nobody has measured would suffer. Chosen by eye."""
MAX_SHIFT, MAX_DELAY = 0.5, 0.25
"""Likewise of positions, in standard deviations of the neighbors, and of times, in those of their presence. Chosen by eye."""
PIXEL_TOLERANCE = 1 / 32
"""Pixels of the clip by which a series may be off. Chosen by eye."""
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
    views = [(camera, model.clip_time(seconds)) for camera, seconds in zip(inner, times, strict=True)]
    sensitivity = measure_sensitivity(gaussians, views)
    about = {
        "version": VERSION, "title": title, "width": cameras[0].width, "height": cameras[0].height,
        "first": model.first, "last": model.last, "frames": len(times), "fill": model.fill,
        "resting": len(resting), "moving": len(moving), "objects": [list(pair) for pair in gaussians.object_counts.items()],
        "shDegree": gaussians.sh_degree, "gains": gaussians.config.gains,
        "pMin": gaussians.config.p_min, "near": NEAR_PLANE, "eps2d": EPS2D, "focal": model.focal,
        "alphaMin": ALPHA_MIN, "alphaMax": ALPHA_MAX, "filledFrom": FILLED_FROM, "filledTo": FILLED_TO,
        "similarity": model.similarity.to_json(),
    }  # fmt: skip
    resolution, asked = _resolution(gaussians, inner), ROUNDING_PSNR
    checked = [(views[k], times[k]) for k in spread(len(views), _CHECKED_VIEWS)]
    truth = [render(gaussians, *view).color for view, _ in checked]
    for _ in range(_MAX_TRIES):
        arrays = _arrays(gaussians, len(resting), resolution, sensitivity, asked)
        rounded = PageScene(about, {array.name: array.values for array in arrays})
        images = [draw_page(rounded, camera, seconds) for (camera, _), seconds in checked]
        found = _measure_psnr(torch.stack(images), torch.stack(truth))
        if found >= MIN_PSNR:
            break
        # What images change by out of proportion: whose turn it is to be in front, above all.
        asked += MIN_PSNR - found + _PSNR_MARGIN
    else:
        report(f"The page's images are {found:.1f} dB from those of the scene, less than the {MIN_PSNR:.0f} that are asked for.")
    encoded = [array.encode() for array in arrays]
    about["arrays"] = [header for header, _ in encoded]
    # Neighbors are hardly ever equal: what counts are short blocks, each with a code of its own for its numbers.
    compressor = zlib.compressobj(9, zlib.DEFLATED, zlib.MAX_WBITS, _BLOCK_LEVEL, zlib.Z_FILTERED)
    data = compressor.compress(b"".join(body for _, body in encoded)) + compressor.flush()
    return Packed(about, data)


def draw_page(scene: PageScene, camera: Camera, seconds: float) -> torch.Tensor:
    """Return [H, W, 3] of a scene as a page holds it, uncovered pixels black; the camera is in normalized coordinates."""
    still = scene.at(seconds)
    means, quats, scales, opacities = map(torch.from_numpy, (still.means, still.quats, still.scales, still.opacities))
    directions = means - torch.as_tensor(camera.center, dtype=torch.float32)
    colors = colors_from_harmonics(torch.from_numpy(still.sh), directions, scene.header["shDegree"])
    colors = colors * torch.from_numpy(still.gains)[:, None]
    slopes = torch.from_numpy(np.ascontiguousarray(scene.slopes)) if "slopes" in scene.arrays else None
    size = camera.width, camera.height
    projected = project(means, quats, scales, opacities, *camera.tensors(), *size, near_plane=NEAR_PLANE)
    sliced = Slice(means, quats, scales, None, opacities, colors, means[:0], None, None, slopes)
    # With depth, as images are rendered: kernels of as many features are compiled already.
    features = blend_features(sliced, projected, camera, None)
    return blend(projected, opacities, features, *size, slopes=image_slopes(sliced, projected, camera))[0][..., :3]


def _measure_psnr(images: torch.Tensor, truth: torch.Tensor) -> float:
    return -10 * math.log10(float(((images.clamp(0, 1) - truth.clamp(0, 1)) ** 2).mean()) + 1e-12)


def estimate_bytes(gaussians: Gaussians4D) -> int:
    """Return about how large the packed arrays become as text, from what was measured on trained scenes."""
    seen = find_seen_in_clip(gaussians)
    resting = int((gaussians.at_rest & seen).sum())
    moving = int(seen.sum()) - resting
    harmonics = 3 * (harmonics_count(gaussians.sh_degree) - 1)
    common = 8.5 + 0.05 * harmonics + 1.3 * gaussians.has_slopes
    return round(8 / 7 * (resting * (common + 0.47 * gaussians.config.gains) + moving * (common + 7.3)))


def _arrays(
    gaussians: Gaussians4D, resting: int, resolution: np.ndarray, sensitivity: Sensitivity, psnr: float
) -> list[QuantizedArray]:
    """Return all parameters of Gaussians that are in order, those at rest first, rounded so that images have about ``psnr`` dB."""
    params, moving = gaussians.params, torch.arange(resting, len(gaussians))
    sums = {name: value.numpy() for name, value in sensitivity.sums.items()}
    numbers = sum(value.shape[1] for value in sums.values()) * len(gaussians)
    rounding = _Rounding(sums, 10 ** (-psnr / 10) * sensitivity.numbers / max(numbers, 1))
    precisions = gaussians.motion.log_precision(params)[moving].clamp(MIN_LOG_PRECISION, _MAX_LOG_LAMBDA)
    log_lambdas = rounding.quantize("logLambdas", _column(precisions), resting)
    delays = MAX_DELAY * np.exp(means_of_chunks(-0.5 * log_lambdas.values, CHUNK_GAUSSIANS))
    times = rounding.quantize("times", _column(params["times"][moving]), resting, most=delays)
    tolerance = float(np.quantile(resolution, 0.1)) if len(resolution) else 1.0
    motion = fit_motion(
        gaussians, moving, torch.from_numpy(times.values[:, 0]), torch.from_numpy(log_lambdas.values[:, 0]), tolerance,
        QUAT_TOLERANCE,
    )  # fmt: skip
    rest_quats, rest_scales = _at_rest(gaussians, resting)
    means = torch.cat([params["means"][:resting], motion.means[:, 0]])
    quats = torch.cat([rest_quats, motion.quats[:, 0]])
    log_scales = torch.cat([rest_scales, motion.log_scales]).clamp(np.log(_MIN_SCALE), np.log(_MAX_SCALE)).numpy()
    sh = params["sh"][:, : harmonics_count(gaussians.sh_degree)].numpy()
    shifts, moving_shifts = (
        MAX_SHIFT * np.exp(means_of_chunks(each.mean(1, keepdims=True), CHUNK_GAUSSIANS))
        for each in (log_scales, log_scales[resting:])
    )
    arrays = [
        rounding.quantize("means", means.numpy(), most=shifts),
        rounding.quantize("quats", quats.numpy()),
        rounding.quantize("logScales", log_scales),
        rounding.quantize("opacities", _column(torch.sigmoid(params["logit_opacities"]))),
        rounding.quantize("colors", sh[:, 0]),
    ]
    if gaussians.sh_degree:
        arrays.append(rounding.quantize("harmonics", sh[:, 1:].reshape(len(sh), 3 * (sh.shape[1] - 1))))
    if gaussians.has_slopes:
        arrays.append(rounding.quantize("slopes", params["slopes"].numpy()))
    if gaussians.config.gains:
        arrays.append(rounding.quantize("gains", params["log_gains"][:resting].numpy()))
    if gaussians.object_ids.any():
        arrays.append(quantize("object_ids", _column(gaussians.object_ids), 1.0))
    if gaussians.seen is not None:
        reaches = torch.log(reach(gaussians.seen[:resting])).clamp(np.log(MIN_FADE_REACH), np.log(MAX_DIRECTION_DIFFERENCE))
        arrays.append(quantize("logReaches", _column(reaches), np.log(MAX_DIRECTION_DIFFERENCE / MIN_FADE_REACH) / 255))
    return [
        *arrays, times, log_lambdas,
        rounding.quantize("meanCoefficients", motion.means[:, 1:].flatten(1).numpy(), resting, "means", moving_shifts),
        rounding.quantize("quatCoefficients", motion.quats[:, 1:].flatten(1).numpy(), resting, "quats"),
    ]  # fmt: skip


@dataclass(frozen=True)
class _Rounding:
    """Choose steps: each number that is stored may cost the images as much as any other.

    Attributes:
        sums: [N, components] of ``Sensitivity``, by name, of the Gaussians in their order.
        cost: sum of squared differences that the images may have for each number.
    """

    sums: dict[str, np.ndarray]
    cost: float

    def quantize(
        self, name: str, values: np.ndarray, start: int = 0, of: str | None = None, most: np.ndarray | float | None = None
    ) -> QuantizedArray:
        """Quantize values [count, components].

        Args:
            name: of the array.
            values: of the Gaussians from number ``start`` on, ``count`` of them.
            start: see there.
            of: the name in ``sums`` of a parameter of which these are coefficients of Chebyshev polynomials from degree 1 on, whose
                squares are 1/2 on average; None = the values are those of ``name``.
            most: [chunks, 1] or one number, the largest step; None = that of ``MAX_STEPS``.
        """
        sums = self.sums[of or name][start : start + len(values)]
        if of is not None:
            sums = np.tile(sums / 2, (1, values.shape[1] // sums.shape[1]))
        # A step s moves a value by s^2 / 12 on average of squares.
        steps = np.sqrt(12 * self.cost / np.maximum(means_of_chunks(sums, CHUNK_GAUSSIANS), 1e-30))
        steps = np.minimum(steps, MAX_STEPS[of or name] if most is None else most)
        return quantize_in_chunks(name, values, round_steps(steps), CHUNK_GAUSSIANS)


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
    """Return rows in the order in which neighbors follow each other."""
    return rows[torch.from_numpy(order_along_curve(gaussians.params["means"][rows].numpy()))]

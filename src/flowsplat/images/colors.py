"""Numbers to colors: the optical flow wheel, depth, error. Images in and out are RGB."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

# The wheel of Baker et al., "A Database and Evaluation Methodology for Optical Flow" (IJCV 2011), appendix: six arcs of
# unequal length, so that steps in direction look about equally large. Closed here, where the usual code leaves out the
# last of the 55 steps and jumps at the right. https://vision.middlebury.edu/flow/
_ARCS = np.array([0, 15, 6, 4, 11, 13, 6])
_CORNERS = np.array([[255, 0, 0], [255, 255, 0], [0, 255, 0], [0, 255, 255], [0, 0, 255], [255, 0, 255], [255, 0, 0]], np.float32)
_HUE_COUNT = 3600
"""Colors of the wheel: a tenth of a degree each."""
_BEYOND_SCALE = 0.75
"""Factor on the colors of vectors beyond the scale, as in Baker et al. 2011 (Middlebury's color coding of flow)."""
_OBJECTS = np.array([(255, 128, 0), (0, 190, 255), (255, 60, 160), (120, 220, 40), (180, 110, 255), (255, 220, 0)], np.uint8)
"""Colors of moving objects, by their numbers."""
"""How much displacements beyond the scale are darkened."""

MIN_FLOW_SCALE = 0.5
"""Pixels. Below this, a clip at rest would show nothing but noise in bright colors. Chosen by eye."""


def _wheel() -> np.ndarray:
    """Return [_HUE_COUNT, 3] float32 colors between 0 and 1 round the wheel, starting at the right and going down."""
    places = np.cumsum(_ARCS) / _ARCS.sum()
    turn = np.arange(_HUE_COUNT) / _HUE_COUNT
    return np.stack([np.interp(turn, places, _CORNERS[:, c]) for c in range(3)], -1).astype(np.float32) / 255


_WHEEL = _wheel()


def float_to_bytes(image: np.ndarray) -> np.ndarray:
    """Return numbers between 0 and 1 to uint8, rounded and clipped; what is not a number becomes 0. uint8 stays as it is."""
    if image.dtype == np.uint8:
        return image
    return (np.clip(np.nan_to_num(image), 0, 1) * 255 + 0.5).astype(np.uint8)


def flow_scale(flows: Iterable[np.ndarray]) -> float:
    """Pixels: a scale under which nearly all of the given flows [H, W, 2] keep their full color."""
    scale = MIN_FLOW_SCALE
    for flow in flows:
        length = np.linalg.norm(flow, axis=-1)
        length = length[np.isfinite(length)]
        scale = max(scale, float(np.percentile(length, 99)) if length.size else 0.0)
    return scale


def flow_to_color(flow: np.ndarray, scale: float | None = None) -> np.ndarray:
    """Convert flow to the usual colors: hue is direction (right red, down yellow, left cyan, up violet), white is rest.

    Args:
        flow: [H, W, 2] pixels. What is not finite becomes black.
        scale: the length in pixels that gets the full color, longer ones are darker; None = ``flow_scale`` of this flow.

    Returns:
        [H, W, 3] uint8 RGB.
    """
    x, y = (np.ascontiguousarray(flow[..., d], np.float32) for d in range(2))
    lost = ~(np.isfinite(x) & np.isfinite(y))
    if lost.any():
        x, y = np.where(lost, 0, x), np.where(lost, 0, y)
    length = np.sqrt(x * x + y * y)
    length /= np.float32(flow_scale([flow]) if scale is None else scale)
    hue = (np.arctan2(y, x) * np.float32(_HUE_COUNT / (2 * np.pi))).astype(np.int32)
    hue[hue < 0] += _HUE_COUNT
    hue[hue >= _HUE_COUNT] = 0
    color = _WHEEL.take(hue, 0)
    far = length > 1
    beyond = _BEYOND_SCALE * color[far]
    color -= 1
    color *= length[..., None]
    color += 1
    color[far] = beyond
    color[lost] = 0
    color *= 255
    color += np.float32(0.5)
    return color.astype(np.uint8)


def flow_legend(size: int = 96) -> np.ndarray:
    """Return [size, size, 3] uint8: the wheel, the displacement of every pixel drawn where it leads to; white outside."""
    ramp = (np.arange(size, dtype=np.float32) + 0.5) / size * 2 - 1
    offsets = np.stack(np.meshgrid(ramp, ramp), -1)
    legend = flow_to_color(offsets, 1.0)
    legend[np.linalg.norm(offsets, axis=-1) > 1] = 255
    return legend


def depth_range(depths: Iterable[np.ndarray]) -> tuple[float, float]:
    """Return (near, far) round nearly all of the given depths [H, W]; depths that are not positive do not count."""
    near, far = np.inf, 0.0
    for depth in depths:
        seen = depth[np.isfinite(depth) & (depth > 0)]
        if seen.size:
            low, high = np.percentile(seen, (1, 99))
            near, far = min(near, float(low)), max(far, float(high))
    return (near, far) if far > 0 else (1.0, 2.0)


def depth_to_color(depth: np.ndarray, near: float, far: float) -> np.ndarray:
    """Return planar depth [H, W] to [H, W, 3] uint8: the turbo colors on inverse depth, near red, far blue.

    Black where depth is not positive and finite.
    """
    seen = np.isfinite(depth) & (depth > 0)
    inverse = 1 / np.where(seen, depth, far)
    place = (inverse - 1 / far) / max(1 / near - 1 / far, 1e-12)
    color = cv2.applyColorMap(float_to_bytes(place), cv2.COLORMAP_TURBO)[..., ::-1].copy()
    color[~seen] = 0
    return color


def error_to_color(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the mean absolute difference of two images (uint8, or float between 0 and 1) as [H, W, 3] uint8 heat.

    Black is equal, pale yellow a quarter or more (1 = black against white).
    """
    difference = np.abs(float_to_bytes(a).astype(np.float32) - float_to_bytes(b)).mean(-1) / 255
    return cv2.applyColorMap(float_to_bytes(difference / 0.25), cv2.COLORMAP_INFERNO)[..., ::-1].copy()


def object_color(number: int) -> tuple[int, int, int]:
    """Red, green and blue of a moving object, as in ``tint``."""
    red, green, blue = _OBJECTS[(number - 1) % len(_OBJECTS)]
    return int(red), int(green), int(blue)


def tint(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the image [H, W, 3] uint8 in gray, moving objects tinted by their numbers in ``mask`` [H, W] (0 = background)."""
    gray = np.repeat(image.mean(-1, keepdims=True) * 0.8, 3, -1)
    colored = 0.45 * image + 0.55 * _OBJECTS[(mask.astype(int) - 1) % len(_OBJECTS)]
    return np.where(mask[..., None] > 0, colored, gray).astype(np.uint8)

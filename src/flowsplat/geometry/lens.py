"""Lenses that bend images, in OpenCV's models, and the pinholes that see their straightened images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from flowsplat.geometry.cameras import Camera, pixel_grid

MIN_LENS_SLOPE = 0.1
"""How fast a point of the straightened image must at least leave the middle of the one it is taken from: for a fisheye, up to 72
degrees from its axis. Chosen by eye."""
MIN_ZOOM, MAX_ZOOM = 0.25, 4.0
"""Focal lengths of straightened images, in that of the images as they came, between which one is searched. Chosen by eye."""
_HALF = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
"""OpenCV counts pixels from the center of the first one."""
_UNTIL = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-10)
"""When OpenCV's search for a straightened position ends: steps, or what is left at focal length 1."""


@dataclass(frozen=True)
class Distortion:
    """How a lens bends images (https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html).

    Attributes:
        coefficients: k1, k2, p1, p2, then k3, or k3 to k6, as OpenCV orders them; of a fisheye k1 to k4 of the angle. None = 0.
        is_fisheye: whether it is one (OpenCV's ``fisheye``), which bends images without coefficients, too.
    """

    coefficients: tuple[float, ...] = ()
    is_fisheye: bool = False

    @property
    def array(self) -> np.ndarray:
        """[4, 5 or 8] float64."""
        return np.array(self.coefficients or (0.0,) * 4, np.float64)

    def bend(self, x: np.ndarray) -> np.ndarray:
        """Return where the lens shows points [..., 2] = (X/Z, Y/Z), at focal length 1."""
        flat = x.reshape(-1, 2)
        points = np.concatenate([flat, np.ones((len(flat), 1))], 1)[:, None]
        project = cv2.fisheye.projectPoints if self.is_fisheye else cv2.projectPoints
        shown, _ = project(points, np.zeros(3), np.zeros(3), np.eye(3), self.array)
        return shown.reshape(x.shape)

    def straighten(self, x: np.ndarray) -> np.ndarray:
        """Return the inverse of ``bend``; NaN stays, and is what the lens shows of nothing."""
        flat = x.reshape(-1, 1, 2).astype(np.float64)
        if not flat.size:
            return x
        if self.is_fisheye:
            found = cv2.fisheye.undistortPoints(flat, np.eye(3), self.array, criteria=_UNTIL)
        else:
            found = cv2.undistortImagePoints(flat, np.eye(3), self.array, None, _UNTIL)
        is_inverse = np.abs(self.bend(found) - flat).max(-1, keepdims=True) < 1e-6
        return np.where(is_inverse, found, np.nan).reshape(x.shape)


def compute_shift(K: np.ndarray, distortion: Distortion, width: float, height: float) -> float:
    """Return the pixels by which a lens moves a point of the border of an image of this size, at most."""
    focals, middle = K[[0, 1], [0, 1]], K[:2, 2]
    with np.errstate(all="ignore"):  # whoever reads lenses looks whether they are finite
        x = (_border(width, height) - middle) / focals
        return float(np.linalg.norm((distortion.bend(x) - x) * focals, axis=1).max())


@dataclass(frozen=True)
class Lens:
    """A lens, and the pinhole on its axis that sees the part of its image that has no blank border.

    Attributes:
        K: [3, 3] in pixels of the images as they came, whose first pixel has its center at (0.5, 0.5).
        distortion: how it bends them.
        zoom: focal length of the straightened images, in that of the others.
        width, height: pixels of both.
    """

    K: np.ndarray
    distortion: Distortion
    zoom: float
    width: float
    height: float

    @staticmethod
    def of(K: np.ndarray, distortion: Distortion, width: float, height: float) -> Lens:
        """Return one with the shortest focal length whose image lies within the bent one.

        Raises:
            ValueError: there is none.
        """
        lens = Lens(np.asarray(K, np.float64), distortion, 1.0, width, height)
        low, high = MIN_ZOOM, MAX_ZOOM
        if not lens._fills_image(high):
            raise ValueError("no pinhole sees a part of its image")
        for _ in range(50):
            middle = (low + high) / 2
            low, high = (low, middle) if lens._fills_image(middle) else (middle, high)
        return replace(lens, zoom=high)

    def _fills_image(self, zoom: float) -> bool:
        """Return whether all that a pinhole with this focal length sees is in the bent image, each point in a place of its own."""
        with np.errstate(all="ignore"):
            x = (_border(self.width, self.height) - self._middle) / (self._focals * zoom)
            shown = self.distortion.bend(x) * self._focals + self._middle
            # Where a strong barrel would fold back, a point of the image has no place of its own.
            along = np.linspace(0.125, 1, 8)[:, None, None] * x
            step = self.distortion.bend(1.001 * along) - self.distortion.bend(0.999 * along)
            unfolded = (step * along).sum(-1) > 0.002 * MIN_LENS_SLOPE * (along**2).sum(-1)
            return bool((shown >= 0).all() and (shown <= [self.width, self.height]).all() and unfolded.all())

    @property
    def _focals(self) -> np.ndarray:
        return self.K[[0, 1], [0, 1]]

    @property
    def _middle(self) -> np.ndarray:
        return self.K[:2, 2]

    @property
    def pinhole(self) -> np.ndarray:
        """[3, 3] K of the straightened images."""
        return self.K * np.array([[self.zoom, self.zoom, 1], [self.zoom, self.zoom, 1], [1, 1, 1]])

    @property
    def shift(self) -> float:
        """Pixels by which the lens moves a point of the border, at most."""
        return compute_shift(self.K, self.distortion, self.width, self.height)

    def scale(self, factor: float) -> Lens:
        """Return the same for images that are larger by ``factor``."""
        K = np.diag([factor, factor, 1]) @ self.K
        return replace(self, K=K, width=self.width * factor, height=self.height * factor)

    def compute_difference(self, K: np.ndarray, distortion: Distortion) -> float:
        """Return the pixels between where this lens and another one, with the same zoom, show the border of the straightened image,
        at most."""
        lenses, border = (self, replace(self, K=K, distortion=distortion)), _border(self.width, self.height)
        with np.errstate(all="ignore"):
            rays = ((border - lens._middle) / (lens._focals * lens.zoom) for lens in lenses)
            one, two = (lens.distortion.bend(x) * lens._focals + lens._middle for lens, x in zip(lenses, rays, strict=True))
            return float(np.linalg.norm(one - two, axis=1).max())

    def straighten_camera(self, camera: Camera) -> Camera:
        """Return the pinhole that sees the straightened image of a camera with this lens."""
        return replace(camera, K=replace(self, K=camera.K).pinhole)

    def straighten_positions(self, positions: np.ndarray) -> np.ndarray:
        """Return points [..., 2] in pixels of the images as they came, as they lie in the straightened ones; NaN stays."""
        straight = self.distortion.straighten((positions - self._middle) / self._focals)
        return straight * (self._focals * self.zoom) + self._middle

    def straighten(self, image: np.ndarray) -> np.ndarray:
        """Return an image [H, W, 3] as the pinhole sees it; values of a map [H, W], object numbers or depth, stay what they are."""
        return self._resample(image, cv2.INTER_NEAREST if image.ndim == 2 else cv2.INTER_CUBIC)

    def _resample(self, image: np.ndarray, method: int) -> np.ndarray:
        make_map = cv2.fisheye.initUndistortRectifyMap if self.distortion.is_fisheye else cv2.initUndistortRectifyMap
        size = round(self.width), round(self.height)
        pinhole = self.pinhole - _HALF
        source = make_map(self.K - _HALF, self.distortion.array, np.eye(3), pinhole, size, cv2.CV_32FC1)
        return cv2.remap(image, *source, method, borderMode=cv2.BORDER_REPLICATE)

    def straighten_flow(self, flow: np.ndarray, confidence: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return flow [H, W, 2] in pixels and its confidence [H, W] between straightened images, 0 where it leaves them."""
        grid = pixel_grid(round(self.width), round(self.height))
        # That of the nearest pixel, from center to end: borders of objects stay sharp.
        nearest = self._resample(np.concatenate([grid, grid + flow], -1), cv2.INTER_NEAREST)
        found = self.straighten_positions(nearest[..., 2:]) - self.straighten_positions(nearest[..., :2])
        ends = grid + found
        inside = ((ends >= 0) & (ends <= [self.width, self.height])).all(-1)
        return np.where(inside[..., None], found, 0).astype(np.float32), np.where(inside, self.straighten(confidence), 0)

    def to_json(self) -> dict[str, Any]:
        """Return plain numbers and lists."""
        return {
            "K": self.K.tolist(), "distortion": list(map(float, self.distortion.coefficients)),
            "is_fisheye": self.distortion.is_fisheye, "zoom": float(self.zoom),
            "width": float(self.width), "height": float(self.height),
        }  # fmt: skip

    @staticmethod
    def from_json(values: Mapping[str, Any]) -> Lens:
        """Return the inverse of ``to_json``.

        Raises:
            KeyError, TypeError, ValueError: it is no lens.
        """
        K = np.array(values["K"], np.float64).reshape(3, 3)
        distortion = Distortion(tuple(map(float, values["distortion"])), bool(values["is_fisheye"]))
        return Lens(K, distortion, *(float(values[name]) for name in ("zoom", "width", "height")))


def _border(width: float, height: float) -> np.ndarray:
    """Return points [N, 2] of the border of an image."""
    side = np.linspace(0, 1, 33)
    edge = np.concatenate([np.stack([side, 0 * side + end], 1) for end in (0, 1)])
    return np.concatenate([edge, edge[:, ::-1]]) * [width, height]

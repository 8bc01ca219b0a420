"""Refine the pose of a held-out image by comparing the image with a model that stays as it is.

Strict figures use the camera that the camera stage found. Half a pixel of shift costs a good image several decibels
(docs/method/evaluation.md),
so figures with the pose of the held-out image alone refined tell what is the cameras' fault. They are never the headline.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from flowsplat.evaluation.metrics import psnr
from flowsplat.gaussians.gaussians4d import NEAR_PLANE, Gaussians4D
from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.slicing import slice_gaussians
from flowsplat.gaussians.slopes import image_slopes
from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import pixel_grid
from flowsplat.scenes.clip import resize_image
from flowsplat.splatting import blend, project

PYRAMID_LEVELS = ((3, 10), (1, 5))
"""By how much the image is shrunk, and how many steps are taken then: coarse first, because steps see no farther than texture.
Chosen by eye."""

MIN_SIDE = 24
"""Pixels below which a shrunk image tells nothing. Chosen by eye."""

MIN_GAIN = 2e-3
"""A step that lowers the error by a smaller share ends a level: that is a hundredth of a decibel."""


def refine_camera(model: SceneModel, camera: Camera, t: float, target: np.ndarray) -> Camera:
    """Return the camera near ``camera`` from which the model looks most like the image; only the pose is changed.

    Damped Gauss-Newton steps on the squared error. Its gradient comes through the rasterizer, the curvature from the rendered
    image's own gradients and depth, as in direct image alignment (Lucas and Kanade 1981); pixels that the model does not cover do
    not count.

    Args:
        model: the scene; it is not changed.
        camera: where to start, in the coordinates of the scene's cameras.
        t: seconds of the clip.
        target: [H, W, 3] float between 0 and 1, of the camera's size.

    Returns:
        the refined camera, or ``camera`` itself where the image would not get better.
    """
    clip_time, start = model.clip_time(t), model.similarity.camera(camera)
    found = start
    for shrink, steps in PYRAMID_LEVELS:
        size = round(camera.width / shrink), round(camera.height / shrink)
        if min(size) >= MIN_SIDE:
            image = resize_image(np.asarray(target, np.float32), size)
            # What a shrunk image says may be worse than where it started: small Gaussians are drawn wider there.
            starts = [start.resize(*size)] if found is start else [start.resize(*size), found.resize(*size)]
            moved = _descend(model.gaussians, starts, clip_time, image, steps)
            found = Camera(moved.viewmat, start.K, camera.width, camera.height)
    refined = model.similarity.inverse().camera(found)
    before, after = (psnr(model.render(each, t).color, target) for each in (camera, refined))
    return refined if before is not None and after is not None and after > before else camera


@dataclass(frozen=True)
class _Look:
    """An image from a camera, compared with its target: the squared error, its gradient [6] and curvature [6, 6] by the twist."""

    error: float
    gradient: np.ndarray
    curvature: np.ndarray


def _descend(gaussians: Gaussians4D, starts: Sequence[Camera], t: float, target: np.ndarray, steps: int) -> Camera:
    """At most ``steps`` steps from the best of some cameras, none of which makes the error larger.

    Args:
        starts: in normalized coordinates.
        t: in clip units.
    """
    looks = [_look(gaussians, camera, t, target) for camera in starts]
    best = min(range(len(starts)), key=lambda k: looks[k].error)
    camera, look, damping = starts[best], looks[best], 1e-3
    for _ in range(steps):
        diagonal = np.diag(look.curvature)
        if not diagonal.sum() > 0:
            break  # nothing to see
        damped = look.curvature + np.diag(damping * diagonal + 1e-9 * diagonal.sum())
        step = np.linalg.solve(damped, -look.gradient)
        moved = Camera(_motion(step) @ camera.viewmat, camera.K, camera.width, camera.height)
        closer = _look(gaussians, moved, t, target)
        if closer.error >= look.error:
            damping *= 10
            continue
        gain = 1 - closer.error / look.error
        camera, look, damping = moved, closer, 0.3 * damping
        if gain < MIN_GAIN:
            break
    return camera


def _motion(twist: np.ndarray) -> np.ndarray:
    """Return [4, 4] the rigid motion of a twist [6]: first the rotation (radians), then the translation."""
    w, v = twist[:3], twist[3:]
    angle = float(np.linalg.norm(w))
    cross = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    # sin(a) / a and (1 - cos(a)) / a^2, the latter as half of the former's square at half the angle
    rotation = np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * np.sinc(0.5 * angle / np.pi) ** 2 * cross @ cross
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = rotation, v
    return motion


def _look(gaussians: Gaussians4D, camera: Camera, t: float, target: np.ndarray) -> _Look:
    parameters = gaussians.params["means"]
    viewmat, K = camera.tensors(parameters.dtype, parameters.device)
    viewmat = viewmat.clone().requires_grad_()
    center = torch.as_tensor(camera.center, dtype=parameters.dtype, device=parameters.device)
    with torch.no_grad():
        sliced = slice_gaussians(gaussians, gaussians.active(t, camera), center)
    size = camera.width, camera.height
    projected = project(
        sliced.means, sliced.quats, sliced.scales, sliced.opacities, viewmat, K, *size, covars=sliced.covars, near_plane=NEAR_PLANE
    )
    features = torch.cat([sliced.colors, projected.depths.detach()[:, None]], 1)
    slopes = image_slopes(sliced, projected, camera)
    image, alpha = blend(projected, sliced.opacities, features, *size, slopes=None if slopes is None else slopes.detach())
    # Where the model covers nothing there is nothing to compare: premultiplied like the image, the target fades out there too.
    wanted = torch.as_tensor(target, dtype=image.dtype, device=image.device) * alpha[..., None]
    error = ((image[..., :3] - wanted) ** 2).mean()
    error.backward()
    assert viewmat.grad is not None
    by_view = viewmat.grad[:3].double().cpu().numpy()
    # The twist moves V to (I + [w]x, v) V: its rotation's gradient is the antisymmetric part of G V^T.
    turned = by_view @ camera.viewmat.T
    gradient = np.array([
        turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1], *turned[:, 3]
    ])  # fmt: skip
    shown, covered = image.detach().cpu().numpy(), alpha.detach().cpu().numpy()
    return _Look(float(error.detach()), gradient, _curvature(shown[..., :3], shown[..., 3], covered, camera))


def _curvature(color: np.ndarray, depth: np.ndarray, alpha: np.ndarray, camera: Camera) -> np.ndarray:
    """Return [6, 6] Gauss-Newton curvature of the mean squared error by the twist, from what the image's gradients and depth tell.

    Args:
        color: [H, W, 3] premultiplied by alpha.
        depth: [H, W] premultiplied by alpha.
        alpha: [H, W].
    """
    z = depth / np.maximum(alpha, 1e-6)
    along_y, along_x = np.gradient(color, axis=(0, 1))
    known = (alpha > 0.5) & (z > NEAR_PLANE)
    ix, iy, inverse = along_x[known], along_y[known], 1 / z[known]
    K = camera.K.astype(np.float32)
    x, y = ((pixel_grid(camera.width, camera.height)[known] - K[:2, 2]) / K[[0, 1], [0, 1]]).T
    zero = np.zeros_like(x)
    du = K[0, 0] * np.stack([-x * y, 1 + x * x, -y, inverse, zero, -x * inverse], 1)
    dv = K[1, 1] * np.stack([-1 - y * y, x * y, x, zero, inverse, -y * inverse], 1)
    xx, xy, yy = (ix * ix).sum(1)[:, None], (ix * iy).sum(1)[:, None], (iy * iy).sum(1)[:, None]
    total = du.T @ (xx * du + xy * dv) + dv.T @ (xy * du + yy * dv)
    return (2 / color.size * total).astype(np.float64)

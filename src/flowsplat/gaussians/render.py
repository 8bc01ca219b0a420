"""Render 4D Gaussians from a camera at a time: color, alpha, depth and flow in one rasterization."""

from __future__ import annotations

from dataclasses import dataclass
from typing import SupportsFloat

import cv2
import numpy as np
import torch
from torch import Tensor

from flowsplat.gaussians.arguments import check_camera, check_target, check_time
from flowsplat.gaussians.distances import Distances, slice_view
from flowsplat.gaussians.flow import FlowModel, FlowView, blend_features, flow_channels, flow_image
from flowsplat.gaussians.gaussians4d import NEAR_PLANE, Active, Gaussians4D
from flowsplat.gaussians.slicing import Gradients, Slice, slice_gaussians
from flowsplat.gaussians.slopes import image_slopes
from flowsplat.geometry import Camera
from flowsplat.splatting import Projected, blend, project
from flowsplat.splatting.api import BackendName
from flowsplat.splatting.rules import EPS2D

FILLED_FROM, FILLED_TO = 0.5, 0.9
"""Transmittance from which the color of the neighbors is added to a pixel, and from which on all of it. Chosen on bear, train and
workshop (docs/method/representation.md; docs/notebook/2026-11.md)."""


@dataclass(frozen=True)
class RenderedFrame:
    """Differentiable images of one frame, premultiplied by alpha, in the normalized coordinates of the model.

    Attributes:
        image: [H, W, C] all of them together: color, depth, flow and, if there are any, how much of a pixel Gaussians behind the
            other camera hold.
        alpha: [H, W]
        flow_model: how flow was splatted; None = there is none.
        sliced: the Gaussians.
        projected: their projection.
    """

    image: Tensor
    alpha: Tensor
    flow_model: FlowModel | None
    sliced: Slice
    projected: Projected

    @property
    def flow_channels(self) -> int:
        """How many channels of ``image`` hold flow."""
        return flow_channels(self.flow_model) if self.flow_model else 0

    @property
    def color(self) -> Tensor:
        """[H, W, 3]"""
        return self.image[..., :3]

    @property
    def depth(self) -> Tensor:
        """[H, W]"""
        return self.image[..., 3]

    @property
    def flow(self) -> Tensor | None:
        """[H, W, 2], or None."""
        return flow_image(self.image[..., 4 : 4 + self.flow_channels]) if self.flow_model else None


def render_active(
    gaussians: Gaussians4D,
    active: Active,
    camera: Camera,
    *,
    flow_to: tuple[Camera, float] | None = None,
    flow_model: FlowModel = "displacement",
    gradients: Gradients | None = None,
    eps2d: float = EPS2D,
    backend: BackendName = "auto",
) -> RenderedFrame:
    """Render the active Gaussians at their time.

    Args:
        gaussians: the model.
        active: which of them.
        camera: in normalized coordinates.
        flow_to: the other camera and clip time that flow goes to.
        flow_model: which of docs/method/flow.md, "Flow splatting".
        gradients: where the gradients of the parameters go (``slice_gaussians``); None = not differentiable.
        eps2d: px^2 of blur; affine flow reckons with that of training.
        backend: of the rasterizer.
    """
    center = torch.as_tensor(camera.center, dtype=gaussians.params["means"].dtype)
    flow = None if flow_to is None else FlowView(flow_model, flow_to[0], flow_to[1] - active.t)
    sliced = slice_gaussians(gaussians, active, center, flow_to[1] if flow_to is not None else None, gradients)
    return _blend(sliced, camera, flow, eps2d, backend)


def _blend(sliced: Slice, camera: Camera, flow: FlowView | None, eps2d: float, backend: BackendName) -> RenderedFrame:
    dtype, device = sliced.means.dtype, sliced.means.device
    width, height = camera.width, camera.height
    projected = project(
        sliced.means, sliced.quats, sliced.scales, sliced.opacities, *camera.tensors(dtype, device), width, height,
        covars=sliced.covars, near_plane=NEAR_PLANE, eps2d=eps2d, backend=backend,
    )  # fmt: skip
    features = blend_features(sliced, projected, camera, flow)
    image, alpha = blend(projected, sliced.opacities, features, width, height, slopes=image_slopes(sliced, projected, camera))
    return RenderedFrame(image, alpha, flow.model if flow else None, sliced, projected)


@torch.no_grad()
def render(
    gaussians: Gaussians4D,
    camera: Camera,
    t: SupportsFloat,
    *,
    flow_to: tuple[Camera, SupportsFloat] | None = None,
    flow_model: FlowModel = "displacement",
    eps2d: float = EPS2D,
    backend: BackendName = "auto",
    distances: Distances | None = None,
) -> RenderedFrame:
    """Render 4D Gaussians in their own, normalized coordinates, without gradients; ``SceneModel.render`` hides these.

    Args:
        gaussians: the model, in float32; in float64 the slow reference renders it.
        camera: in normalized coordinates; its size is the image's size.
        t: clip time, 0 at the first frame and 1 at the last; any number of Python, NumPy or torch.
        flow_to: the other (camera, clip time) that optical flow goes to; None = none is rendered.
        flow_model: which of docs/method/flow.md, "Flow splatting".
        eps2d: px^2 of blur.
        backend: of the rasterizer.
        distances: of objects that are not where they were trained.

    Raises:
        InputError: an argument is not what it has to be, or a time is outside the clip.

    Examples:
        >>> run = flowsplat.Run("out/clip")
        >>> camera = run.model.similarity.camera(run.scene.cameras[0])
        >>> frame = flowsplat.render(run.model.gaussians, camera, t=0.25)
        >>> list(frame.color.shape), list(frame.depth.shape)
        ([48, 64, 3], [48, 64])
    """
    camera, t = check_camera(camera), check_time(t, 0, 1, unit="")
    target = check_target(flow_to, 0, 1, unit="")
    flow = None if target is None else FlowView(flow_model, target[0], target[1] - t)
    sliced = slice_view(gaussians, camera, t, target[1] if target is not None else None, distances, eps2d)
    return _blend(sliced, camera, flow, eps2d, backend)


def fill_uncovered(color: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Give uncovered pixels the color of their nearest covered neighbors, by push-pull over a pyramid. Ours.

    Borders that no training frame saw would be black otherwise (1.8 dB on the views of a rendered scene). Training has a black
    background and shows it through whatever is dark: such pixels are covered and must not get brighter, which cost .5 dB on
    a clip of a dark bear. So filling only begins at a transmittance that hardly any dark surface has
    (docs/method/representation.md).

    Args:
        color: [H, W, 3] float32 premultiplied.
        alpha: [H, W] float32.
    """
    transmittance = 1 - alpha
    if transmittance.max() < FILLED_FROM:
        return color
    levels = [(color, alpha)]
    while max(levels[-1][1].shape) > 1:
        c, a = levels[-1]
        size = (max(a.shape[1] // 2, 1), max(a.shape[0] // 2, 1))
        levels.append((cv2.resize(c, size, interpolation=cv2.INTER_AREA), cv2.resize(a, size, interpolation=cv2.INTER_AREA)))
    c, a = levels[-1]
    filled = c / np.maximum(a, 1e-6)[..., None]
    for c, a in levels[-2::-1]:
        upsampled = cv2.resize(filled, a.shape[::-1], interpolation=cv2.INTER_LINEAR)
        filled = c + (1 - np.clip(a, 0, 1))[..., None] * upsampled
    ramp = np.clip((transmittance - FILLED_FROM) / (FILLED_TO - FILLED_FROM), 0, 1) * transmittance
    return color + ramp[..., None] * filled

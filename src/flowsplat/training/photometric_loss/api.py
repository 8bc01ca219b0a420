"""The photometric loss, and the one place that picks who computes it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from flowsplat.common import devices
from flowsplat.common.devices import Kernels

Plane = np.ndarray | Tensor
"""An image in the memory of the host, or on a device."""


@dataclass(frozen=True)
class PhotometricTargets:
    """What an image should show.

    Attributes:
        color: [H, W, 3] uint8.
        depth: [H, W] float32, or None.
        depth_trusted: [H, W] bool, where it counts.
        flow: [H, W, 2] float32 pixels, or None.
        flow_trusted: [H, W] bool, where it counts.
    """

    color: Plane
    depth: Plane | None = None
    depth_trusted: Plane | None = None
    flow: Plane | None = None
    flow_trusted: Plane | None = None

    def to(self, device: torch.device) -> PhotometricTargets:
        """As tensors of a device, those that are there already as they are."""

        def moved(plane: Plane | None) -> Any:
            return None if plane is None else devices.upload(plane, device)

        return PhotometricTargets(
            moved(self.color), moved(self.depth), moved(self.depth_trusted), moved(self.flow), moved(self.flow_trusted)
        )


@dataclass(frozen=True)
class PhotometricWeights:
    """Weights of the parts (docs/method/training.md).

    Attributes:
        ssim: gamma_1, the share of SSIM in the color loss.
        flow: gamma_2.
        depth: of the relative depth error (ours).
        flow_by_alpha: compare the flow V with alpha F where alpha >= 0.5, which is |V / alpha - F| weighted by alpha and has no
            division to explode (ours); otherwise V with F (the paper), which is biased where alpha < 1.
    """

    ssim: float = 0.2
    flow: float = 0.0
    depth: float = 0.0
    flow_by_alpha: bool = True


@dataclass(frozen=True)
class ImageFigures:
    """The parts before their weights, and the mean squared error of the colors clamped to 0..1.

    Tensors where they were computed on a GPU, so that the host need not wait for them.
    """

    color: float | Tensor
    flow: float | Tensor
    depth: float | Tensor
    squared_error: float | Tensor


class PhotometricLossKernels(Protocol):
    """What each of the twins has."""

    def photometric_loss(
        self, image: Tensor, alpha: Tensor, flow_channels: int, targets: PhotometricTargets, weights: PhotometricWeights
    ) -> tuple[Tensor, ImageFigures]:
        """As below."""


def _twin(kernels: Kernels) -> PhotometricLossKernels:
    """Pick the backend that computes it, imported only where that is needed."""
    if kernels == "cpu":
        from flowsplat.training.photometric_loss import cpu

        return cpu
    if kernels == "triton":
        from flowsplat.training.photometric_loss import triton

        return triton
    from flowsplat.training.photometric_loss import reference

    return reference


def photometric_loss(
    image: Tensor, alpha: Tensor, flow_channels: int, targets: PhotometricTargets, weights: PhotometricWeights
) -> tuple[Tensor, ImageFigures]:
    """L_color + weight L_flow + weight L_depth of a rendered image (docs/method/training.md), differentiable in image and alpha.

    L_color is (1 - gamma_1) L1 + gamma_1 (1 - SSIM); SSIM has an 11 x 11 Gaussian window of sigma 1.5 and zeros beyond the
    border, as 3D Gaussian Splatting trains with. L_flow is the mean error in pixels over trusted pixels and both components;
    L_depth the relative error |D - alpha d| / d of trusted pixels, its mean over all pixels.

    Args:
        image: [H, W, C] blended features: color, depth, then ``flow_channels`` of flow (``gaussians.flow``) and, if there is
            one more, how much of a pixel is held by what the other camera cannot see; where that is over 5 %, flow is not
            trusted.
        alpha: [H, W].
        flow_channels: 0, 2 or 6.
        targets: what is compared with; where its flow or depth is None there is no such part.
        weights: of the parts; a part of weight 0 is not computed.

    Returns:
        the loss, a scalar, and its parts.
    """
    return _twin(devices.kernels_for(image)).photometric_loss(image, alpha, flow_channels, targets, weights)

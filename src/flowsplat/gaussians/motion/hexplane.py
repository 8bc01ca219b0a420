"""Six planes of features with a small decoder, those of 4D Gaussians (docs/method/representation.md, "Motion models of others")."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import embedding

from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.gaussians.motion.fields import OFFSET_NUMBERS, FieldMotion, apply_layers, initial_layers, layer_parameters
from flowsplat.gaussians.motion.protocol import register
from flowsplat.gaussians.motion.sharing import SharedParameter

PLANE_FEATURES = 16
"""Features of a plane. Chosen by eye."""
PLANE_RESOLUTIONS = (32, 64)
"""Values along each axis of space, in the levels of the planes; there is one cell fewer. Chosen by eye."""
DECODER_WIDTH = 64
"""Of the hidden layer of the decoder, as in the paper."""
PLANE_RATE, DECODER_RATE = 1.6e-3, 8e-4
"""Learning rates of the planes, that of the paper, and of the decoder at the start. Chosen by eye."""
LAST_LAYER_SCALE = 0.1
"""How large the weights of the last layer are at the start: as nothing changes in time, nothing moves, and with 0 no plane would
get a gradient. Chosen by eye."""
SPACE_PLANES, TIME_PLANES = ((0, 1), (0, 2), (1, 2)), (0, 1, 2)
"""Which two axes of space a plane has, and which one beside time."""


@dataclass(frozen=True)
class HexplaneMotion(FieldMotion):
    """D(x, t): a decoder of the product of six planes' features.

    4D Gaussian Splatting for Real-Time Dynamic Scene Rendering, https://arxiv.org/abs/2310.08528, equations 5 and 6, after HexPlane
    and K-Planes. The scene has no bounds here: each axis is contracted, x / (1 + |x|), with the median depth at half of the way.
    Along time a plane has ``knots`` values, so one cell fewer (a cubic spline of as many knots has three pieces fewer), and one
    decoder says all that there say several.
    """

    knots: int
    resolutions: tuple[int, ...] = PLANE_RESOLUTIONS
    features: int = PLANE_FEATURES
    width: int = DECODER_WIDTH

    @property
    def shared_parameters(self) -> dict[str, SharedParameter]:
        """See ``SharedMotion``."""
        planes = {}
        for level, cells in enumerate(self.resolutions):
            planes[f"space_planes_{level}"] = SharedParameter((len(SPACE_PLANES), cells, cells, self.features), PLANE_RATE)
            planes[f"time_planes_{level}"] = SharedParameter((len(TIME_PLANES), self.knots, cells, self.features), PLANE_RATE)
        return {**planes, **layer_parameters(self._widths, DECODER_RATE)}

    @property
    def _widths(self) -> list[int]:
        return [self.features * len(self.resolutions), self.width, OFFSET_NUMBERS]

    def initial_shared(self) -> dict[str, Tensor]:
        """See ``SharedMotion``: planes of time are 1, so that features begin as those of space, drawn evenly from .1 to .5."""
        generator = torch.Generator().manual_seed(0)
        found = {}
        for name, parameter in self.shared_parameters.items():
            if "planes" in name:
                drawn = 0.1 + 0.4 * torch.rand(parameter.shape, generator=generator)
                found[name] = torch.ones(parameter.shape) if name.startswith("time") else drawn
        return {**found, **initial_layers(self._widths, generator, LAST_LAYER_SCALE)}

    def ask(self, anchors: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """See ``FieldMotion``."""
        place = 0.5 + 0.5 * anchors / (1 + anchors.abs())
        features, rates = [], []
        for level in range(len(self.resolutions)):
            spaces, times = (self.read_shared(f"{kind}_planes_{level}", t) for kind in ("space", "time"))
            product, rate = torch.ones_like(t)[:, None], torch.zeros_like(t)[:, None]
            for plane, (one, other) in zip(spaces, SPACE_PLANES, strict=True):
                product = product * _look_up(plane, place[:, one], place[:, other])[0]
            for plane, axis in zip(times, TIME_PLANES, strict=True):
                value, change = _look_up(plane, t, place[:, axis])
                product, rate = product * value, rate * value + product * change
            features.append(product)
            rates.append(rate)
        layers = {name: self.read_shared(name, t) for name in self.shared_parameters if "planes" not in name}
        return apply_layers(layers, torch.cat(features, 1), torch.cat(rates, 1))


def _look_up(plane: Tensor, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """Return [N, F] what a plane [U, V, F] says at places u and v [N], 0 to 1, interpolated bilinearly, and its derivative with
    respect to u. Beyond its border u goes on as in its last cell."""
    rows, columns = plane.shape[0] - 1, plane.shape[1] - 1
    i, j = ((place * cells).detach().floor().clamp(0, cells - 1).long() for place, cells in ((u, rows), (v, columns)))
    a, b = (u * rows - i)[:, None], (v * columns - j)[:, None]
    flat, first = plane.flatten(0, 1), i * plane.shape[1] + j
    corners = torch.stack([first, first + 1, first + plane.shape[1], first + plane.shape[1] + 1])
    # Not by indices: their gradient sums up in an order that depends on the threads.
    low, low_next, high, high_next = embedding(corners, flat)
    low, high = torch.lerp(low, low_next, b), torch.lerp(high, high_next, b)
    return torch.lerp(low, high, a), (high - low) * rows


@register("hexplane", "Hexplane", "Planes of features with a small decoder, as 4D Gaussians.")
def _from_settings(settings: ModelConfig) -> HexplaneMotion:
    return HexplaneMotion(settings.knots)

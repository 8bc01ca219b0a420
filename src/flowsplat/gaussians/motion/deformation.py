"""A network of place and time, that of Deformable 3D Gaussians (docs/method/representation.md, "Motion models of others")."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.gaussians.motion.fields import OFFSET_NUMBERS, FieldMotion, apply_layers, initial_layers, layer_parameters
from flowsplat.gaussians.motion.protocol import register
from flowsplat.gaussians.motion.sharing import SharedParameter

NETWORK_LAYERS, NETWORK_WIDTH = 4, 64
"""Hidden layers of the network and their width. The paper has 8 of 256, thirty times as much work for every Gaussian, which two
cores cannot do."""
PLACE_OCTAVES, TIME_OCTAVES = 10, 6
"""Frequencies 1, 2, 4, ... of the encoding of the place and of the time, as the paper has them for real scenes."""
PLACE_RANGE = 4.0
"""Median depths over which the lowest frequency of the place has half a wave. Chosen by eye."""
NETWORK_RATE = 8e-4
"""Learning rate of the network at the start, that of the paper."""
ANNEALED_SHARE = 0.5
"""Share of the training until the highest frequency counts fully. Chosen by eye."""
FIRST_OCTAVES = 2.0
"""Frequencies that count from the first step on. Chosen by eye."""


@dataclass(frozen=True)
class DeformationMotion(FieldMotion):
    """D(x, t): a network of the encoded place and time.

    Deformable 3D Gaussians for High-Fidelity Monocular Dynamic Scene Reconstruction, https://arxiv.org/abs/2309.13101. Its noise in
    time, which falls during training, is replaced by what it stands for, an encoding whose high frequencies come in one after the
    other (Nerfies, https://arxiv.org/abs/2011.12948, equation 8): the same input has the same bits. Gradients reach x, too.
    """

    layers: int = NETWORK_LAYERS
    width: int = NETWORK_WIDTH
    place_octaves: int = PLACE_OCTAVES
    time_octaves: int = TIME_OCTAVES

    @property
    def shared_parameters(self) -> dict[str, SharedParameter]:
        """See ``SharedMotion``; ``octaves`` is how many frequencies count."""
        return {**layer_parameters(self._widths, NETWORK_RATE), "octaves": SharedParameter((), 0.0)}

    @property
    def _widths(self) -> list[int]:
        inputs = 3 * (1 + 2 * self.place_octaves) + 1 + 2 * self.time_octaves
        return [inputs, *[self.width] * self.layers, OFFSET_NUMBERS]

    def initial_shared(self) -> dict[str, Tensor]:
        """See ``SharedMotion``."""
        return {**initial_layers(self._widths, torch.Generator().manual_seed(0), last=0.0), "octaves": torch.tensor(FIRST_OCTAVES)}

    def anneal(self, progress: float) -> dict[str, float]:
        """See ``SharedMotion``."""
        share = min(progress / ANNEALED_SHARE, 1.0)
        return {"octaves": FIRST_OCTAVES + share * (max(self.place_octaves, self.time_octaves) - FIRST_OCTAVES)}

    def ask(self, anchors: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """See ``FieldMotion``."""
        octaves = self.read_shared("octaves", t)
        place, _ = _encode(math.pi / PLACE_RANGE * anchors, self.place_octaves, octaves)
        time, rates = _encode(math.pi * t[:, None], self.time_octaves, octaves)
        layers = {name: self.read_shared(name, t) for name in self.shared_parameters if name != "octaves"}
        return apply_layers(layers, torch.cat([place, time], 1), torch.cat([torch.zeros_like(place), math.pi * rates], 1))


def _encode(values: Tensor, count: int, octaves: Tensor) -> tuple[Tensor, Tensor]:
    """Return [N, D (1 + 2 count)] the values [N, D] and the sines and cosines of 2^k times them, as far as ``octaves`` are in use,
    and the derivatives of each with respect to its value."""
    k = torch.arange(count, dtype=values.dtype, device=values.device)
    window = 0.5 * (1 - torch.cos(math.pi * (octaves - k).clamp(0, 1)))
    phases = values[:, :, None] * 2**k
    sines, cosines = window * torch.sin(phases), window * torch.cos(phases)
    encoded = torch.cat([values, sines.flatten(1), cosines.flatten(1)], 1)
    return encoded, torch.cat([torch.ones_like(values), (cosines * 2**k).flatten(1), (-sines * 2**k).flatten(1)], 1)


@register("deformation", "Deformation", "A network of place and time, as Deformable 3D Gaussians.")
def _from_settings(_: ModelConfig) -> DeformationMotion:
    return DeformationMotion()

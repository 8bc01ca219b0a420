"""Define T-NeRF and HyperNeRF: density and color of a place at a time, from a direction."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, cast

import torch
from torch import Tensor, nn

from flowsplat_benchmarks.fields.deformation import move_by_screws
from flowsplat_benchmarks.fields.encoding import count_encoded, encode

FieldName = Literal["t-nerf", "hypernerf"]

FIRST_DENSITY = -1.0
"""Added to the density before softplus, so that the first volume is thin. As mip-NeRF, https://arxiv.org/abs/2103.13415."""
LAST_WEIGHT = 1e-4
"""Bound of the first weights of the last layer of a deformation or a slicing surface, so that nothing moves at the start. That of
Nerfies, appendix."""
DEFORMATION_SHARE = 0.32
"""Share of the training until all frequencies of the deformation count: 80,000 of 250,000 steps in HyperNeRF."""
AMBIENT_START, AMBIENT_END = 0.004, 0.044
"""Shares of the training at which the ambient coordinates begin to count and count fully: 1,000 and 11,000 of 250,000 steps in
HyperNeRF."""


@dataclass(frozen=True)
class FieldConfig:
    """The architecture of a field and the samples along a ray."""

    width: int = 256
    """Of the layers of a template, as NeRF has it."""
    depth: int = 8
    """Layers of a template, as NeRF has it; the input comes in again in the middle."""
    point_octaves: int = 8
    """Frequencies of the place in the template, as HyperNeRF has them; there, the last two come in during training."""
    time_octaves: int = 8
    """Frequencies of the time in T-NeRF. As many as of the place: no measurement stands against another value."""
    view_octaves: int = 4
    """Frequencies of the direction of view, as NeRF has it."""
    code: int = 8
    """Numbers of the code of a training frame in HyperNeRF."""
    ambient: int = 2
    """Ambient coordinates of HyperNeRF."""
    ambient_octaves: int = 1
    """Frequencies of the ambient coordinates in the template. That of HyperNeRF."""
    deformation_octaves: int = 6
    """Frequencies of the place in the deformation, which come in one after the other. That of HyperNeRF."""
    deformation_width: int = 128
    """Of the six layers of the deformation of HyperNeRF."""
    slicing_width: int = 64
    """Of the six layers of the slicing surface of HyperNeRF."""
    slicing_octaves: int = 6
    """Frequencies of the place in the slicing surface. That of HyperNeRF."""
    samples: int = 32
    """Along a ray, for the coarse template. A quarter of what HyperNeRF takes, for two cores."""
    importance: int = 32
    """More samples where the coarse template found something; the fine one sees both."""
    rays: int = 256
    """In a step. A batch of HyperNeRF is 24 times as large, for four accelerators."""
    chunk: int = 2048
    """Rays that are rendered at once, which bounds the memory."""
    rate: float = 1e-3
    """Learning rate of Adam at the start, that of HyperNeRF."""
    last_rate: float = 1e-4
    """At the end; between them it falls exponentially. That of HyperNeRF."""


def make_linear(inputs: int, outputs: int, generator: torch.Generator, bound: float | None = None) -> nn.Linear:
    """Return a layer with weights of Glorot's uniform distribution, or within ``bound``, and no bias."""
    layer = cast(nn.Linear, nn.utils.skip_init(nn.Linear, inputs, outputs))
    limit = math.sqrt(6 / (inputs + outputs)) if bound is None else bound
    with torch.no_grad():
        layer.weight.uniform_(-limit, limit, generator=generator)
        layer.bias.zero_()
    return layer


class Trunk(nn.Module):
    """Layers of equal width with ReLU; the input comes in again before the layer in the middle."""

    def __init__(self, inputs: int, width: int, depth: int, generator: torch.Generator):
        super().__init__()
        self._again = depth // 2 if depth > 2 else depth
        sizes = [inputs, *[width + (inputs if k == self._again else 0) for k in range(1, depth)]]
        self.layers = nn.ModuleList(make_linear(size, width, generator) for size in sizes)

    def forward(self, values: Tensor) -> Tensor:
        """Return [..., width] of [..., inputs]."""
        hidden = values
        for k, layer in enumerate(self.layers):
            hidden = torch.relu(layer(torch.cat([hidden, values], -1) if k == self._again else hidden))
        return hidden


class Template(nn.Module):
    """A NeRF of any coordinates: Mildenhall et al. 2020 (https://arxiv.org/abs/2003.08934), figure 7."""

    def __init__(self, inputs: int, config: FieldConfig, generator: torch.Generator):
        super().__init__()
        self.octaves = config.view_octaves
        self.trunk = Trunk(inputs, config.width, config.depth, generator)
        self.density = make_linear(config.width, 1, generator)
        self.bottleneck = make_linear(config.width, config.width, generator)
        self.branch = make_linear(config.width + count_encoded(3, self.octaves), config.width // 2, generator)
        self.color = make_linear(config.width // 2, 3, generator)

    def forward(self, coordinates: Tensor, views: Tensor) -> tuple[Tensor, Tensor]:
        """Return density [N, S] per unit of length and color [N, S, 3] between 0 and 1.

        Args:
            coordinates: [N, S, inputs].
            views: [N, 3] unit vectors.
        """
        hidden = self.trunk(coordinates)
        density = nn.functional.softplus(self.density(hidden)[..., 0] + FIRST_DENSITY)
        seen = encode(views, self.octaves)[:, None].expand(*coordinates.shape[:2], -1)
        branch = torch.relu(self.branch(torch.cat([self.bottleneck(hidden), seen], -1)))
        return density, torch.sigmoid(self.color(branch))


class Field(nn.Module, ABC):
    """A radiance field that changes in time, with a coarse and a fine template.

    Attributes:
        config: its architecture.
        progress: share of the training that is done, 0 to 1, from which annealed encodings follow.
    """

    def __init__(self, inputs: int, config: FieldConfig, generator: torch.Generator):
        super().__init__()
        self.config, self.progress = config, 1.0
        self.coarse, self.fine = (Template(inputs, config, generator) for _ in range(2))

    @abstractmethod
    def place(self, points: Tensor, times: Tensor) -> Tensor:
        """Return what the templates are asked for, [N, S, inputs], of points [N, S, 3] at times [N] between 0 and 1."""

    def forward(self, points: Tensor, views: Tensor, times: Tensor, fine: bool) -> tuple[Tensor, Tensor]:
        """Return density [N, S] per median depth and color [N, S, 3] between 0 and 1.

        Args:
            points: [N, S, 3] in normalized coordinates.
            views: [N, 3] unit vectors along the rays.
            times: [N] of the clip, 0 to 1.
            fine: which of the templates is asked.
        """
        return (self.fine if fine else self.coarse)(self.place(points, times), views)

    @property
    def parameter_count(self) -> int:
        """How many numbers are trained."""
        return sum(value.numel() for value in self.parameters())


class TNerf(Field):
    """A NeRF with time as one more input: the baseline T-NeRF of D-NeRF (https://arxiv.org/abs/2011.13961, section 5).

    DyCheck (https://arxiv.org/abs/2210.13445) measures it, too.
    """

    def __init__(self, config: FieldConfig, generator: torch.Generator):
        inputs = count_encoded(3, config.point_octaves) + count_encoded(1, config.time_octaves)
        super().__init__(inputs, config, generator)

    def place(self, points: Tensor, times: Tensor) -> Tensor:
        """See ``Field``."""
        time = encode(times[:, None], self.config.time_octaves)[:, None].expand(*points.shape[:2], -1)
        return torch.cat([encode(points, self.config.point_octaves), time], -1)


class HyperNerf(Field):
    """A template of five coordinates, on a slicing surface: Park et al. 2021 (https://arxiv.org/abs/2106.13228).

    A deformation moves every point into the template, and a slicing surface says at which ambient coordinates it is asked there;
    both read the code of the frame. Between training frames the code is that of the neighbors in time, mixed linearly.
    """

    code_times: Tensor

    def __init__(self, times: Sequence[float], config: FieldConfig, generator: torch.Generator):
        """Start with random codes.

        Args:
            times: of the training frames, rising, 0 to 1.
        """
        super().__init__(
            count_encoded(3, config.point_octaves) + count_encoded(config.ambient, config.ambient_octaves), config, generator
        )
        self.register_buffer("code_times", torch.tensor(times, dtype=torch.float32), persistent=False)
        first = torch.empty(len(times), config.code).uniform_(-0.05, 0.05, generator=generator)
        self.codes = nn.Parameter(first)
        moved = count_encoded(3, config.deformation_octaves) + config.code
        sliced = count_encoded(3, config.slicing_octaves) + config.code
        self.deformation = Trunk(moved, config.deformation_width, 6, generator)
        self.screw = make_linear(config.deformation_width, 6, generator, LAST_WEIGHT)
        self.slicing = Trunk(sliced, config.slicing_width, 6, generator)
        self.surface = make_linear(config.slicing_width, config.ambient, generator, LAST_WEIGHT)

    def mix_codes(self, times: Tensor) -> Tensor:
        """Return [N, code] at times [N]; before the first and after the last training frame it is theirs."""
        known = self.code_times.to(times)
        after = torch.searchsorted(known, times.contiguous()).clamp(1, len(known) - 1)
        before = after - 1
        share = ((times - known[before]) / (known[after] - known[before])).clamp(0, 1)[:, None]
        return (1 - share) * self.codes[before] + share * self.codes[after]

    def place(self, points: Tensor, times: Tensor) -> Tensor:
        """See ``Field``."""
        config = self.config
        codes = self.mix_codes(times)[:, None].expand(*points.shape[:2], -1)
        octaves = config.deformation_octaves * min(self.progress / DEFORMATION_SHARE, 1.0)
        moved = self.deformation(torch.cat([encode(points, config.deformation_octaves, octaves), codes], -1))
        ambient = self.surface(self.slicing(torch.cat([encode(points, config.slicing_octaves), codes], -1)))
        share = (self.progress - AMBIENT_START) / (AMBIENT_END - AMBIENT_START)
        counted = config.ambient_octaves * min(max(share, 0.0), 1.0)
        return torch.cat(
            [
                encode(move_by_screws(points, self.screw(moved)), config.point_octaves),
                encode(ambient, config.ambient_octaves, counted, has_values=share > 0),
            ],
            -1,
        )


def make_field(name: FieldName, times: Sequence[float], config: FieldConfig, seed: int) -> Field:
    """Return an untrained field.

    Args:
        times: of the training frames, rising, 0 to 1.
        seed: of its first weights.
    """
    generator = torch.Generator().manual_seed(seed)
    return TNerf(config, generator) if name == "t-nerf" else HyperNerf(times, config, generator)

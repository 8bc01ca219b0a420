"""Gaussians4D: the parameters of a 4D scene, and which of them are alive at a time."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from flowsplat.common import devices
from flowsplat.common.devices import Kernels, Later
from flowsplat.gaussians.culling import RowCapacity, active_rows, border, pad_active_rows
from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.gaussians.motion import MotionModel, SharedMotion, motion_model, presence
from flowsplat.geometry import Camera
from flowsplat.splatting.harmonics import harmonics_count
from flowsplat.splatting.rules import EPS2D

NEAR_PLANE = 0.02
"""Planar depth (median depth = 1) below which nothing is rendered. Chosen by eye."""


@dataclass(frozen=True)
class Active:
    """The Gaussians that are rendered at one time: first those at rest, then those that move.

    Where the host does not wait for a GPU (``capacity`` of ``Gaussians4D.active``) there are more rows than active Gaussians. The
    others are padding, -1: to the Triton kernels a Gaussian of opacity 0 without a gradient. The host asks how many are active
    when everything that needs the rows is in the GPU's queue.

    Attributes:
        rows: [A] int64 into the parameters; -1 = padding, behind those at rest and behind those that move.
        num_static: how many of them are for those at rest (and have gains instead of motion).
        t: clip time.
        needed: how many are at rest and moving, whether there is a row for each or not; None = they fill the rows.
    """

    rows: Tensor
    num_static: int
    t: float
    needed: Later | None = None

    def counts(self) -> tuple[int, int]:
        """Return how many are at rest and moving. Waits for a GPU to have counted them, not for anything after that."""
        if self.needed is None:
            return self.num_static, len(self.rows) - self.num_static
        resting, moving = self.needed.values()
        return resting, moving

    def fits(self) -> bool:
        """Return whether there is a row for each of them. Waits like ``counts``."""
        resting, moving = self.counts()
        return resting <= self.num_static and moving <= len(self.rows) - self.num_static

    def valid(self, values: Tensor) -> Tensor:
        """Select of values [A] of the rows those that are not padding's; all must fit. Waits like ``counts``."""
        if self.needed is None:
            return values
        resting, moving = self.counts()
        return torch.cat([values[:resting], values[self.num_static : self.num_static + moving]])


@functools.cache
def _list_dynamic_names(config: ModelConfig) -> tuple[str, ...]:
    parameters = motion_model(config).parameters
    return ("times", *(name for name, parameter in parameters.items() if parameter.moves))


@dataclass
class Gaussians4D:
    """N Gaussians: a dict of tensors by the names of docs/method/representation.md, [N, ...] each, which of them are dynamic,
    and whose they are.

    Attributes:
        params: float32 tensors, see ``parameter_shapes``.
        dynamic: [N] bool; False = background.
        config: what the parameters mean.
        sh_degree: the degree in use, at most ``config.sh_degree`` (training raises it step by step).
        object_ids: [N] uint8 number of the moving object that each belongs to, as in the masks of the clip; 0 = of none. Nothing
            that is computed in training depends on it. Left out it is 0 for all. It is not the same as ``dynamic``: a part of an
            object that turns out to rest is background and still belongs to it, and background that turns out to move belongs
            to none.
        seen: [N, 2] float32, what the clip has seen of each (``visibility.seen_of``): how many of the frames that were asked, and
            how far apart the directions are from which they did (root mean square, length of the difference of unit vectors). Known
            after training; None = not known.
        shadow_free: [N, 1 + G] float32, how bright each is without the shadows of what moves (``shadows.add_shadow_free``): the
            logarithm of a factor of its color, and gains in place of ``log_gains``. Known after training; None = not known.
        shared: what the motion model shares among all Gaussians, by name (``motion.sharing``); float32, no rows. Most models have
            none.
        motion: the motion model, bound to ``shared``.
    """

    params: dict[str, Tensor]
    dynamic: Tensor
    config: ModelConfig
    sh_degree: int = 0
    object_ids: Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.uint8))
    seen: Tensor | None = None
    shadow_free: Tensor | None = None
    shared: dict[str, Tensor] = field(default_factory=dict)
    motion: MotionModel = field(init=False)

    def __post_init__(self) -> None:
        self.motion = motion_model(self.config)
        self._take_arrays()
        expected = parameter_shapes(self.config)
        if set(expected) != set(self.params):
            raise ValueError(f"parameters {sorted(self.params)} do not fit the model {sorted(expected)}")
        for name, shape in expected.items():
            if tuple(self.params[name].shape) != (len(self), *shape):
                raise ValueError(f"{name} must be {[len(self), *shape]}, not {list(self.params[name].shape)}")
        if list_shared_shapes(self.config) != {name: tuple(value.shape) for name, value in self.shared.items()}:
            raise ValueError(
                f"shared parameters {sorted(self.shared)} do not fit the model {sorted(list_shared_shapes(self.config))}"
            )
        if isinstance(self.motion, SharedMotion):
            self.motion = self.motion.bind(self.shared)
        if not len(self.object_ids):
            self.object_ids = torch.zeros(len(self), dtype=torch.uint8, device=self.device)
        if self.object_ids.shape != self.dynamic.shape:
            raise ValueError(f"object_ids must be {[len(self)]}, not {list(self.object_ids.shape)}")
        if self.seen is not None and self.seen.shape != (len(self), 2):
            raise ValueError(f"seen must be {[len(self), 2]}, not {list(self.seen.shape)}")
        if self.shadow_free is not None and self.shadow_free.shape != (len(self), 1 + self.config.gains):
            raise ValueError(f"shadow_free must be {[len(self), 1 + self.config.gains]}, not {list(self.shadow_free.shape)}")

    def _take_arrays(self) -> None:
        """Make tensors of what was given as NumPy arrays, parameters in float32 as everything computes.

        Raises:
            ValueError: parameters are of several types, or one of no float type, also one that is shared; ``dynamic`` is not bool.
        """
        if not all(isinstance(value, Tensor) for value in self.values.values()):
            self.params, self.shared = (
                {name: _to_tensor(value) for name, value in each.items()} for each in (self.params, self.shared)
            )
        self.dynamic = torch.as_tensor(self.dynamic)
        if self.dynamic.dtype != torch.bool:
            raise ValueError(f"dynamic must be bool, not {str(self.dynamic.dtype)[6:]}")
        self.object_ids = torch.as_tensor(self.object_ids)
        dtype = next((value.dtype for value in self.params.values()), torch.float32)
        for name, value in self.shared.items():
            if not value.dtype.is_floating_point:
                raise ValueError(f"{name} is {str(value.dtype)[6:]}: give shared parameters in a float type")
        for name, value in self.params.items():
            if value.dtype != dtype or not dtype.is_floating_point:
                one = next(iter(self.params))
                raise ValueError(f"{name} is {str(value.dtype)[6:]}, {one} {str(dtype)[6:]}: give all parameters in one float type")

    def __repr__(self) -> str:
        moving = int(self.dynamic.sum())
        return f"Gaussians4D({len(self):,}, {moving:,} of them moving; motion {self.config.kind!r}; on {self.device})"

    def __len__(self) -> int:
        return len(self.dynamic)

    @property
    def at_rest(self) -> Tensor:
        """[N] bool: those that neither move nor fade."""
        return ~self.dynamic if self.config.freeze_background else torch.zeros_like(self.dynamic)

    def presence(self, t: float, rows: Tensor | slice = slice(None)) -> Tensor:
        """p(t) of some rows; 1 for Gaussians at rest."""
        names = ("times", *(name for name, parameter in self.motion.parameters.items() if parameter.fades))
        chosen = {name: self.params[name][rows] for name in names}
        value = presence(chosen["times"], self.motion.log_precision(chosen), t)
        return torch.where(self.at_rest[rows], torch.ones_like(value), value)

    @torch.no_grad()
    def active(self, t: float, camera: Camera | None = None, eps2d: float = EPS2D, capacity: RowCapacity | None = None) -> Active:
        """Return those with p(t) >= p_min, and of those at rest only what ``camera`` may show (all of them without one).

        Args:
            t: clip time.
            camera: who looks.
            eps2d: px^2 of blur that they will be rendered with.
            capacity: so that the host need not wait for a GPU: where Triton kernels slice, there are as many rows as this says.
                Look at ``fits()`` of the result before anything that was made with it is used, and where not, grow the
                capacity. None = the host waits for their number.
        """
        params = self.params
        if camera is not None:
            camera = camera.widen(border(eps2d))
        given = (
            self.at_rest, params["means"], self.motion.log_scales(params), params["times"], self.motion.log_precision(params), t,
            self.config.p_min, camera, NEAR_PLANE,
        )  # fmt: skip
        if capacity is not None and self.sliced_by == "triton":
            padded, needed = pad_active_rows(*given, capacity)
            return Active(padded, capacity.at_rest, t, needed)
        rows, num_static = active_rows(*given)
        return Active(rows, num_static, t)

    @property
    def sliced_by(self) -> Kernels:
        """Whose kernels slice these; a motion model without fused ones has the plain slice."""
        return devices.kernels_for(self.params["means"]) if self.motion.kernels == "series" else "reference"

    def gather(self, active: Active) -> dict[str, Tensor]:
        """Copies of the rows that are rendered, as leaves for a gradient; none may be padding."""
        return {name: value[self.rows_of(name, active)] for name, value in self.params.items()}

    @property
    def moving_names(self) -> tuple[str, ...]:
        """Parameters that only moving Gaussians have in ``gather``."""
        return _list_dynamic_names(self.config)

    def rows_of(self, name: str, active: Active) -> Tensor:
        """Return the rows that ``gather`` took for parameter ``name``."""
        return active.rows[self.part(name, active)]

    def part(self, name: str, active: Active) -> slice:
        """Return which active Gaussians use parameter ``name``: motion those that move (the last), gains those at rest (the
        first)."""
        if name in self.moving_names:
            return slice(active.num_static, None)
        return slice(active.num_static) if name == "log_gains" else slice(None)

    def to(self, device: torch.device | str) -> Gaussians4D:
        """Return the same Gaussians on a device; these themselves where they are there already."""
        if self.device == torch.device(device):
            return self
        params = {name: value.to(device) for name, value in self.params.items()}
        seen, shadow_free = (None if values is None else values.to(device) for values in (self.seen, self.shadow_free))
        shared = {name: value.to(device) for name, value in self.shared.items()}
        return Gaussians4D(
            params, self.dynamic.to(device), self.config, self.sh_degree, self.object_ids.to(device), seen, shadow_free, shared
        )

    @property
    def values(self) -> dict[str, Tensor]:
        """All parameters, those of rows and those that are shared."""
        return {**self.params, **self.shared}

    def anneal(self, progress: float) -> None:
        """Set, in place, what of the shared parameters follows the share of training that is done, 0 to 1."""
        if isinstance(self.motion, SharedMotion):
            for name, value in self.motion.anneal(progress).items():
                self.shared[name].fill_(value)

    @property
    def has_slopes(self) -> bool:
        """Whether brightness varies inside them: it was asked for, and their motion model has axes of their own."""
        return "slopes" in self.params

    def without_slopes(self) -> Gaussians4D:
        """Return the same Gaussians, each of one color."""
        params = {name: value for name, value in self.params.items() if name != "slopes"}
        config = replace(self.config, slopes=False)
        return replace(self, params=params, config=config)

    @property
    def object_counts(self) -> dict[int, int]:
        """How many Gaussians each object has, by its number, rising; without 0."""
        numbers, counts = torch.unique(self.object_ids, return_counts=True)
        return {number: count for number, count in zip(numbers.tolist(), counts.tolist(), strict=True) if number}

    @property
    def device(self) -> torch.device:
        """Where the parameters are."""
        return self.dynamic.device

    def select(self, rows: Tensor) -> Gaussians4D:
        """Return a model of some of the Gaussians."""
        params = {name: value[rows] for name, value in self.params.items()}
        seen, shadow_free = (None if values is None else values[rows] for values in (self.seen, self.shadow_free))
        return Gaussians4D(
            params, self.dynamic[rows], self.config, self.sh_degree, self.object_ids[rows], seen, shadow_free, self.shared
        )


def _to_tensor(value: Tensor | np.ndarray) -> Tensor:
    return value if isinstance(value, Tensor) else torch.tensor(np.asarray(value, np.float32))


def parameter_shapes(config: ModelConfig) -> dict[str, tuple[int, ...]]:
    """Return every parameter of a model and its trailing shape."""
    motion = motion_model(config).parameters
    return {
        "means": (3,),
        "times": (),
        "logit_opacities": (),
        "sh": (harmonics_count(config.sh_degree), 3),
        "log_gains": (config.gains,),
        **({"slopes": (2,)} if config.slopes and "quats" in motion else {}),  # others have no axes of their own
        **{name: parameter.shape for name, parameter in motion.items()},
    }


def list_shared_shapes(config: ModelConfig) -> dict[str, tuple[int, ...]]:
    """Return every parameter that a model's Gaussians share, and its shape."""
    motion = motion_model(config)
    shared = motion.shared_parameters if isinstance(motion, SharedMotion) else {}
    return {name: parameter.shape for name, parameter in shared.items()}


def concatenate(parts: Sequence[Gaussians4D]) -> Gaussians4D:
    """Return one model from several of the same configuration; what Gaussians share is that of the last."""
    params = {name: torch.cat([part.params[name] for part in parts]) for name in parts[0].params}
    dynamic, object_ids = torch.cat([part.dynamic for part in parts]), torch.cat([part.object_ids for part in parts])
    return Gaussians4D(params, dynamic, parts[0].config, parts[0].sh_degree, object_ids, shared=parts[-1].shared)

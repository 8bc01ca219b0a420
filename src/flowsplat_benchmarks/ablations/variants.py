"""One way to train: the settings it starts from, and what it changes of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, is_dataclass, replace
from typing import Any, Literal

from flowsplat.training.config import PRESETS, TrainConfig

Kind = Literal["moving", "static", "per_frame"]


@dataclass(frozen=True)
class Variant:
    """A way to train.

    Attributes:
        name: short, for files and options.
        label: for people.
        changes: values of settings by their dotted names (``model.gains``).
        start: the preset whose settings are changed.
        kind: a moving scene; or what such a one is compared with: one static scene, or one for every training frame.
    """

    name: str
    label: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    start: Literal["default", "paper"] = "default"
    kind: Kind = "moving"

    def config(self, iterations: int, cap: int, seed: int) -> TrainConfig:
        """All settings, with one frame in every step, so that all variants see as many images.

        Args:
            iterations: steps, unless the variant has its own number.
            cap: of Gaussians, likewise.
            seed: of every random choice.
        """
        budget = {
            "iterations": iterations, "frames_per_iteration": 1, "seed": seed, "preview_every": 0, "density.max_gaussians": cap,
        }  # fmt: skip
        return change_settings(PRESETS[self.start], {**budget, **self.changes})

    @property
    def settings(self) -> str:
        """What is changed, for people."""
        changes = ", ".join(f"{name} {value}" for name, value in self.changes.items())
        return changes if self.start == "default" else ", ".join(part for part in (f"preset {self.start}", changes) if part)


def change_settings(config: Any, changes: Mapping[str, Any]) -> Any:
    """A frozen dataclass of settings with other values of some of them.

    Raises:
        ValueError: there is no such setting.

    >>> changed(TrainConfig(), {"seed": 3, "model.gains": 4}).model.gains
    4
    """
    for path, value in changes.items():
        name, _, rest = path.partition(".")
        if not is_dataclass(config) or isinstance(config, type) or not hasattr(config, name):
            raise ValueError(f"{type(config).__name__} has no setting {path!r}")
        config = replace(config, **{name: change_settings(getattr(config, name), {rest: value}) if rest else value})
    return config

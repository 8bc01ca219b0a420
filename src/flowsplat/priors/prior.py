"""Define a prior: where it stands in the graph (``Prior``), and how it is made, read and replaced (``Kind``).

A kind is one file in ``priors/kinds``; ``priors/graph.py`` has one line for each, which gives it its place.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from flowsplat.priors.flow import FlowEstimator, dis_estimator
from flowsplat.priors.learned.networks import fill_methods
from flowsplat.priors.objects.hints import Hint
from flowsplat.priors.options import PriorsOptions
from flowsplat.priors.prompts import Prompt
from flowsplat.scenes import Scene
from flowsplat.scenes.ingest import CALIBRATED
from flowsplat.scenes.layers import Layers

GIVEN, TRUTH = "given", "truth"
"""Methods of priors that were read from the user's files, or are those of a rendered scene."""
BROUGHT = (GIVEN, TRUTH, CALIBRATED)
"""Methods of priors that were not computed. Chosen by eye."""

Stage = Callable[[], None]


@dataclass(frozen=True)
class PriorRequest:
    """What is asked for: a scene, and the options that say how its priors are to be made.

    Attributes:
        prompts: clicks and boxes, read from the options.
        hints: what is said of the distances of objects.
        options: whatever they are made with, here they name every method.
        device: where networks run: auto, cpu or cuda.
        estimate: finds flow.
        memory: what a step hands on without storing it, by the name of the step.
    """

    scene: Scene
    options: PriorsOptions
    prompts: Sequence[Prompt] = ()
    hints: Sequence[Hint] = ()
    device: str = "auto"
    estimate: FlowEstimator = dis_estimator
    memory: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Fill in the methods that the options leave to ``--priors``."""
        object.__setattr__(self, "options", fill_methods(self.options, self.device))

    def method(self, name: str) -> str | None:
        """Return how the prior that is there was made; None where there is none."""
        prior = self.scene.prior(name)
        return None if prior is None else str(prior.get("method"))

    def choice(self, name: str) -> str:
        """Return the method that is wanted of ``flow``, ``masks``, ``depth`` or ``object_depth``."""
        return str(getattr(self.options, name))

    @property
    def wants_truth(self) -> bool:
        """Whether the priors of a rendered scene are to be the true ones."""
        return self.options.priors == "true"

    def computes(self, name: str) -> bool:
        """Return whether a prior is missing and no file is given for it."""
        return self.scene.prior(name) is None and name not in self.options.given.named


def _no(*_: Any) -> bool:
    return False


def _do_nothing(*_: Any) -> None:
    return None


@dataclass(frozen=True)
class Kind:
    """How a prior, or a step on the way to one, is made, read and replaced.

    A missing network or file is said (``InputError``) by ``compute`` and ``read_given``, before anything is computed.

    Attributes:
        compute: gets what it needs ready (networks, say) and returns what computes it. None: what needs it solves it by itself.
        options: the settings (fields of ``PriorsOptions``) that decide how it is made.
        files: what it owns in the folder of the scene: files, and folders with a file a frame.
        own: the methods that are recorded where it was computed as the defaults say; others are those of ``asked``.
        asked: the method that settings other than the defaults ask for; None where they ask for nothing.
        differs: whether it is there, but was made with other settings than those asked for, though its method is right. Also gets
            the method that is asked for.
        check_renewal: refuses (``InputError``) to make one that differs anew. Also gets the names of all priors that would be.
        replaces_images: whether computing it changes the images, which everything else is made from.
        finds_flow: whether it searches flow of its own (``Request.estimate``).
        overwrites: whether files of an earlier one may stay until they are written anew. Others would be taken for parts of the new
            one, which goes on where it was stopped.
        is_scratch: whether its files are of no use once all priors are there.
        is_due: where it has no record of its own: whether it has to be done now.
        read_true: writes those of a rendered scene; whether the truth has all of it.
        asks_truth: whether ``--priors true`` asks for the true one. It does not for what the truth may lack.
        read_given: reads the user's file of it and records it; or returns what can only be done once other priors are there.
        given_replaces: whether that may take the place of one that is there.
    """

    compute: Callable[[PriorRequest], Stage] | None = None
    options: tuple[str, ...] = ()
    files: tuple[str, ...] = ()
    own: tuple[str, ...] = ()
    asked: Callable[[PriorRequest], str | None] = _do_nothing
    differs: Callable[[PriorRequest, str | None], bool] = _no
    check_renewal: Callable[[PriorRequest, Collection[str]], None] = _do_nothing
    replaces_images: Callable[[PriorRequest], bool] = _no
    finds_flow: bool = False
    overwrites: bool = False
    is_scratch: bool = False
    is_due: Callable[[PriorRequest], bool] = _no
    read_true: Callable[[Scene, Layers], bool] | None = None
    asks_truth: Callable[[PriorRequest], bool] = _no
    read_given: Callable[[PriorRequest, Path], Stage | None] | None = None
    given_replaces: bool = False


@dataclass(frozen=True)
class Prior:
    """A node of the graph.

    Attributes:
        name: under which it is recorded in the scene.
        kind: how it is made, read and replaced.
        needs: the nodes that it is made from, all before it.
        outlasts: those among what it follows from, however far back, whose change leaves it as it is.
        part_of: the prior that it is a step of, which is not complete without it: it is forgotten with that one, and its seconds
            are those of that one. None = a prior of its own.
        has_record: whether the scene records it. A step without a record changes the prior that it is part of, or is scratch.
    """

    name: str
    kind: Kind
    needs: tuple[str, ...] = ()
    outlasts: tuple[str, ...] = ()
    part_of: str | None = None
    has_record: bool = True

    @property
    def whole(self) -> str:
        """The prior that it is, or is a step of."""
        return self.part_of or self.name

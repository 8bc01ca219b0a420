"""The graph of priors: what each is made from. Order, what is stale, and what a given file replaces follow from it.

A scene records how each of its priors was made. What is asked for (``PriorRequest``) is compared with that: a prior that was made
in another way is stale, and so is what follows from it. A run keeps its scene only while ``Graph.inputs`` stay the same, for the
steps that complete a prior write over what earlier ones were made from: masks from the first search of flow, for example. What was
prepared by others, and is now prepared further, keeps what is not stale.
"""

from __future__ import annotations

import shutil
from collections.abc import Collection, Iterator, Mapping

from flowsplat.common.errors import InputError
from flowsplat.common.files import hash_files
from flowsplat.priors.cameras.straightening import resume_straightening
from flowsplat.priors.given import true_layers
from flowsplat.priors.kinds.cameras import CAMERAS
from flowsplat.priors.kinds.depth import DEPTH
from flowsplat.priors.kinds.flow import FLOW, OBJECT_FLOW
from flowsplat.priors.kinds.masks import MASKS
from flowsplat.priors.kinds.objects import OBJECTS
from flowsplat.priors.kinds.static_depth import MASKED_STATIC_DEPTH, STATIC_DEPTH
from flowsplat.priors.kinds.tracks import RESTING_TRACKS, TRACKS
from flowsplat.priors.options import PriorsOptions
from flowsplat.priors.prior import GIVEN, TRUTH, Kind, Prior, PriorRequest, Stage
from flowsplat.scenes import Scene


class Graph:
    """The priors and the steps to them, every one behind all that it is made from."""

    def __init__(self, *priors: Prior):
        """Put them together.

        Raises:
            ValueError: a name comes twice, or something needs what does not come before it.
        """
        self._priors = {prior.name: prior for prior in priors}
        if len(self._priors) < len(priors):
            raise ValueError("every prior needs a name of its own")
        before: set[str] = set()
        for prior in priors:
            if missing := [*set(prior.needs) - before, *({prior.whole} - set(self._priors))]:
                raise ValueError(f"{prior.name} needs {missing[0]}, which does not come before it")
            before.add(prior.name)

    def __iter__(self) -> Iterator[Prior]:
        """In an order in which each can be made from those before."""
        return iter(self._priors.values())

    def __getitem__(self, name: str) -> Prior:
        return self._priors[name]

    @property
    def whole(self) -> list[Prior]:
        """The priors themselves, without the steps to them."""
        return [prior for prior in self if prior.part_of is None]

    @property
    def names(self) -> list[str]:
        """Of the priors themselves."""
        return [prior.name for prior in self.whole]

    @property
    def recorded(self) -> list[str]:
        """Names of all that the scene records."""
        return [prior.name for prior in self if prior.has_record]

    def list_missing(self, scene: Scene) -> list[str]:
        """Return the priors that are not there."""
        return [name for name in self.names if scene.prior(name) is None]

    # -- what follows from what

    def list_reached(self, name: str, outlasting: bool = True) -> list[Prior]:
        """Return the nodes that a change of one changes, directly or through others.

        Args:
            outlasting: whether what outlasts such a change is left out.
        """
        below = {name}
        for prior in self:
            if not below.isdisjoint(prior.needs):
                below.add(prior.name)
        below.discard(name)
        return [prior for prior in self if prior.name in below and not (outlasting and name in prior.outlasts)]

    def followers(self, name: str, outlasting: bool = True) -> set[str]:
        """Return the priors that have to be made anew after one of them, or a step to one, was."""
        # A step with a record of its own is made anew with its prior, and not the prior with it.
        stale = {prior.whole for prior in self.list_reached(name, outlasting) if prior.part_of is None or not prior.has_record}
        return stale - {name}

    def stale(self, request: PriorRequest) -> set[str]:
        """Return what is there and must be made anew: another one is asked for, or it follows from such.

        What follows is only made anew where it is made as it was; the result of clicks, say, is kept without new clicks.

        Raises:
            InputError: something that is there cannot be replaced, or would stay without what it belongs to.
        """
        self._require_replaceable(request)
        asked = self._list_requested(request)
        differing = [prior for prior in self if prior.kind.differs(request, asked.get(prior.name))]
        replaced = {name for name, method in asked.items() if request.method(name) not in (None, method)}
        replaced |= {prior.name for prior in differing}
        stale = set(replaced)
        for name in replaced:
            followers = self.followers(name, outlasting=not self[name].kind.replaces_images(request))
            stale |= {other for other in followers if self._is_made_as_it_was(request, other, asked)}
        for prior in differing:
            prior.kind.check_renewal(request, stale)
        return stale

    def _list_requested(self, request: PriorRequest) -> dict[str, str]:
        """Return the method of every prior for which the options ask. An option that is left at its default asks for nothing."""
        asked = {prior.name: method for prior in self.whole if (method := prior.kind.asked(request)) is not None}
        if request.wants_truth:
            asked |= {prior.name: TRUTH for prior in self.whole if prior.kind.asks_truth(request)}
        return asked | dict.fromkeys(request.options.given.named, GIVEN)

    def _is_made_as_it_was(self, request: PriorRequest, name: str, asked: Mapping[str, str]) -> bool:
        method = request.method(name)
        return method != TRUTH and method in ([asked[name]] if name in asked else self[name].kind.own)

    def _require_replaceable(self, request: PriorRequest) -> None:
        for prior in self.whole:
            method = request.method(prior.name)
            if prior.name in request.options.given.named and method not in (None, GIVEN) and not prior.kind.given_replaces:
                there, option = f"{prior.name} already ({method})", f"--given.{prior.name}"
                raise InputError(f"The scene has {there}, which {option} cannot replace. Start from the clip.")

    # -- what a run's scene depends on

    def inputs(self, options: PriorsOptions) -> tuple[PriorsOptions, str]:
        """Return all that the priors of a clip depend on beside the clip: the settings, and a hash of the files that these name."""
        return options, hash_files("", options.given.files())

    def list_depending_on(self, options: Collection[str]) -> list[str]:
        """Return the priors that some settings (fields of ``PriorsOptions``) decide on, and those that follow from them."""
        chosen = [prior for prior in self if not set(options).isdisjoint(prior.kind.options)]
        found = {name for prior in chosen for name in (prior.whole, *self.followers(prior.name))}
        return [name for name in self.names if name in found]

    # -- the record and the files

    def forget(self, scene: Scene, names: Collection[str]) -> None:
        """Note that priors are not there, nor the steps that belong to them or follow from them, and delete their files."""
        gone = set(names)
        for prior in self:
            belongs = prior.whole in names or any(prior in self.list_reached(name) for name in names)
            if prior.part_of is not None and prior.has_record and belongs:
                gone.add(prior.name)
        if gone:
            self.erase(scene, gone)

    def erase(self, scene: Scene, names: Collection[str]) -> None:
        """Note that exactly these are not there, and delete those of their files that would be taken for parts of new ones."""
        scene.forget_priors(names)
        for prior in self:
            if prior.name in names and not prior.kind.overwrites:
                _delete(scene, prior)

    def clear_scratch(self, scene: Scene) -> None:
        """Delete what is of no use once all priors are there."""
        for prior in self:
            if prior.kind.is_scratch:
                _delete(scene, prior)

    # -- what needs no computing

    def _in_reading_order(self, request: PriorRequest) -> list[Prior]:
        order = {name: place for place, name in enumerate(request.options.given.names())}
        return sorted(self.whole, key=lambda prior: order.get(prior.name, len(order)))

    def read_truth(self, request: PriorRequest) -> None:
        """Make the truth of a rendered scene its priors; held-out frames give their cameras and nothing else.

        What the truth does not have in full is left to be computed.

        Raises:
            InputError: the scene has no truth.
        """
        truth = true_layers(request.scene)
        for prior in self._in_reading_order(request):
            if prior.kind.read_true is not None and prior.kind.read_true(request.scene, truth):
                request.scene.finish_prior(prior.name, method=TRUTH, verdict=f"true {prior.name}")

    def read_given(self, request: PriorRequest) -> dict[str, Stage]:
        """Read the user's files into the scene, those that are named.

        Returns:
            What can only be done once other priors are there, by the name of its prior: depth that must be fitted to the cameras,
            and tracks, which need the masks. Their files are checked here.

        Raises:
            InputError: a file is missing, cannot be read, is of no known layout, has another shape than the frames, or holds
                impossible values.
        """
        # What is read from here on lies in images of which it is known whether they are straightened.
        resume_straightening(request.scene)
        later: dict[str, Stage] = {}
        for name, path in request.options.given.named.items():
            read = self[name].kind.read_given
            assert read is not None
            if (stage := read(request, path)) is not None:
                later[name] = stage
        return later


def _delete(scene: Scene, prior: Prior) -> None:
    for name in prior.kind.files:
        path = scene.folder / name
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _step(name: str, kind: Kind, part_of: str, needs: tuple[str, ...], outlasts: tuple[str, ...] = ()) -> Prior:
    """Return a node without a record."""
    return Prior(name, kind, needs, outlasts, part_of, has_record=False)


PRIORS = Graph(
    Prior("cameras", CAMERAS),
    Prior("flow", FLOW, needs=("cameras",), outlasts=("cameras",)),  # takes cuts and blank frames from them
    _step("static_depth", STATIC_DEPTH, "masks", needs=("cameras", "flow")),  # of everything seen, what moves included
    Prior("masks", MASKS, needs=("cameras", "flow", "static_depth")),
    Prior("tracks", TRACKS, needs=("flow", "masks")),
    _step("masked_static_depth", MASKED_STATIC_DEPTH, "depth", needs=("cameras", "flow", "masks")),
    # Also gives the parts in masks the numbers of objects, which nothing before it asks for.
    Prior("objects", OBJECTS, needs=("cameras", "flow", "masks", "tracks", "masked_static_depth"), part_of="depth"),
    # Tracks are completed by depth: if depth followed from them in turn, there were no end.
    Prior("depth", DEPTH, needs=("cameras", "flow", "masks", "masked_static_depth", "objects"), outlasts=("tracks",)),
    # Of resting points, whose depth is not that of objects.
    _step("resting_tracks", RESTING_TRACKS, "tracks", needs=("cameras", "masks", "tracks", "depth"), outlasts=("objects",)),
    # Last: all others are made from the first search. What it finds stays good flow under other masks.
    _step("object_flow", OBJECT_FLOW, "flow", needs=("flow", "masks"), outlasts=("cameras", "masks")),
)
"""A new kind is one line here, and a file in ``kinds``."""

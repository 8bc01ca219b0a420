"""Registries: what there is of one kind, by name, for the command line, the viewer, the pages and the docs alike.

A member is a module of the registry's folder, which nothing lists, or a module of another package, which names it in an entry
point: ``[project.entry-points."flowsplat.losses"]`` with ``depth_order = "mine.depth_order"``. Either registers itself when it is
imported.
"""

from __future__ import annotations

import importlib
import pkgutil
import re
import threading
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from typing import Any, Generic, Literal, TypeVar

import tyro

from flowsplat.common.errors import InputError, first_line
from flowsplat.common.progress import report

T = TypeVar("T")
F = TypeVar("F")

_NAME = re.compile(r"[a-z][a-z0-9]*([_-][a-z0-9]+)*")
"""Names become options, keys of files, and parts of the names of files."""


@dataclass(frozen=True)
class Entry(Generic[T]):
    """A member of a registry.

    Attributes:
        name: that settings and files know it by.
        title: for a menu, a few words.
        sentence: for the help and the docs, what it is.
        value: what it does: a function, or whatever the registry holds.
        place: in lists, small ones first; those of one place are in alphabetical order.
    """

    name: str
    title: str
    sentence: str
    value: T
    place: int = 1000


class Registry(Generic[T]):
    """All members of one kind; they are imported when somebody asks for them first.

    Examples:
        >>> CURVES: Registry[Callable[[float], float]] = Registry("curve")
        >>> @CURVES.register("square", "Square", "Grows with the square.")
        ... def square(x):
        ...     return x * x
        >>> CURVES["square"](3.0), CURVES.names()
        (9.0, ('square',))
    """

    def __init__(self, what: str, package: str | None = None, group: str | None = None, *, are_values: bool = False):
        """``what``: one of its members is called; ``package``: whose modules are members; ``group``: of entry points;
        ``are_values``: names are no options, but only values of one, and may begin with a digit."""
        self.what = what
        self._pattern = re.compile(f"[0-9]?{_NAME.pattern}") if are_values else _NAME
        self._package, self._group = package, group
        self._found: dict[str, Entry[T]] = {}
        self._is_loaded = self._is_loading = False
        self._lock = threading.RLock()

    def add(self, entry: Entry[T]) -> None:
        """Make a member known.

        Raises:
            ValueError: its name cannot be one, or another has it.
        """
        if not self._pattern.fullmatch(entry.name):
            raise ValueError(f"{entry.name!r} cannot be the name of a {self.what}: give small letters, digits, - and _.")
        if entry.name in self._found:
            raise ValueError(f"there is a {self.what} {entry.name!r} already.")
        self._found[entry.name] = entry

    def register(self, name: str, title: str, sentence: str, place: int = 1000) -> Callable[[F], F]:
        """Decorate a member: see ``Entry``.

        Raises:
            ValueError: as ``add``.
        """

        def keep(value: F) -> F:
            self.add(Entry(name, title, sentence, value, place))  # type: ignore[arg-type]
            return value

        return keep

    def entries(self) -> tuple[Entry[T], ...]:
        """Return all members in order. A package of others that cannot be loaded is named and left out."""
        self._load()
        return tuple(sorted(self._found.values(), key=lambda entry: (entry.place, entry.name)))

    def names(self) -> tuple[str, ...]:
        """Return the names of all members in order."""
        return tuple(entry.name for entry in self.entries())

    def entry(self, name: str) -> Entry[T]:
        """Return the member of that name.

        Raises:
            InputError: there is none.
        """
        self._load()
        if name not in self._found:
            raise InputError(f"Unknown {self.what} {name!r}: choose one of {', '.join(self.names())}.")
        return self._found[name]

    def __getitem__(self, name: str) -> T:
        """Return what the member of that name does; raises as ``entry``."""
        return self.entry(name).value

    def __contains__(self, name: object) -> bool:
        self._load()
        return name in self._found

    def describe(self) -> str:
        """Return what there is, with the sentence of each: for the help."""
        return " ".join(f"{entry.name}: {entry.sentence}" for entry in self.entries())

    def option(self, are_many: bool = False) -> Any:
        """Annotate a setting whose value is a name, or ``are_many`` of them: the command line takes no others, and its help says
        what each is. Members are looked for when a command line is read, not when this is called.

        Examples:
            ``paths: Annotated[tuple[str, ...], PATHS.option(are_many=True)] = ("input",)``
        """

        def make_type() -> Any:
            one = Literal[self.names()]  # type: ignore[valid-type]
            return tuple[one, ...] if are_many else one  # type: ignore[valid-type]

        def hint(default: str) -> str:
            return f"{self.describe()} (default: {re.sub(r'[^a-z0-9_ -]', '', default)})"

        return tyro.conf.arg(constructor_factory=make_type, help_behavior_hint=hint)

    def _load(self) -> None:
        """Import all members, once. Other threads wait until all are there; a member that asks while it is imported does not."""
        if self._is_loaded:
            return
        with self._lock:
            if self._is_loaded or self._is_loading:
                return
            self._is_loading = True
            try:
                self._import_members()
                self._is_loaded = True
            finally:
                self._is_loading = False

    def _import_members(self) -> None:
        if self._package is not None:
            for module in pkgutil.iter_modules(importlib.import_module(self._package).__path__):
                importlib.import_module(f"{self._package}.{module.name}")
        for point in metadata.entry_points(group=self._group) if self._group is not None else ():
            before = dict(self._found)
            try:
                importlib.import_module(point.module)
            except (Exception, SystemExit) as error:  # of somebody else: whatever it is, all else works
                self._found = before
                package = point.dist.name if point.dist is not None else point.value
                report(f"The {self.what} {point.name} of package {package} is left out: {first_line(error)}")

"""Controls whose values are what they may be: what a browser sends is checked against the control that it is for."""

from __future__ import annotations

import re
from collections.abc import Callable, Coroutine, Sequence
from typing import Any

import viser

from flowsplat.common.errors import InputError, one_line


class Control:
    """A control of viser's whose ``value`` has been checked."""

    def __init__(self, handle: Any, check: Callable[[Any], Any]):
        """``check`` gives the value that counts for the one that was sent, or raises an ``InputError``."""
        self._handle, self._check, self._last, self._asked = handle, check, handle.value, handle.value

    @property
    def value(self) -> Any:
        """What is set.

        Raises:
            InputError: what was sent cannot be; the control goes back to what it was.
        """
        try:
            self._last = self._check(self._handle.value)
        except InputError:
            self._handle.value = self._last
            raise
        return self._last

    @value.setter
    def value(self, value: Any) -> None:
        self._handle.value = value

    def take(self) -> Any:
        """Return what the client set last, and show it again.

        Since its event the control may have been set to something else, such as the time of an image that was being drawn.

        Raises:
            InputError: as ``value``.
        """
        if self._handle.value != self._asked:
            self._handle.value = self._asked
        return self.value

    @property
    def visible(self) -> bool:
        """Whether it is shown."""
        return bool(self._handle.visible)

    @visible.setter
    def visible(self, visible: bool) -> None:
        self._handle.visible = visible

    def on_update(self, call: Callable[[Any], Coroutine[Any, Any, None]]) -> None:
        """Call this when it was changed."""

        async def begin(event: Any) -> None:
            if event.client_id is not None:
                self._asked = self._handle.value
            await call(event)

        self._handle.on_update(begin)


class Controls:
    """Makes controls as ``viser.GuiApi`` does, from the same arguments."""

    def __init__(self, gui: viser.GuiApi):
        self._gui = gui

    def add_dropdown(self, label: str, options: Sequence[str], **more: Any) -> Control:
        """Return one of ``options``."""

        def check(value: Any) -> str:
            if value not in options:
                raise InputError(f"{label} cannot be {value!r:.60}: choose one of {', '.join(options)}.")
            return str(value)

        return Control(self._gui.add_dropdown(label, tuple(options), **more), check)

    def add_slider(self, label: str, min: float, max: float, step: float, **more: Any) -> Control:
        """Return a number from ``min`` to ``max``."""

        def check(value: Any) -> float:
            if isinstance(value, int | float) and min - step <= value <= max + step:  # not for NaN; the browser rounds to steps
                return float(sorted((min, value, max))[1])
            raise InputError(f"{label} cannot be {value!r:.60}: give a number from {min:g} to {max:g}.")

        return Control(self._gui.add_slider(label, min=min, max=max, step=step, **more), check)

    def add_checkbox(self, label: str, initial_value: bool, **more: Any) -> Control:
        """Yes or no."""
        return Control(self._gui.add_checkbox(label, initial_value, **more), bool)


def as_code(text: str) -> str:
    """``text`` for viser's Markdown, to be copied: it breaks into lines where there is no room, and may hold anything but lines."""
    fence = "`" * (1 + max(map(len, re.findall("`*", text))))
    return f"{fence} {text} {fence}"


def as_text(text: str) -> str:
    """``text`` for viser's Markdown, without meaning there: a name in a file may hold anything."""
    return "".join(f"\\{c}" if c.isascii() and not c.isalnum() and c != " " else c for c in one_line(text))

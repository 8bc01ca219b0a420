"""Stopping when asked to: Ctrl-C, SIGTERM, and the SIGHUP of a terminal that is closed; on Windows Ctrl-C and Ctrl-Break."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")
"""Of all systems. SIGTERM ends a process on Windows before it can do anything."""


class Stopped(KeyboardInterrupt):
    """Work ended because it was asked to.

    Attributes:
        signal: number of the signal that asked.
    """

    def __init__(self, number: int):
        super().__init__(number)
        self.signal = number


class StopRequest:
    """Whether somebody asked to stop.

    Attributes:
        signal: number of the signal; None as long as nobody did.
    """

    def __init__(self) -> None:
        self.signal: int | None = None


@contextlib.contextmanager
def _handle(handler: Callable[[int, FrameType | None], Any], names: tuple[str, ...]) -> Iterator[None]:
    """With a handler of signals, where there may be one: in the main thread. What is ignored (``nohup``) stays ignored."""
    before: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        for name in names:
            number = getattr(signal, name, None)  # Windows has no SIGHUP, and nothing else has SIGBREAK
            if number is not None and signal.getsignal(number) != signal.SIG_IGN:
                before[number] = signal.signal(number, handler)
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, signal.SIG_DFL if earlier is None else earlier)


@contextlib.contextmanager
def stop_requests() -> Iterator[StopRequest]:
    """Inside, the first signal only makes a note, so that a step can be finished and kept; the second one stops at once."""
    request = StopRequest()

    def note(number: int, frame: FrameType | None) -> None:
        if request.signal is not None:
            raise Stopped(number)
        request.signal = number

    with _handle(note, NAMES):
        yield request


@contextlib.contextmanager
def signals_stop() -> Iterator[None]:
    """Inside, all but Ctrl-C raise ``Stopped``, as that raises ``KeyboardInterrupt``: files that are half written go away."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise Stopped(number)

    with _handle(stop, NAMES[1:]):
        yield


def ignore_signals() -> None:
    """From here on none of these signals interrupts this process, which is ending already."""
    for name in NAMES:
        number = getattr(signal, name, None)
        if number is not None and threading.current_thread() is threading.main_thread():
            signal.signal(number, signal.SIG_IGN)

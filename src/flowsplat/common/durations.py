"""How long something takes, in words."""

from __future__ import annotations

import time

IMPORTED = time.perf_counter()
"""Of a command about when its process began: what takes long to import is imported later."""
_begun: float | None = None


def command_begins(at: float) -> None:
    """Tell at which ``time.perf_counter()`` the command began that this process carries out."""
    global _begun
    _begun = at


def get_beginning() -> float:
    """When that was, for the first who asks; now for all others, and where this process is no command."""
    global _begun
    at, _begun = _begun, None
    return time.perf_counter() if at is None else at


def format_duration(seconds: float) -> str:
    """``"12.3 s"``, ``"4 min 5 s"`` or ``"1 h 20 min"``."""
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"

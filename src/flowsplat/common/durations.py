"""How long something takes, in words."""

from __future__ import annotations


def duration(seconds: float) -> str:
    """``"12.3 s"``, ``"4 min 5 s"`` or ``"1 h 20 min"``."""
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"

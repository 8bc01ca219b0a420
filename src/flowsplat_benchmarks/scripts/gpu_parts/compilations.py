"""How often Triton compiled each kernel in this process, and how long that took: what a first run waits for."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any


@dataclass
class Compilations:
    """Seconds of each, by kernel; those of which the result was on the disk count as well, and take little."""

    seconds: dict[str, list[float]] = field(default_factory=dict)

    def summary(self) -> dict[str, Any]:
        """Kernels by their seconds."""
        rows = sorted(self.seconds.items(), key=lambda item: -sum(item[1]))
        return {
            "variants": sum(map(len, self.seconds.values())),
            "seconds": round(sum(map(sum, self.seconds.values())), 1),
            "kernels": {name: {"variants": len(values), "seconds": round(sum(values), 2)} for name, values in rows},
        }


@contextmanager
def count_compilations() -> Iterator[Compilations]:
    """Watch the compiler of this process; where this Triton has no way to watch it, nothing is found."""
    import triton

    found = Compilations()
    compilation = getattr(getattr(triton, "knobs", None), "compilation", None)
    if compilation is None:
        yield found
        return

    def heard(*_: Any, src: Any, times: Any, **__: Any) -> None:
        name = getattr(src, "name", None) or getattr(getattr(src, "fn", None), "__name__", "?")
        found.seconds.setdefault(str(name).rsplit(".", 1)[-1], []).append(times.total / 1e6)

    before = compilation.listener
    compilation.listener = heard
    try:
        yield found
    finally:
        compilation.listener = before

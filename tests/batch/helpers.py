"""Work for real processes, of every way to end."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flowsplat.common.errors import InputError, WritingError
from flowsplat.common.files import lease


@dataclass(frozen=True)
class Deed:
    """Ends as ``how`` says; leaves a line in ``folder`` when it begins."""

    how: str
    folder: Path
    name: str = "a"

    def __call__(self, attempt: Any) -> dict[str, Any]:
        with open(self.folder / f"{self.name}.begun", "a") as file:
            file.write(f"{os.getpid()}\n")
        attempt.needs(0.1)
        return getattr(self, self.how)(attempt)

    def begun(self) -> list[int]:
        """The processes that began it."""
        path = self.folder / f"{self.name}.begun"
        return [int(line) for line in path.read_text().split()] if path.exists() else []

    def done(self, attempt: Any) -> dict[str, Any]:
        return {"process": os.getpid(), "fewer": attempt.fewer, "threads": os.environ["OMP_NUM_THREADS"]}

    def refused(self, attempt: Any) -> dict[str, Any]:
        raise InputError("a.mp4 is no film.")

    def unwritable(self, attempt: Any) -> dict[str, Any]:
        raise WritingError("The disk is full: x.")

    def wrong(self, attempt: Any) -> dict[str, Any]:
        raise RuntimeError("a mistake of ours")

    def killed(self, attempt: Any) -> dict[str, Any]:
        os.kill(os.getpid(), 9)
        return {}

    def aborted(self, attempt: Any) -> dict[str, Any]:
        os.abort()

    def exits(self, attempt: Any) -> dict[str, Any]:
        os._exit(3)

    def busy(self, attempt: Any) -> dict[str, Any]:
        with lease(self.folder / "held"):
            return {}

    def greedy(self, attempt: Any) -> dict[str, Any]:
        """Takes some 600 MiB, unless it may not."""
        held = []
        for _ in range(1 if attempt.fewer else 60):
            held.append(bytearray(os.urandom(1) * (10 * 2**20)))
            time.sleep(0.02)
        if not attempt.fewer:
            time.sleep(30)
        return {"fewer": attempt.fewer}

    def sleeps(self, attempt: Any) -> dict[str, Any]:
        for _ in range(600):  # Ray's way to stop a task does not wake a long sleep
            time.sleep(0.1)
        return {}

    def dozes(self, attempt: Any) -> dict[str, Any]:
        time.sleep(6)
        return {}

    def naps(self, attempt: Any) -> dict[str, Any]:
        time.sleep(0.5)
        return {"process": os.getpid()}

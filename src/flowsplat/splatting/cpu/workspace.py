"""Memory that the kernels use again: fresh pages cost more than the work done in them."""

from __future__ import annotations

import threading

import numpy as np


class Workspace:
    """Named scratch arrays that only grow. One forward pass owns a workspace until its gradient is no longer needed."""

    _free: list[Workspace] = []  # noqa: RUF012
    _lock = threading.RLock()  # The garbage collector may end a lease while this thread holds it.

    def __init__(self) -> None:
        self._arrays: dict[str, np.ndarray] = {}

    @staticmethod
    def acquire() -> Workspace:
        """Return a workspace that is not in use."""
        with Workspace._lock:
            return Workspace._free.pop() if Workspace._free else Workspace()

    def release(self) -> None:
        """Give it back; its arrays stay allocated for the next user."""
        with Workspace._lock:
            Workspace._free.append(self)

    def array(self, name: str, count: int, dtype: type) -> np.ndarray:
        """Return [count] uninitialized, 64-byte aligned, valid until the next call with this name or ``release``."""
        size = count * np.dtype(dtype).itemsize
        buffer = self._arrays.get(name)
        if buffer is None or len(buffer) < size:
            raw = np.empty(size + size // 4 + 64, np.uint8)
            start = -raw.ctypes.data % 64
            buffer = self._arrays[name] = raw[start:]
        return buffer[:size].view(dtype)

    def capacity(self, name: str, dtype: type) -> int:
        """Return how many elements ``array`` could return under this name without new memory."""
        buffer = self._arrays.get(name)
        return 0 if buffer is None else len(buffer) // np.dtype(dtype).itemsize


class Lease:
    """Holds a workspace for as long as the lease is held (by an autograd graph, for instance)."""

    def __init__(self) -> None:
        self.workspace = Workspace.acquire()

    def __del__(self) -> None:
        self.workspace.release()

"""Ask the system about other processes, stop them and end them: all that Linux, macOS and Windows each do in a way of their own.

| | Linux | macOS | Windows |
| --- | --- | --- | --- |
| since when a process lives | ``/proc/<number>/stat`` | ``ps -o stat=,lstart=`` | ``OpenProcess``, ``GetProcessTimes`` |
| processes that end together | a session (``setsid``) | the same | a group (``CREATE_NEW_PROCESS_GROUP``) |
| ask one to stop | SIGTERM | the same | Ctrl-Break for its group; where it has no console it is ended |
| end a group | SIGKILL for all of it | the same | ``taskkill /T /F`` |
| let it wait and go on | SIGSTOP, SIGCONT | the same | not possible: it goes on |
| give way to others | ``nice`` | the same | not done |

Number 0 is never sent to a process to see whether it lives: on Windows it is the number of Ctrl-C.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

_KILL_SIGNAL = getattr(signal, "SIGKILL", signal.SIGTERM)
"""What ends a process at once, also the one that sends it: on Windows any number that is not Ctrl-C or Ctrl-Break."""
KILLED_CODES = (-_KILL_SIGNAL, int(_KILL_SIGNAL))
"""Exit codes of a process that was killed, on POSIX and on Windows."""
_IS_ALIVE = "alive"
"""Where the system says no more of a process."""
_PS_SECONDS = 10.0
"""Seconds in which ``ps`` and ``taskkill`` have to answer. Chosen by eye."""
_QUERY_LIMITED_INFORMATION = 0x1000
"""https://learn.microsoft.com/windows/win32/procthread/process-security-and-access-rights"""
_STILL_ACTIVE = 259
"""https://learn.microsoft.com/windows/win32/api/processthreadsapi/nf-processthreadsapi-getexitcodeprocess"""
_ERROR_INVALID_PARAMETER = 87
"""What ``OpenProcess`` fails with where there is no such process."""


def read_start_time(process: int) -> str | None:
    """Return when a process was started, in words of the system, so that another of its number is not taken for it; None where it
    is dead."""
    if sys.platform == "win32":
        return _ask_windows(process)
    if Path("/proc/self/stat").exists():
        return _read_proc(process)
    return _ask_ps(process)


def is_running(process: int) -> bool:
    """Return whether a process of that number lives here."""
    return read_start_time(process) is not None


def _read_proc(process: int) -> str | None:
    try:
        status = Path(f"/proc/{process}/stat").read_text()
    except OSError:
        return None
    state, *rest = status.rpartition(")")[2].split()
    return None if state in "ZX" else rest[18]  # field 22 of proc(5)


def _ask_ps(process: int) -> str | None:
    try:
        command = ["ps", "-o", "stat=,lstart=", "-p", str(process)]
        said = subprocess.run(
            command, capture_output=True, text=True, timeout=_PS_SECONDS, check=False, env={**os.environ, "LC_ALL": "C"}
        ).stdout
    except (OSError, subprocess.TimeoutExpired):
        return _IS_ALIVE
    state, _, began = " ".join(said.split()).partition(" ")
    return None if not state or state[0] in "ZX" else began


def _ask_windows(process: int) -> str | None:
    from ctypes import wintypes

    kernel: Any = ctypes.WinDLL("kernel32", use_last_error=True)  # type: ignore[attr-defined,unused-ignore]
    kernel.OpenProcess.restype = wintypes.HANDLE
    kernel.OpenProcess.argtypes = (wintypes.DWORD, wintypes.BOOL, wintypes.DWORD)
    kernel.CloseHandle.argtypes = (wintypes.HANDLE,)
    kernel.GetExitCodeProcess.argtypes = (wintypes.HANDLE, ctypes.POINTER(wintypes.DWORD))
    kernel.GetProcessTimes.argtypes = (wintypes.HANDLE, *[ctypes.POINTER(wintypes.FILETIME)] * 4)
    handle = kernel.OpenProcess(_QUERY_LIMITED_INFORMATION, False, process)
    if not handle:
        missing = ctypes.get_last_error() == _ERROR_INVALID_PARAMETER  # type: ignore[attr-defined,unused-ignore]
        return None if missing else _IS_ALIVE
    try:
        code, times = wintypes.DWORD(), [wintypes.FILETIME() for _ in range(4)]
        if kernel.GetExitCodeProcess(handle, ctypes.byref(code)) and code.value != _STILL_ACTIVE:
            return None
        if not kernel.GetProcessTimes(handle, *map(ctypes.byref, times)):
            return _IS_ALIVE
        return str((times[0].dwHighDateTime << 32) + times[0].dwLowDateTime)
    finally:
        kernel.CloseHandle(handle)


def read_number_space() -> list[str]:
    """Return what tells apart where process numbers mean the same, beside the name of the machine: its start and, in a container,
    the container. Only Linux says it."""
    found = []
    for read in (lambda: Path("/proc/sys/kernel/random/boot_id").read_text().strip(), lambda: os.readlink("/proc/self/ns/pid")):
        with contextlib.suppress(OSError):
            found.append(read())
    return found


def group_options() -> dict[str, Any]:
    """Return the arguments of ``subprocess.Popen`` with which a process outlives who began it, and can be ended with all of its
    own."""
    if sys.platform == "win32":
        return {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    return {"start_new_session": True}


def ask_to_stop(process: int) -> None:
    """Ask a process that was begun with ``group_options`` to stop; flowsplat then keeps what it has. One that is dead is left."""
    with contextlib.suppress(OSError):
        if sys.platform == "win32":
            try:
                os.kill(process, signal.CTRL_BREAK_EVENT)
            except OSError:  # of another console, or without one: what it kept last is what there is
                os.kill(process, signal.SIGTERM)
        else:
            os.kill(process, signal.SIGTERM)


def kill_group(process: int) -> None:
    """End a process that was begun with ``group_options``, and whatever it has begun, at once."""
    if sys.platform == "win32":
        with contextlib.suppress(OSError, subprocess.TimeoutExpired):
            command = ["taskkill", "/PID", str(process), "/T", "/F"]
            subprocess.run(command, capture_output=True, timeout=_PS_SECONDS, check=False)
    else:
        _signal_group(process, signal.SIGKILL)


def kill_this_process() -> None:
    """End this process where it stands: nothing of what it would do in the end is done."""
    os.kill(os.getpid(), _KILL_SIGNAL)


def end_group(process: subprocess.Popen[bytes], seconds: float) -> None:
    """End a process that was begun with ``group_options``, and whatever it began: what it began may still run when it is done.

    Args:
        seconds: that it has to end by itself.
    """
    if sys.platform == "win32":
        if process.poll() is None:
            ask_to_stop(process.pid)
    elif not _signal_group(process.pid, signal.SIGTERM):
        return
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(seconds)
    kill_group(process.pid)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(seconds)


def pause_group(process: int, waits: bool) -> None:
    """Let a process that was begun with ``group_options`` wait, with all that it has begun, or go on."""
    if sys.platform != "win32":
        _signal_group(process, signal.SIGSTOP if waits else signal.SIGCONT)


def _signal_group(process: int, number: int) -> bool:
    """Return whether there is such a group."""
    if sys.platform == "win32":
        return False
    try:
        os.killpg(process, number)
    except OSError:
        return False
    return True


def give_way(niceness: int) -> None:
    """Let other processes have the processor first."""
    if sys.platform != "win32":
        with contextlib.suppress(OSError):
            os.nice(niceness)

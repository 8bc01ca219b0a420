"""Other processes, as each system tells of them, ends them and lets them wait."""

from __future__ import annotations

import ast
import ctypes
import os
import re
import signal
import subprocess
import sys
import time
from ctypes import wintypes
from pathlib import Path
from types import SimpleNamespace

import pytest

import flowsplat
from flowsplat.common import process_control
from flowsplat.common.process_control import (
    _ask_ps,
    ask_to_stop,
    end_group,
    group_options,
    is_running,
    kill_group,
    pause_group,
    read_start_time,
)  # fmt: skip

SOURCE = Path(flowsplat.__file__).parents[1]
WAITS = "import time; print('begun', flush=True); time.sleep(60)"
HAS_CHILD = f"""
import subprocess, sys
child = subprocess.Popen([sys.executable, "-c", {WAITS!r}])
print(child.pid, flush=True)
child.wait()
"""
on_posix = pytest.mark.skipif(sys.platform == "win32", reason="has no signals of this kind")

PLACES = {
    r"^import fcntl|^from fcntl|import msvcrt|fcntl\.flock|msvcrt\.locking": {"common/files/locks.py"},
    r"\bimport resource\b|\bresource\.getrusage": {"common/memory.py"},
    r"\bos\.(kill|killpg|nice|getpgid|setsid|fork|forkpty|wait3|wait4)\(": {"common/process_control.py"},
    r"\bSIG(KILL|STOP|CONT|HUP|BREAK)\b(?!,? and|, raise)": {"common/process_control.py", "common/stopping.py", "studio/tasks.py"},
    r"start_new_session|creationflags|preexec_fn": {"common/process_control.py"},
    r"\bimport (termios|pty|tty|pwd|grp|select)\b": set(),
    r"\"/proc/|\"/sys/|'/proc/": {
        "common/memory.py", "common/process_control.py", "common/processes.py", "pipeline/speed.py", "scripts/cpu_parts/machine.py",
    },
}  # fmt: skip
"""What not every system has, and the files that may use it: each has a way for the others."""


def code_of(path: Path) -> str:
    """A file without its docstrings and comments."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [
                each for each in body if not (isinstance(each, ast.Expr) and isinstance(getattr(each, "value", None), ast.Constant))
            ] or [ast.Pass()]
    return ast.unparse(tree).replace("'", '"')


def test_what_only_some_systems_have_stands_in_one_place():
    found: dict[str, set[str]] = {pattern: set() for pattern in PLACES}
    for path in [*SOURCE.glob("flowsplat/**/*.py"), *SOURCE.glob("flowsplat_benchmarks/**/*.py")]:
        raw = path.read_text(encoding="utf-8")
        perhaps = [pattern for pattern in PLACES if re.search(pattern, raw, re.MULTILINE)]
        text = code_of(path) if perhaps else ""
        for pattern in perhaps:
            if re.search(pattern, text, re.MULTILINE):
                found[pattern].add("/".join(path.relative_to(SOURCE).parts[1:]))
    assert found == PLACES


def begin(code: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, **group_options())


def wait_until(what) -> None:
    end = time.monotonic() + 20
    while not what():
        assert time.monotonic() < end, "in vain"
        time.sleep(0.01)


@pytest.fixture(params=["as this system says it", "by ps"])
def start_time(request, monkeypatch):
    """``read_start_time``, also as on macOS."""
    if request.param == "by ps":
        if _ask_ps(os.getpid()) in (None, process_control._IS_ALIVE):
            pytest.skip("there is no ps that says it")
        monkeypatch.setattr(process_control, "Path", lambda path: Path("/not") / str(path).lstrip("/"))
    return read_start_time


@on_posix
def test_since_when_a_process_lives(start_time):
    process = begin(WAITS)
    assert process.stdout is not None
    process.stdout.readline()
    began = start_time(process.pid)
    assert began
    assert start_time(process.pid) == began == start_time(process.pid)
    assert is_running(process.pid)
    kill_group(process.pid)
    wait_until(lambda: start_time(process.pid) is None)  # dead, and nobody has waited for it
    process.communicate()
    assert start_time(process.pid) is None


@on_posix
@pytest.mark.parametrize("how", ["at once", "with some seconds"])
def test_a_group_is_ended_with_what_it_began(how):
    process = begin(HAS_CHILD)
    assert process.stdout is not None
    child = int(process.stdout.readline())
    assert is_running(child)
    if how == "at once":
        kill_group(process.pid)
    else:
        end_group(process, 0.5)
    wait_until(lambda: not is_running(child))
    process.communicate()
    assert process.returncode < 0
    kill_group(process.pid)  # of one that is dead nothing comes
    ask_to_stop(process.pid)


@on_posix
def test_a_group_waits_and_goes_on():
    process = begin("import time\nwhile True: print(1, flush=True); time.sleep(0.001)")
    assert process.stdout is not None
    os.set_blocking(process.stdout.fileno(), False)

    def says_something() -> bool:
        return bool(process.stdout.read(2**20))

    wait_until(says_something)
    pause_group(process.pid, waits=True)
    wait_until(lambda: not says_something())
    time.sleep(0.05)
    assert not says_something()
    pause_group(process.pid, waits=False)
    wait_until(says_something)
    kill_group(process.pid)
    process.communicate()


class Kernel:
    """What is asked of Windows."""

    def __init__(self, handle: int = 7, code: int = 259, error: int = 0, tells: bool = True):
        self.code, self.closed = code, []
        self.OpenProcess = SimpleCall(lambda rights, inherit, number: handle)
        self.GetExitCodeProcess = SimpleCall(self._exit_code)
        self.GetProcessTimes = SimpleCall(lambda handle, *times: self._times(times) if tells else 0)
        self.CloseHandle = SimpleCall(self.closed.append)
        self.error = error

    def _exit_code(self, handle, code) -> int:
        code._obj.value = self.code
        return 1

    def _times(self, times) -> int:
        assert isinstance(times[0]._obj, wintypes.FILETIME)
        times[0]._obj.dwHighDateTime, times[0]._obj.dwLowDateTime = 2, 5
        return 1


class SimpleCall:
    """A function that takes types, as those of ``ctypes`` do."""

    def __init__(self, function):
        self._function = function

    def __call__(self, *arguments):
        return self._function(*arguments)


@pytest.fixture
def windows(monkeypatch):
    """A system that calls itself so; gives what it is asked for."""
    monkeypatch.setattr(sys, "platform", "win32")
    for name, value in (("CTRL_BREAK_EVENT", 1),):
        monkeypatch.setattr(signal, name, value, raising=False)
    monkeypatch.setattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 512, raising=False)
    called: list[tuple] = []
    monkeypatch.setattr(os, "kill", lambda *what: called.append(("kill", *what)))
    monkeypatch.setattr(os, "killpg", None)
    monkeypatch.setattr(subprocess, "run", lambda words, **_: called.append(("run", *words)))
    return called


@pytest.mark.parametrize(
    ("kernel", "expected"),
    [
        (Kernel(), str((2 << 32) + 5)), (Kernel(code=0), None), (Kernel(handle=0, error=87), None),
        (Kernel(handle=0, error=5), "alive"), (Kernel(tells=False), "alive"),
    ],
)  # fmt: skip
def test_windows_is_asked_since_when_a_process_lives(windows, monkeypatch, kernel, expected):
    monkeypatch.setattr(ctypes, "WinDLL", lambda *_, **__: kernel, raising=False)
    monkeypatch.setattr(ctypes, "get_last_error", lambda: kernel.error, raising=False)
    assert read_start_time(1234) == expected
    assert kernel.closed == ([] if kernel.error else [7])
    assert windows == [], "no signal is sent to look"


def test_windows_ends_and_asks_in_its_own_way(windows, monkeypatch):
    assert group_options() == {"creationflags": 512}
    ask_to_stop(5)
    kill_group(5)
    pause_group(5, waits=True)
    assert windows == [("kill", 5, signal.CTRL_BREAK_EVENT), ("run", "taskkill", "/PID", "5", "/T", "/F")]
    windows.clear()
    done = SimpleNamespace(pid=6, poll=lambda: None, wait=lambda seconds: 0)
    end_group(done, 0.1)
    assert windows == [("kill", 6, signal.CTRL_BREAK_EVENT), ("run", "taskkill", "/PID", "6", "/T", "/F")]
    windows.clear()

    def refuse(process, number):
        windows.append(number)
        if number == signal.CTRL_BREAK_EVENT:
            raise OSError("of another console")

    monkeypatch.setattr(os, "kill", refuse)
    ask_to_stop(7)
    assert windows == [signal.CTRL_BREAK_EVENT, signal.SIGTERM]


WITHOUT = """
import importlib, os, pkgutil, signal, sys
import torch, numba, scipy.optimize, cv2, av, tyro, multiprocessing, concurrent.futures  # which have their own ways
GONE = "fcntl", "resource", "termios", "pty", "tty", "pwd", "grp"
sys.modules |= dict.fromkeys(GONE)
for name in ("fork", "forkpty", "kill", "killpg", "nice", "setsid", "getuid", "geteuid", "sched_getaffinity", "register_at_fork",
             "mkfifo", "pread", "pwrite", "sysconf", "getloadavg", "O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC"):
    if hasattr(os, name): delattr(os, name)
for name in ("SIGKILL", "SIGHUP", "SIGSTOP", "SIGCONT"):
    delattr(signal, name)
import flowsplat, flowsplat_benchmarks
names = [each.name for package in (flowsplat, flowsplat_benchmarks)
         for each in pkgutil.walk_packages(package.__path__, package.__name__ + ".")
         if not each.name.endswith("__main__") and ".triton" not in each.name and "triton_probe" not in each.name]
for name in names:
    try:
        importlib.import_module(name)
    except ImportError as error:  # of a package that is not installed here, which is another matter
        if error.name is None or error.name.split(".")[0] in ("flowsplat", "flowsplat_benchmarks", *GONE): raise
from pathlib import Path
from flowsplat.common.files import lease
from flowsplat.common.files.lease import NAME, holder
folder = Path(sys.argv[1])
with lease(folder / "a"):
    assert holder(folder / "a") is None and not (folder / "a" / NAME).exists()
print(len(names))
"""


def test_everything_is_imported_where_nothing_of_posix_is(tmp_path):
    """As on Windows, but that what others need of it has been imported before."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT, str(tmp_path)], capture_output=True, text=True, timeout=120, env=environment
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 400

"""Compiled kernels on disk, which belong to the contents of every file that they are made of.

Numba's own cache looks at the file of a kernel alone. Constants and functions that a kernel takes from other files are compiled
into it, and after a change of those the old machine code would be loaded: results of code that is no longer there. Here the folder
of a kernel is named after a hash of its file and of every file of the package that this one imports, directly or through others,
of the versions of Python, Numba and llvmlite, and of the processor.
"""

from __future__ import annotations

import ast
import contextlib
import hashlib
import inspect
import os
import pickle
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite
import numba
from numba.core import config
from numba.core.caching import _Cache
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps

from flowsplat.common.errors import InputError
from flowsplat.common.files import write_bytes
from flowsplat.common.source import PACKAGE
from flowsplat.common.syntax import PARSING
from flowsplat.common.user_cache import cache_folder

UNUSED_SECONDS = 30 * 24 * 3600.0
"""Seconds after which a folder that nothing was loaded from is deleted. Chosen by eye."""
MARK_SECONDS = 24 * 3600.0
"""Seconds after which a folder that something is loaded from is marked as used anew. Chosen by eye."""
_NAME = re.compile(r"[\w.]+-[0-9a-f]{16}")
"""Of a folder that is ours; others' may lie beside it."""
_SETTINGS = ("OPT", "LOOP_VECTORIZE", "SLP_VECTORIZE", "BOUNDSCHECK", "CPU_NAME", "CPU_FEATURES", "DEBUGINFO_DEFAULT")
"""Of Numba, which decide what it makes of a function."""


def kernels_folder() -> Path:
    """Return where compiled kernels are: in ``NUMBA_CACHE_DIR`` where that is set, in the user's folder for caches elsewhere."""
    own = os.environ.get("NUMBA_CACHE_DIR")
    return Path(own) if own else cache_folder() / "kernels"


@cache
def sources_of(file: Path) -> tuple[Path, ...]:
    """Return a Python file and all files of the package that it imports, directly or through others, sorted."""
    found: set[Path] = set()
    left = [file.resolve()]
    while left:
        path = left.pop()
        if path not in found:
            found.add(path)
            left += _list_imported(path)
    return tuple(sorted(found))


@cache
def _list_imported(file: Path) -> tuple[Path, ...]:
    found = []
    with PARSING:
        tree = ast.parse(file.read_bytes())
    for node in _that_run(tree):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            start = node.module or ""
            if node.level:
                with contextlib.suppress(ValueError):  # a file beside the package that imports from its own folder
                    parents = file.relative_to(PACKAGE.parent).parts[: -node.level]
                    start = ".".join((*parents, *filter(None, (node.module,))))
            found += [start, *(f"{start}.{alias.name}" for alias in node.names)]
    return tuple(path for name in found if name.split(".")[0] == PACKAGE.name for path in _files_of(name))


def _that_run(node: ast.AST) -> Iterator[ast.AST]:
    """Yield a node and all below it, but for what is there for type checkers only."""
    yield node
    for child in ast.iter_child_nodes(node):
        if not (isinstance(child, ast.If) and isinstance(child.test, ast.Name) and child.test.id == "TYPE_CHECKING"):
            yield from _that_run(child)


def _files_of(module: str) -> Iterator[Path]:
    path = PACKAGE.parent.joinpath(*module.split("."))
    for file in (path.with_suffix(".py"), path / "__init__.py"):
        if file.is_file():
            yield file.resolve()


@cache
def _machine() -> str:
    from numba.core.registry import cpu_target

    codegen = cpu_target.target_context.codegen()
    settings = [getattr(config, name, None) for name in _SETTINGS]
    versions = sys.version_info[:2], numba.__version__, llvmlite.__version__
    return repr((versions, codegen.magic_tuple(), settings))


@cache
def key_of(file: Path) -> str:
    """Return what machine code of the kernels in a Python file belongs to: 16 hexadecimal digits."""
    digest = hashlib.sha256(_machine().encode())
    for path in sources_of(file):
        digest.update(f"\n{path.relative_to(PACKAGE.parent) if path.is_relative_to(PACKAGE.parent) else path.name}\n".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


_compiled = 0


def count_compiled_kernels() -> int:
    """Return how many kernels this process has compiled, and not loaded."""
    return _compiled


class KernelCache(_Cache):
    """What a function of Numba loads machine code from and saves it to. Nothing that is wrong with its files is an error."""

    def __init__(self, function: Callable[..., Any]):
        self._function = function
        self._file = Path(inspect.getfile(function))
        self._made = time.time()
        self._enabled = True

    @property
    def cache_path(self) -> str | None:
        """The folder; None where the sources cannot be read, or are others than those that this process runs."""
        try:
            key = key_of(self._file)
            changed = max(path.stat().st_mtime for path in sources_of(self._file))
        except (OSError, SyntaxError):
            return None
        if self._made < changed <= time.time():
            return None
        name = self._function.__module__.removeprefix(f"{PACKAGE.name}.")
        return str(kernels_folder() / f"{name}-{key}")

    def enable(self) -> None:
        """Use the files."""
        self._enabled = True

    def disable(self) -> None:
        """Use none."""
        self._enabled = False

    def flush(self) -> None:
        """Delete the folder."""
        if self.cache_path is not None:
            shutil.rmtree(self.cache_path, ignore_errors=True)

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """Return the compiled function for arguments of these types, or None."""
        path = self._path(signature)
        if path is None:
            return None
        target_context.refresh()
        try:
            data = path.read_bytes()
        except OSError:
            return None
        # Whatever is wrong with a file, the kernel can be compiled.
        with contextlib.suppress(Exception):
            result = CompileResult._rebuild(target_context, *pickle.loads(data))
            _mark_used(path.parent)
            return result
        return None

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Write it, where that is possible."""
        global _compiled
        _compiled += 1
        path = self._path(signature)
        if path is None or compiled.lifted or compiled.library.has_dynamic_globals:
            return
        is_new = not path.parent.exists()
        with contextlib.suppress(InputError, OSError):  # then it is compiled once more next time
            write_bytes(path, dumps(compiled._reduce()))
            if is_new:
                remove_old(path.parent.parent)

    def _path(self, signature: Any) -> Path | None:
        folder = self.cache_path if self._enabled else None
        if folder is None:
            return None
        digest = hashlib.sha256(repr(signature).encode())
        digest.update(self._function.__code__.co_code)
        cells = self._function.__closure__ or ()
        digest.update(dumps(tuple(cell.cell_contents for cell in cells)))
        name = self._function.__qualname__.replace("<", "").replace(">", "")
        return Path(folder) / f"{name}-{digest.hexdigest()[:16]}.kernel"


def _mark_used(folder: Path) -> None:
    with contextlib.suppress(OSError):
        if time.time() - folder.stat().st_mtime > MARK_SECONDS:
            os.utime(folder)


def remove_old(folder: Path) -> None:
    """Delete what nothing was loaded from for long."""
    for kept in folder.iterdir():
        with contextlib.suppress(OSError):
            if (
                _NAME.fullmatch(kept.name)
                and kept.is_dir()
                and not kept.is_symlink()
                and time.time() - kept.stat().st_mtime > UNUSED_SECONDS
            ):
                shutil.rmtree(kept, ignore_errors=True)

"""Define commands of the command line, and collect them from the files of a folder."""

from __future__ import annotations

import importlib
import importlib.util
import pkgutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from flowsplat.cli.arguments import value_of
from flowsplat.common.errors import InputError

if TYPE_CHECKING:
    from flowsplat.pipeline.config import RunConfig


def preset_defaults(arguments: Sequence[str]) -> RunConfig:
    """Return the settings of the preset that the arguments name, or of the default one."""
    from flowsplat.pipeline.config import preset

    return preset(value_of(arguments, "--preset") or "default")


@dataclass(frozen=True)
class Command:
    """A command. Its name is that of its file.

    Attributes:
        build: makes its function from the settings that are the defaults of its options. The parameters of that function are
            the options, its docstring the help; it returns False where the exit code is to be 1.
        defaults: reads those settings off the arguments of the command line.
        place: in the list of commands, small ones first; those of one place are in alphabetical order.
    """

    build: Callable[[RunConfig], Callable[..., Any]]
    defaults: Callable[[Sequence[str]], RunConfig] = preset_defaults
    place: int = 1000


def benchmark_commands() -> str:
    """Return the package of the commands of ``flowsplat benchmark``, which are none of flowsplat's own.

    Raises:
        InputError: it is not installed.
    """
    if importlib.util.find_spec("flowsplat_benchmarks") is None:
        raise InputError(
            "The benchmarks are a package beside flowsplat, flowsplat_benchmarks, which is not installed here: pip install -e . in "
            "flowsplat's repository installs both."
        )
    return "flowsplat_benchmarks.commands"


def commands_of(package: str) -> dict[str, Command]:
    """Return every command of a package, by name and in order: each of its modules holds one as ``COMMAND``."""
    names = sorted(module.name for module in pkgutil.iter_modules(importlib.import_module(package).__path__))
    found = {name: importlib.import_module(f"{package}.{name}").COMMAND for name in names}
    return dict(sorted(found.items(), key=lambda item: item[1].place))


def functions_of(package: str, arguments: Sequence[str]) -> dict[str, Callable[..., Any]]:
    """Return the function of every command of a package, by name: its defaults are those of the command that the arguments name.

    Args:
        arguments: of the command line, which the name of the command begins.

    Raises:
        InputError: they name a preset that is not there, or a run whose record is damaged.
    """
    commands = commands_of(package)
    named = commands.get(arguments[0]) if arguments else None
    defaults = (named.defaults if named else preset_defaults)(arguments)
    return {name: command.build(defaults) for name, command in commands.items()}

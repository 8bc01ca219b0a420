"""Entry point of ``flowsplat``."""

import contextlib
import io
import os
import sys
import time
from collections.abc import Sequence
from typing import Any

import tyro

from flowsplat import __version__
from flowsplat.cli.command import benchmark_commands, functions_of
from flowsplat.cli.help import message_of, short_help
from flowsplat.common.durations import IMPORTED, command_begins
from flowsplat.common.errors import InputError, one_line
from flowsplat.common.memory import keep_imported
from flowsplat.common.progress import report
from flowsplat.common.stopping import Stopped, ignore_signals, signals_stop


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the console script. Bad input ends with one line on stderr and exit code 2."""
    whole_process = arguments is None
    command_begins(IMPORTED if whole_process else time.perf_counter())
    if whole_process:  # Our matrices are small: two threads of BLAS take twice as long for the cameras, and give other last digits.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        keep_imported()
        if isinstance(sys.stdout, io.TextIOWrapper):
            sys.stdout.reconfigure(errors="backslashreplace")  # as stderr: names of files may hold what is no text
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    # tyro spells it None.
    for k, argument in enumerate(arguments):
        if argument == "--holdout=none" or (argument == "none" and k and arguments[k - 1] == "--holdout"):
            arguments[k] = argument[:-4] + "None"
    if not arguments:
        arguments = ["--help"]
    if arguments[0] in ("--version", "-V"):
        print(f"flowsplat {__version__}")
        return
    whole = "--help-all" in arguments
    arguments = ["--help" if argument == "--help-all" else argument for argument in arguments]
    box, told = io.StringIO(), io.StringIO()
    prog, package = "flowsplat", "flowsplat.cli.commands"
    try:
        if arguments[0] == "benchmark":
            prog, package, arguments = "flowsplat benchmark", benchmark_commands(), arguments[1:] or ["--help"]
        functions = functions_of(package, arguments)
        call = _Deferred()
        with contextlib.redirect_stderr(box), contextlib.nullcontext() if whole else contextlib.redirect_stdout(told):
            tyro.extras.subcommand_cli_from_dict(
                {name: call.wrap(function) for name, function in functions.items()},
                prog=prog,
                description="One ordinary video becomes a 4D scene of moving Gaussians.",
                args=arguments,
            )
        with signals_stop():
            ended_well = call.run()
    except InputError as error:
        _fail(str(error))
    except SystemExit as error:
        if error.code == 2:
            from flowsplat.pipeline.renamed_options import find_renamed_option  # imported by the commands anyway, not by --version

            renamed = {argument.split("=", 1)[0]: now for argument in arguments if (now := find_renamed_option(argument))}
            if renamed and "Unrecognized" in box.getvalue():
                _fail(" ".join(f"The option {before} is called {now} now." for before, now in renamed.items()))
            _fail(message_of(box.getvalue()) or "The command line cannot be understood: see flowsplat --help.")
        text = told.getvalue()
        print(short_help(text, f"{prog} {arguments[0]}") if prog == "flowsplat" else text, end="")
        raise
    except KeyboardInterrupt as error:
        if whole_process:  # a second Ctrl-C would be a traceback of whatever the interpreter is closing
            ignore_signals()
        with contextlib.suppress(OSError):  # of a terminal that is closed
            report("Stopped. The same command continues from here.")
        sys.exit(128 + (error.signal if isinstance(error, Stopped) else 2))
    except BrokenPipeError:
        os._exit(0)
    except OSError as error:
        if error.filename is None:
            raise
        _fail(f"{os.fsdecode(error.filename) if isinstance(error.filename, bytes) else error.filename}: {error.strerror}.")
    else:
        if ended_well is False:
            sys.exit(1)


class _Deferred:
    """Runs the chosen command only after parsing, so that parsing errors can be told from its own output."""

    def __init__(self) -> None:
        self._chosen: Any = None

    def wrap(self, function: Any) -> Any:
        """Return the function with the same signature, which only remembers its arguments."""
        import functools

        @functools.wraps(function)
        def remember(*args: Any, **kwargs: Any) -> None:
            self._chosen = functools.partial(function, *args, **kwargs)

        return remember

    def run(self) -> Any:
        """Run what was chosen, and return what it does."""
        return None if self._chosen is None else self._chosen()


def _fail(message: str) -> None:
    report(f"Error: {one_line(message)}")
    sys.exit(2)

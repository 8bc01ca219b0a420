"""Several commands in one other process: importing takes longer than most of them."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence

PROGRAM = """
import contextlib, io, json, sys
from flowsplat.cli import main
told = []
for words in json.loads(sys.argv[1]):
    code, out, error = 0, io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
        try:
            main(words)
        except SystemExit as end:
            code = end.code or 0
    told.append((code, out.getvalue(), error.getvalue()))
print(json.dumps(told))
"""


def call_in_one_process(
    commands: Sequence[Sequence[object]], before: Sequence[str] = (), environment: Mapping[str, str] | None = None
) -> list[tuple[int, str, str]]:
    """The exit code, stdout and stderr of each.

    Args:
        before: words before the program, which change what it sees.
        environment: of the process; None = that of this one.
    """
    words = json.dumps([[str(word) for word in command] for command in commands])
    command = [*before, sys.executable, "-c", PROGRAM, words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, env=environment)
    assert done.returncode == 0, done.stderr
    return [(code, out, error) for code, out, error in json.loads(done.stdout.splitlines()[-1])]

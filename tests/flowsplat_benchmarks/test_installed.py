"""``flowsplat benchmark`` finds the benchmarks where they are installed, and says how to get them where they are not."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import flowsplat_benchmarks
from flowsplat.cli import main

COMMANDS = Path(flowsplat_benchmarks.__file__).parent / "commands"


def test_every_file_of_the_folder_is_a_command(capsys):
    with pytest.raises(SystemExit) as end:
        main(["benchmark", "--help"])
    assert end.value.code == 0
    listed = capsys.readouterr().out.partition("{")[2].partition("}")[0].split(",")
    assert sorted(listed) == sorted(path.stem for path in COMMANDS.glob("[!_]*.py"))


@pytest.mark.parametrize("arguments", [[], ["--help"], ["davis", "DATA"]])
def test_without_them_a_line_says_how_to_get_them(monkeypatch, capsys, arguments):
    monkeypatch.setitem(sys.modules, "flowsplat_benchmarks", None)
    with pytest.raises(SystemExit) as end:
        main(["benchmark", *arguments])
    assert end.value.code == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert len(told.err.splitlines()) == 1
    assert "pip install -e ." in told.err


def test_without_them_everything_else_is_there(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "flowsplat_benchmarks", None)
    with pytest.raises(SystemExit) as end:
        main(["--help"])
    assert end.value.code == 0
    assert "benchmark" in capsys.readouterr().out


def test_other_commands_do_not_import_them():
    code = "import sys; sys.argv[1:] = ['--version']; from flowsplat.cli import main; import flowsplat.pipeline; main(); "
    code += "print([name for name in sys.modules if name.startswith('flowsplat_benchmarks')])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"

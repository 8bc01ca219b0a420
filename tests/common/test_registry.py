"""Registries: what registers itself is found, by folder and by entry point, and what others break breaks nothing else."""

import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Any

import pytest
import tyro

from flowsplat.common.errors import InputError
from flowsplat.common.registry import Entry, Registry

Make = Callable[..., Registry[Any]]

HEAD = "from registry_under_test import CURVES\n"


@pytest.fixture
def curves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Make]:
    """A registry with a folder of two members, and a package beside it with as many entry points as are written into it."""
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "registry_under_test.py").write_text(
        "from flowsplat.common.registry import Registry\n"
        "CURVES = Registry('curve', 'curves_under_test', 'flowsplat.curves_under_test')\n"
    )
    folder = tmp_path / "curves_under_test"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "one.py").write_text(HEAD + "@CURVES.register('line', 'Line', 'Is straight.')\ndef line(x):\n    return x\n")
    (folder / "two.py").write_text(HEAD + "@CURVES.register('bend', 'Bend', 'Is not.', place=1)\ndef bend(x):\n    return -x\n")
    info = tmp_path / "others-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: others\nVersion: 1.0\n")

    def with_points(**modules: str) -> Registry[Any]:
        lines = ["[flowsplat.curves_under_test]"]
        for name, source in modules.items():
            (tmp_path / f"others_{name}.py").write_text(source)
            lines.append(f"{name} = others_{name}")
        (info / "entry_points.txt").write_text("\n".join(lines))
        from registry_under_test import CURVES  # type: ignore[import-not-found]

        found: Registry[Any] = CURVES
        return found

    yield with_points
    for name in [name for name in sys.modules if name.startswith(("registry_under", "curves_under", "others_"))]:
        del sys.modules[name]


def test_what_is_in_the_folder_and_what_others_add_is_there_in_order(curves: Make) -> None:
    found = curves(step=HEAD + "@CURVES.register('step', 'Step', 'Jumps.')\ndef step(x):\n    return x > 0\n")
    assert found.names() == ("bend", "line", "step")
    assert found["step"](2)
    assert found.entry("line").sentence == "Is straight."
    assert "bend" in found
    assert "x" not in found


def test_threads_that_ask_at_once_all_get_all(curves: Make) -> None:
    found = curves(late="import time\ntime.sleep(0.3)\n" + HEAD + "CURVES.register('late', 'Late', 'Takes long.')(abs)\n")
    together = threading.Barrier(4)

    def ask() -> tuple[str, ...]:
        together.wait()
        return found.names()

    with ThreadPoolExecutor(4) as pool:
        answers = [pool.submit(ask) for _ in range(4)]
    assert {answer.result() for answer in answers} == {("bend", "late", "line")}


def test_a_member_may_ask_while_it_is_imported(curves: Make) -> None:
    found = curves(asks=HEAD + "SEEN = CURVES.names()\nCURVES.register('asks', 'Asks', 'Looks round.')(abs)\n")
    assert found.names() == ("bend", "asks", "line")
    assert sys.modules["others_asks"].SEEN == ("bend", "line")


def test_an_unknown_name_is_refused_with_those_that_there_are(curves: Make) -> None:
    with pytest.raises(InputError, match="Unknown curve 'curl': choose one of bend, line"):
        curves()["curl"]


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("raise OSError('no\\nsuch thing')", "no"),
        ("import surely_not_there", "surely_not_there"),
        (HEAD + "@CURVES.register('line', 'L', 'l')\ndef f(x): pass\n", "already"),
        (HEAD + "@CURVES.register('half', 'L', 'l')\ndef f(x): pass\n1 / 0\n", "division"),
        ("raise SystemExit(3)", "3"),
    ],
)
def test_what_others_break_is_left_out(curves: Make, source: str, reason: str, capsys: pytest.CaptureFixture[str]) -> None:
    found = curves(bad=source, good=HEAD + "@CURVES.register('step', 'Step', 'Jumps.')\ndef step(x):\n    return x > 0\n")
    assert found.names() == ("bend", "line", "step")
    assert found["line"](3) == 3
    told = capsys.readouterr()
    assert "curve bad of package others is left out" in told.out + told.err
    assert reason in told.out + told.err


def test_an_option_takes_the_names_and_its_help_says_what_they_are(curves: Make, capsys: pytest.CaptureFixture[str]) -> None:
    found = curves(step=HEAD + "@CURVES.register('step', 'Step', 'Jumps.')\ndef step(x):\n    return x > 0\n")

    def draw(kind, others=("line",)):  # type: ignore[no-untyped-def]
        return kind, others

    draw.__annotations__ = {
        "kind": Annotated[str, found.option()], "others": Annotated[tuple[str, ...], found.option(are_many=True)]
    }  # fmt: skip
    assert tyro.cli(draw, args=["--kind", "step", "--others", "bend", "line"]) == ("step", ("bend", "line"))
    assert tyro.cli(draw, args=["--kind", "bend"]) == ("bend", ("line",))
    for arguments, words in ((["--kind", "curl"], "curl"), (["--help"], "line: Is straight. step: Jumps. (default: line)")):
        with pytest.raises(SystemExit):
            tyro.cli(draw, args=arguments)
        told = capsys.readouterr()
        assert words in " ".join((told.out + told.err).replace("│", " ").split())


def test_names_that_are_values_only_may_begin_with_a_digit() -> None:
    curves: Registry[int] = Registry("curve", are_values=True)
    curves.add(Entry("1st", "First", "Is first.", 1))
    assert curves["1st"] == 1
    with pytest.raises(ValueError, match="cannot be the name of a curve"):
        curves.add(Entry("12", "Twelve", "Is a number.", 12))


@pytest.mark.parametrize("name", ["", "Line", "a b", "../up", "-x", "1st", "a--b", "a.b", "ä"])
def test_names_that_could_be_no_option_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match="cannot be the name of a curve"):
        Registry[None]("curve").add(Entry(name, "", "", None))

"""flowsplat tracks as a person calls it: points by pixel, files that others can read, bad input in one line."""

from __future__ import annotations

import json

import numpy as np
import pytest

from flowsplat.cli import main
from tests.output.tiny import FRAMES, OBJECT, WALL, tiny_run

ON_WALL = "60.5,5.5,3"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return tiny_run(tmp_path_factory.mktemp("tracks") / "out")


def call(*arguments: object) -> None:
    main(["tracks", *(str(argument) for argument in arguments)])


def refuse(capsys, *arguments: object) -> str:
    with pytest.raises(SystemExit) as end:
        call(*arguments)
    assert end.value.code == 2
    return capsys.readouterr().err.strip().splitlines()[-1]


def test_points_from_the_command_line(run, capsys):
    """The ball starts at x = -0.5 and goes to the right by 1 over the clip."""
    call(run, "--at", "19.2,24.0,0", ON_WALL)
    assert "2 of 2 points" in capsys.readouterr().err
    value = json.loads((run / "export" / "tracks.json").read_text())
    points = np.array(value["points"])
    assert points.shape == (2, FRAMES, 3)
    assert value["queries"] == [[19.2, 24.0, 0], [60.5, 5.5, 3]]
    np.testing.assert_allclose(points[0, :, 0], np.linspace(-0.5, 0.5, FRAMES), atol=1e-3)
    np.testing.assert_allclose(points[0, :, 2], OBJECT, rtol=1e-3)
    np.testing.assert_allclose(points[1, :, 2], WALL, rtol=1e-3)
    assert all(value["visible"][1])
    assert value["object_ids"] == [2, 0]


def test_points_one_by_one(run, tmp_path):
    call(run, "--at", "19.2,24.0,0", "--at", ON_WALL, "3,3,0", "-o", tmp_path / "tracks.json")
    assert json.loads((tmp_path / "tracks.json").read_text())["queries"] == [[19.2, 24, 0], [60.5, 5.5, 3], [3, 3, 0]]


@pytest.mark.parametrize("name", ["points.json", "points.txt"])
def test_points_from_a_file(run, tmp_path, name):
    text = "[[19.2, 24, 0], [60.5, 5.5, 3]]" if name.endswith("json") else "# u, v, frame\n19.2, 24, 0\n\n60.5,5.5,3\n"
    (tmp_path / name).write_text(text)
    call(run, "--queries", tmp_path / name, "-o", tmp_path / "tracks.npz")
    with np.load(tmp_path / "tracks.npz") as found:
        assert found["points"].shape == (2, FRAMES, 3)
        assert found["visible"].shape == (2, FRAMES)
        np.testing.assert_array_equal(found["queries"], [[19.2, 24, 0], [60.5, 5.5, 3]])
        assert len(found["timestamps"]) == FRAMES
        assert found["object_ids"].tolist() == [2, 0]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "No point to follow"),
        (("--at", "1,2"), "--at 1,2 is no point: give u,v,frame"),
        (("--at", "a,b,c"), "is no point"),
        (("--at", "nan,3,0"), "is outside the image of 64x48"),
        (("--at", "64,3,0"), "is outside the image"),
        (("--at", "3,3,9"), "there is no frame 9, they count from 0 to 8"),
        (("--at", "3,3,1.5"), "there is no frame 1.5"),
        (("--at", "3,3,0", "-o", "tracks.csv"), "neither .json nor .npz"),
        (("--queries", "missing.txt"), "does not exist"),
        (("--queries", "missing.json"), "does not exist"),
        (("--queries", "object.json"), "Expected `array`"),
        (("--queries", "short.json"), "number 2 is no point"),
    ],
)
def test_bad_input_is_one_line(run, tmp_path, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "object.json").write_text("{}")
    (tmp_path / "short.json").write_text("[[1, 2, 0], [1, 2]]")
    error = refuse(capsys, run, *arguments)
    assert error.startswith("Error: ")
    assert words in error


def test_without_a_trained_scene(tmp_path, capsys):
    assert "no trained scene yet" in refuse(capsys, tiny_run(tmp_path / "out", trained=False), "--at", "3,3,0")

"""``flowsplat demo`` as a user calls it."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from flowsplat.cli import main
from flowsplat.pipeline import demo
from flowsplat.scenes import Scene

SMALL = ("--size", "96", "--frames", "14")


def call(capsys, *arguments: object) -> tuple[int, str]:
    """Exit code and stderr of a command."""
    code = 0
    try:
        main(["demo", *map(str, arguments)])
    except SystemExit as end:
        code = int(end.code or 0)
    return code, capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("world", ["street", "floating"])
def test_a_demo_ends_with_one_screen(world, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(demo, "DEMO_ITERATIONS", 20)
    monkeypatch.setattr(demo, "TRUE_ITERATIONS", {"street": 10, "floating": 10})
    out = tmp_path / "a demo"
    code, told = call(capsys, "-o", out, "--world", world, *SMALL)
    assert code == 0, told
    screen = told[told.index("Made in") :].splitlines()
    assert len(screen) <= 10
    assert max(map(len, screen)) < 200 + len(str(out)) * 2
    text = " ".join(screen)
    assert str(out / "clip.mp4") in text
    assert re.search(r"Along the path: .* at \d+\.\d dB", text)
    assert re.search(r"From aside: .* \d+\.\d dB", text)
    assert str(out / "own" / "report.html") in text
    assert str(out / "compare.html") in text
    assert (out / "compare.html").read_text().count("<video ") == 2
    assert f"flowsplat view '{out / 'own'}'" in text
    assert f"flowsplat export '{out / 'own'}' --to html" in text
    for name in ("own", "true"):
        assert (out / name / "report.html").exists()
        assert json.loads((out / name / "metrics.json").read_text())["heldout_views"]["psnr"] > 5
    # The video was made of the frames that the truth holds, and the run has its truth and views to measure with.
    own, truth = Scene(out / "own" / "scene"), Scene(out / "truth")
    assert own.num_frames == truth.num_frames == 14
    assert len(own.views) == len(truth.views)
    assert own.truth is not None
    # Called again it has nothing to do but to say the same, and another clip is not taken for this one.
    before = (out / "own" / "metrics.json").read_bytes()
    code, again = call(capsys, "-o", out, "--world", world, *SMALL)
    assert code == 0
    assert again[again.index("  Along the path") :] == told[told.index("  Along the path") :]
    assert (out / "own" / "metrics.json").read_bytes() == before
    other = "floating" if world == "street" else "street"
    for changed in (("--world", other, *SMALL), ("--world", world, "--size", "112", "--frames", "14")):
        code, told = call(capsys, "-o", out, *changed)
        assert code == 2
        assert "another world" in told.splitlines()[-1]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--size", 32), "--size 64 to 1920"), (("--size", 4000), "--size 64 to 1920"), (("--frames", 2), "--frames 3 to 1000"),
        (("--frames", 1001), "--frames 3 to 1000"),
    ],
)  # fmt: skip
def test_sizes_and_frames_that_make_no_clip_are_refused(arguments, said, tmp_path: Path, capsys):
    code, told = call(capsys, "-o", tmp_path / "demo", *arguments)
    assert code == 2
    assert len(told.strip().splitlines()) == 1
    assert said in told
    assert not (tmp_path / "demo").exists()


def test_a_world_that_there_is_not_is_refused(tmp_path, capsys):
    code, told = call(capsys, "-o", tmp_path / "demo", "--world", "moon")
    assert code == 2
    assert "street" in told
    assert not (tmp_path / "demo").exists()


@pytest.mark.parametrize(("size", "frames"), [(64, 3), (1920, 3)])
def test_the_smallest_and_the_widest_street_can_be_drawn(size, frames):
    spec, record = demo._clip_of("street", size, frames)
    assert (spec.width, spec.height, spec.frames) == (size, size * 9 // 16, frames)
    assert record["world"] == "street"

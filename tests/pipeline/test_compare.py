"""``flowsplat compare``: what its page holds, what it refuses, and that its videos play in step."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

import flowsplat
from flowsplat.cli import main
from flowsplat.common.errors import InputError
from flowsplat.pipeline.compare import MAX_RUNS, name_folders
from flowsplat.pipeline.fitting import train_key
from flowsplat.pipeline.folder import RunFolder
from tests.browser import Complaints

NASTY = '<b onclick="x">&\''


@pytest.fixture
def runs(finished, tmp_path) -> list[Path]:
    """Two runs of one clip; the second was trained longer, has other figures, and a name that is no HTML."""
    folders = [tmp_path / "own", tmp_path / NASTY]
    for folder in folders:
        shutil.copytree(finished, folder)
    other = RunFolder(folders[1])
    other.config = replace(other.config, train=replace(other.config.train, iterations=40, seed=7))
    other.record["stages"]["train"]["key"] = train_key(other)
    other.save()
    change(folders[1] / "metrics.json", lambda metrics: metrics["heldout_frames"].update(psnr=99.25))
    return folders


def change(path: Path, how) -> None:
    value = json.loads(path.read_text())
    how(value)
    path.write_text(json.dumps(value))


def rows(page: str, title: str) -> dict[str, list[str]]:
    """The rows of the table under a heading, by their first cell, tags left out."""
    part = page[page.index(f"<h2>{title}</h2>") :]
    part = part[: part.index("</section>")]
    found = re.findall(r'<tr><th scope="row">(.*?)</th>(.*?)</tr>', part)
    return {name: re.findall("<td>(.*?)</td>", cells) for name, cells in found}


def test_the_page_shows_figures_settings_images_and_videos(runs):
    path = flowsplat.compare(runs[0], flowsplat.Run(runs[1]))
    assert path == runs[0].parent / "compare.html"
    page = path.read_text()
    psnr = flowsplat.Run(runs[0]).metrics["heldout_frames"]["psnr"]
    figures = rows(page, "Figures")
    assert figures["held-out frames, PSNR"] == [f"{psnr:.2f}", "<b>99.25</b>"], "the best is bold"
    assert len(set(figures["held-out frames, SSIM"])) == 1
    assert rows(page, "Settings that differ") == {"--train.iterations": ["30", "40"], "--train.seed": ["0", "7"]}
    assert page.count("<video ") == 2
    assert page.count('src="data:video/mp4;base64,') == 2
    assert "Held-out frame 9" in page
    assert "Held-out view" in page
    assert 'src="' not in re.sub(r'src="data:(image|video)/[^"]*"', "", page), "nothing lies beside the page"
    assert "<b onclick" not in page
    assert "&lt;b onclick=" in page
    assert "cannot be compared" not in page


def test_equal_settings_are_said(runs):
    shutil.copy(runs[0] / "run.json", runs[1] / "run.json")
    assert "None: all settings are the same." in flowsplat.compare(*runs, out=runs[0].parent / "page.html").read_text()


def test_runs_of_other_frames_are_compared_with_a_warning(runs):
    def as_if_held_out(record):
        record["train"].remove(3)
        record["heldout"].insert(0, 3)

    change(runs[1] / "scene" / "scene.json", as_if_held_out)
    page = flowsplat.compare(*runs).read_text()
    assert "their figures cannot be compared one to one" in page
    assert "Held-out images" not in page


def test_a_video_that_leads_out_of_its_run_is_left_out(runs, tmp_path):
    secret = tmp_path / "secret.mp4"
    (runs[0] / "renders" / "input_path_color.mp4").rename(secret)
    (runs[0] / "renders" / "input_path_color.mp4").symlink_to(secret)
    page = flowsplat.compare(*runs).read_text()
    assert "<video" not in page
    assert "<script" not in page
    assert "held-out frames, PSNR" in page


def test_names_are_as_short_as_they_can_be():
    assert name_folders([Path("/a/run"), Path("/b/run"), Path("/b/other")]) == ["a/run", "b/run", "b/other"]


@pytest.mark.parametrize(
    ("named", "said"),
    [
        ([], "0 run(s) to compare"), (["own"], "1 run(s) to compare"), (["own", "own"], "named twice"),
        (["own", "own/../own"], "named twice"), (["own", "nowhere"], "nowhere is not the folder of a run"),
        (["own", "young"], "was not measured yet"), (["own"] * (MAX_RUNS + 1), "13 run(s)"),
        (["own", "own2", "-o", "own2"], "own2 is a folder"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line(runs, named, said, capsys, monkeypatch):
    monkeypatch.chdir(runs[0].parent)
    shutil.copytree("own", "own2")
    shutil.copytree("own", "young")
    Path("young/metrics.json").unlink()
    with pytest.raises(SystemExit) as end:
        main(["compare", *named])
    assert end.value.code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert said in line
    assert not Path("compare.html").exists()


def test_the_command_writes_the_page(runs, capsys, monkeypatch):
    monkeypatch.chdir(runs[0].parent)
    main(["compare", "own", NASTY, "-o", "pages/two runs.html"])
    assert "Written: pages/two runs.html" in capsys.readouterr().err
    assert Path("pages/two runs.html").read_text().startswith("<!DOCTYPE html>")


def test_a_run_that_is_not_measured_is_refused_from_python(runs):
    (runs[1] / "metrics.json").unlink()
    with pytest.raises(InputError, match="flowsplat evaluate"):
        flowsplat.compare(*map(str, runs))


@pytest.mark.slow
def test_videos_play_in_step(chromium, runs):
    path = flowsplat.compare(*runs)
    page = chromium.new_context(offline=True).new_page()
    complaints = Complaints(page)
    page.goto(path.as_uri())

    def times() -> list[float]:
        return page.evaluate("films.map((film) => film.currentTime)")

    def wait_for(condition: str) -> None:
        for _ in range(200):  # the page lets no text become a script, which playwright would wait with
            if page.evaluate(condition):
                return
            page.wait_for_timeout(50)
        pytest.fail(f"in vain: {condition}, {times()}")

    wait_for("leader !== undefined && films.every((film) => !film.seeking)")
    frame = page.evaluate("frame")
    assert len(times()) == 2
    page.click("#play")
    wait_for("leader.currentTime > 3 * frame")
    assert abs(times()[0] - times()[1]) < 2 * frame
    assert page.text_content("#play") == "Pause"
    page.evaluate("films[1].currentTime = 0")  # one that stays behind is fetched
    wait_for("Math.abs(films[0].currentTime - films[1].currentTime) < 2 * frame && !films[1].seeking")
    page.click("#play")
    wait_for("films.every((film) => film.paused && !film.seeking)")
    assert times()[0] == times()[1], "at rest all show the same frame"
    page.evaluate("bar.value = 5 * frame; bar.dispatchEvent(new Event('input'))")
    wait_for("films.every((film) => !film.seeking)")
    assert times() == pytest.approx([5.5 * frame] * 2, abs=1e-4)
    page.click("h1")
    page.keyboard.press("ArrowLeft")
    wait_for("films.every((film) => !film.seeking)")
    assert times() == pytest.approx([4.5 * frame] * 2, abs=1e-4)
    assert page.evaluate("document.querySelector('h1 b')") is None, "names are text"
    assert complaints == []
    page.context.close()

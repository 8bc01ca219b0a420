"""A clip with cuts in the studio: its shots, clicks in each, their runs, and what came of them."""

from __future__ import annotations

import io
import json
import shutil
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from flowsplat.common.files import write_json
from flowsplat.studio import tasks
from tests.studio.serving import FPS, FRAMES, SIZE, Page, draw_shot, mark, script, serve, write_clip_with_cut
from tests.studio.test_server import choose

SHOTS = [{"start": 0.0, "end": (FRAMES - 1) / FPS}, {"start": FRAMES / FPS, "end": (2 * FRAMES - 1) / FPS}]


@pytest.fixture(scope="module")
def cut_clip(tmp_path_factory) -> Path:
    return write_clip_with_cut(tmp_path_factory.mktemp("cut") / "cut.mp4")


def write_shots(run: Path, finished: Path, count: int = 2) -> None:
    """The folder of a run of both shots, of which the first ``count`` are whole."""
    write_json(run / "shots.json", {"version": 1, "input": "x", "fingerprint": "x", "shots": SHOTS, "notes": []})
    for k in range(count):
        shutil.copytree(finished, run / "shots" / f"{k + 1:02d}")
    shutil.copyfile(finished / "report.html", run / "report.html")


def test_each_shot_of_a_clip_is_shown_and_clicked_on(page, cut_clip):
    name = page.send(cut_clip)[1]["id"]
    looks = page.get(f"/api/projects/{name}/look")
    assert (looks["shots"], looks["has_cuts"], looks["num_frames"]) == (2, True, 2 * FRAMES)
    labels = [label for label, _ in looks["frames"]]
    assert labels == [f"{shot}/{i}" for shot in (1, 2) for i in range(FRAMES) if i != 9], "frame 9 of each is held out"
    assert dict(looks["frames"])["2/3"] == pytest.approx((FRAMES + 3) / FPS, abs=1e-3)
    assert any("The clip has 2 shots, each a scene of its own" in note for note in looks["notes"])
    image = cv2.imdecode(np.frombuffer(page.get(f"/api/projects/{name}/frames/2/3"), np.uint8), cv2.IMREAD_COLOR)
    assert np.abs(image[..., ::-1].astype(int) - draw_shot(1)[3]).mean() < 12
    for wrong in ("3/0", "2/9", "0", "2/99999", "0/1"):
        assert page.ask("GET", f"/api/projects/{name}/frames/{wrong}")[0] in (400, 404)
    squares = [mark((20 + 12) / SIZE[0], 52 / SIZE[1], frame) for frame in ("1/0", "2/0")]
    found = choose(page, name, objects=[{"clicks": [each], "beside": []} for each in squares], contacts=[mark(0.25, 0.66, "2/0")])
    assert [word for word in found["command"].split() if "@" in word] == ["0.25,0.5417@1/0", "0.25,0.5417@2/0", "0.25,0.66@2/0"]
    shares = page.do("POST", f"/api/projects/{name}/masks/2/0", {})["shares"]
    assert shares[0] == 0, "the click on the first object is in the other shot"
    assert shares[1] == pytest.approx(24 * 24 / (SIZE[0] * SIZE[1]), rel=0.2)


def test_a_clip_with_cuts_may_become_one_scene(page, cut_clip):
    """Clicks stay on their moments."""
    name = page.send(cut_clip)[1]["id"]
    choose(page, name, contacts=[mark(0.25, 0.66, "2/1")])
    assert page.get(f"/api/projects/{name}/look")["choices"]["contacts"][0]["frame"] == "2/1"
    assert "--shots off" in choose(page, name, shots="off")["command"]
    looks = page.get(f"/api/projects/{name}/look")
    assert (looks["shots"], looks["has_cuts"]) == (0, True)
    assert looks["choices"]["contacts"][0]["frame"] == FRAMES + 1
    assert page.get(f"/api/projects/{name}")["command"].endswith(f"--contact 0.25,0.66@{FRAMES + 1}")


def test_what_was_chosen_before_there_were_shots_stays_one_scene(tmp_path, cut_clip):
    with serve(tmp_path / "studio") as page:
        name = page.send(cut_clip)[1]["id"]
    record = tmp_path / "studio" / name / "studio.json"
    values = json.loads(record.read_text())
    del values["choices"]["shots"]
    record.write_text(json.dumps(values))
    with serve(tmp_path / "studio") as page:
        assert "--shots off" in page.get(f"/api/projects/{name}")["command"]


TWO_SHOTS = (
    "say('Shot 2 of 2: 1.50 to 2.88 s, in x')\nshots = json.loads({shots!r})\nout.mkdir()\n(out / 'shots').mkdir()\n"
    "(out / 'shots.json').write_text(json.dumps(shots))\n(out / 'report.html').write_text('')\n"
    "for name in ('01', '02'):\n"
    "    (out / 'shots' / name).mkdir()\n"
    "    (out / 'shots' / name / 'run.json').write_text('{{}}')\n"
    "(out / 'shots' / '01' / 'report.html').write_text('')\nsay('Training: 3 of 10')\ntime.sleep(100)\n"
)


def test_a_run_tells_which_shot_it_works_on_and_stops(page, cut_clip, monkeypatch):
    """A report of the shots that are done is none of all."""
    shots = json.dumps({"version": 1, "input": "x", "fingerprint": "x", "shots": SHOTS, "notes": []})
    monkeypatch.setattr(tasks, "PROGRAM", script(TWO_SHOTS.format(shots=shots)))
    name = page.send(cut_clip)[1]["id"]
    page.do("POST", f"/api/projects/{name}/run")
    found = page.wait(name, lambda each: each["standing"] and each["standing"]["line"] == "Training: 3 of 10")
    assert found["standing"]["says"].startswith("Shot 2 of 2: ")
    assert found["standing"]["share"] > 0.4
    assert found["fixed"]
    page.do("POST", f"/api/projects/{name}/stop")
    found = page.wait(name, lambda each: each["state"] != "stopping")
    assert (found["state"], "results" in found) == ("stopped", False)
    assert page.get(f"/api/projects/{name}/look")["shots"] == 2, "its shots are those that the run has found"
    page.do("DELETE", f"/api/projects/{name}")
    assert page.get("/api/projects")["projects"] == []


def ask(page: Page, name: str, action: str, **what: str) -> int:
    return page.ask("POST", f"/api/projects/{name}/{action}", what)[0]


def test_results_of_shots_are_listed_made_and_downloaded(tmp_path, cut_clip, finished):
    studio = tmp_path / "studio"
    with serve(studio) as page:
        name = page.send(cut_clip)[1]["id"]
        run = studio / name / "run"
        write_shots(run, finished, 1)
        assert page.get(f"/api/projects/{name}")["state"] == "stopped"
        shutil.rmtree(run)
        write_shots(run, finished)
        hint = {"depth": 1.0, "sigma": 0.9, "largest_step": 0.1, "cues": [], "number": 1, "hint": "31,23@4"}
        metrics = json.loads((run / "shots" / "02" / "metrics.json").read_text())
        write_json(run / "shots" / "02" / "metrics.json", {**metrics, "objects": [hint]})
        (studio / name / "run.log").write_text("Shot 2 of 2: x\nOrbit: 5 degrees to either side\n")
        found = page.get(f"/api/projects/{name}")
        assert (found["state"], found["fixed"]) == ("done", True)
        first, second = found["results"]["scenes"]
        assert (first["shot"], second["shot"]) == ("01", "02")
        assert second["title"] == f"Shot 2, {SHOTS[1]['start']:.2f} to {SHOTS[1]['end']:.2f} s"
        assert (first["orbit"], second["orbit"]["now"]) == (None, 5.0)
        assert second["frame"].startswith("2/")
        assert [each["frame"] for each in second["hints"]] == ["2/4"]
        assert b"<html" in page.get(second["report"])
        assert "/shots/02/" in second["videos"][0]["link"]
        assert page.get(second["videos"][0]["link"])
        saved = page.ask("GET", f"{second['videos'][0]['link']}&download=1")[2]["Content-Disposition"]
        assert saved.endswith(f"''{name}-02-{second['videos'][0]['file']}")
        for wrong in (
            "run/shots/02/run.json",
            "run/shots/x/report.html",
            "run/shots/02/../01/report.html",
            "run/shots/02/shots/01/report.html",
        ):
            assert page.ask("GET", f"/files/{name}/{wrong}")[0] in (400, 403, 404)
        assert ask(page, name, "export", to="ply") == 400, "of which shot?"
        assert ask(page, name, "export", to="ply", shot="03") == 400
        assert ask(page, name, "render", to="background", shot="../01") == 400
        for to in ("colmap", "npz"):
            page.do("POST", f"/api/projects/{name}/export", {"to": to, "shot": "02"})
        ready = page.wait(name, lambda each: not each["making"] and not each["waiting"], 240)["results"]["scenes"]
        made = [[each["name"] for each in scene["exports"] if each["link"]] for scene in ready]
        assert made == [[], ["npz", "colmap"]]
        links = {each["name"]: each["link"] for each in ready[1]["exports"]}
        assert page.get(links["npz"])[:2] == b"PK"
        packed = page.get(page.ask("GET", links["colmap"])[2]["Location"])
        assert any(each.endswith("cameras.txt") for each in zipfile.ZipFile(io.BytesIO(packed)).namelist())
        said = (studio / name / "run.log").read_text()
        assert f"$ flowsplat export {run}/shots/02 --to npz\n" in said


def test_the_page_that_plays_all_shots_is_made_and_forgotten_with_a_new_run(tmp_path, cut_clip, finished, monkeypatch):
    monkeypatch.setattr(tasks, "PROGRAM", script("say('Written: x')\nsay(f'  their report:    {out}/report.html')\n"))
    studio = tmp_path / "studio"
    with serve(studio) as page:
        name = page.send(cut_clip)[1]["id"]
        run = studio / name / "run"
        write_shots(run, finished)
        page.do("POST", f"/api/projects/{name}/export", {"to": "html"})
        page.wait(name, lambda each: not each["making"] and not each["waiting"])
        assert f"$ flowsplat export {run} --to html\n" in (studio / name / "run.log").read_text()
        (run / "shots" / "02" / "export").mkdir()
        (run / "shots" / "02" / "export" / "scene.ply").write_bytes(b"ply")
        page.do("POST", f"/api/projects/{name}/run")
        page.wait(name, lambda each: each["state"] == "done" and not each["making"] and not each["waiting"])
        assert not (run / "shots" / "02" / "export").exists()

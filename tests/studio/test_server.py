"""What the page asks for, over HTTP: a clip, its frames, masks, a run, its end, and what came of it."""

from __future__ import annotations

import base64
import io
import json
import shutil
import stat
import time
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.common.files import write_json
from flowsplat.studio import tasks
from flowsplat.studio.choices import read_config
from flowsplat.studio.options import StudioOptions
from flowsplat.studio.server import StudioServer
from tests.output.viewer.browser import free_port
from tests.studio.serving import FRAMES, SIZE, Page, mark, script, serve

DONE = "out.mkdir(exist_ok=True)\n(out / 'report.html').write_text('')\nsay(f'  its report:      {out}/report.html')\n"
REFUSED = "say(json.dumps(['flowsplat', *arguments]))\nsay('Error: that was all.')\nsys.exit(2)\n"
LONG = (
    "stopped = 'Stopped. The same command continues from here.'\n"
    "signal.signal(signal.SIGTERM, lambda *_: (time.sleep(.3), say(stopped), sys.exit(143)))\n"
    "out.mkdir(exist_ok=True)\n(out / 'run.json').write_text('{}')\nsay('Training: 3 of 10')\ntime.sleep(100)\n"
)


def choose(page: Page, name: str, **changes: object) -> dict:
    choices = {**page.get(f"/api/projects/{name}")["choices"], **changes}
    return page.do("PUT", f"/api/projects/{name}/choices", choices)


def test_a_clip_is_taken_shown_and_cut(page, clip):
    status, found = page.send(clip, "my walk é.mp4")
    assert status == 201
    assert (found["name"], found["state"], found["fixed"]) == ("my walk é.mp4", "draft", False)
    name = found["id"]
    assert page.get(found["clip"]) == clip.read_bytes()
    poster = cv2.imdecode(np.frombuffer(page.get(found["poster"]), np.uint8), cv2.IMREAD_COLOR)
    assert poster.shape == (SIZE[1], SIZE[0], 3)
    looks = page.get(f"/api/projects/{name}/look")
    assert (looks["num_frames"], looks["shots"], looks["has_cuts"]) == (FRAMES, 0, False)
    assert looks["duration"] == pytest.approx(FRAMES / 8, abs=1e-3)
    numbers = [number for number, _ in looks["frames"]]
    assert len(numbers) < FRAMES, "held-out frames are none to click on"
    assert looks["estimates"]["fast"]["seconds"] < looks["estimates"]["high"]["seconds"]
    image = cv2.imdecode(np.frombuffer(page.get(f"/api/projects/{name}/frames/4"), np.uint8), cv2.IMREAD_COLOR)
    assert image[52, 20 + 2 * 4 + 12, 2] > 180, "the red square, where it is in frame 4"
    assert page.ask("GET", f"/api/projects/{name}/frames/{FRAMES}")[0] == 400
    choose(page, name, start=0.5, end=1.25)
    cut = page.get(f"/api/projects/{name}/look")
    assert (cut["num_frames"], cut["duration"]) == (7, looks["duration"])
    assert cut["frames"][0] == [0, 0.5]
    assert "--start 0.5 --end 1.25" in page.get(f"/api/projects/{name}")["command"]
    assert "--shots" not in page.get(f"/api/projects/{name}")["command"]
    status, said, _ = page.ask("PUT", f"/api/projects/{name}/choices", {**cut["choices"], "start": 1.4, "end": 1.45})
    assert status == 400
    assert "at least two frames" in said["error"]
    assert str(clip.parent) not in said["error"]
    assert page.get(f"/api/projects/{name}")["choices"]["start"] == 0.5, "what was chosen before stays"
    (summary,) = page.get("/api/projects")["projects"]
    assert summary["id"] == name


def test_a_click_shows_its_mask_at_once(page, clip):
    """Of the red square and of little else. An object without a click on it is none, and other frames show nothing."""
    name = page.send(clip)[1]["id"]
    square = mark((20 + 12) / SIZE[0], 52 / SIZE[1])
    choose(page, name, objects=[{"clicks": [square], "beside": []}])
    found = page.do("POST", f"/api/projects/{name}/masks/0", {})
    data = np.frombuffer(base64.b64decode(found["image"].split(",")[1]), np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    assert image.shape == (SIZE[1], SIZE[0], 4)
    shown = image[..., 3] > 0
    truth = np.zeros_like(shown)
    truth[40:64, 20:44] = True
    assert (shown & truth).sum() / (shown | truth).sum() > 0.8
    assert found["shares"][0] == pytest.approx(shown.mean(), abs=1e-6)
    wall = mark(0.9, 0.15)
    choose(page, name, objects=[{"clicks": [], "beside": [wall]}, {"clicks": [square], "beside": []}])
    assert page.do("POST", f"/api/projects/{name}/masks/0", {})["shares"] == [0.0, found["shares"][0]]
    assert page.do("POST", f"/api/projects/{name}/masks/2", {})["shares"] == [0.0, 0.0]


def test_clicks_that_contradict_each_other_are_a_sentence(page, clip):
    name = page.send(clip)[1]["id"]
    place = mark(0.25, 0.5)
    choose(page, name, objects=[{"clicks": [place], "beside": [place]}])
    status, said, _ = page.ask("POST", f"/api/projects/{name}/masks/0", {})
    assert status == 400
    assert "the opposite of one place" in said["error"]


def test_a_run_goes_through_its_states_and_its_page_is_made(page, tmp_path, clip, monkeypatch):
    kinds = {"run": DONE, "export": "say('Written: x')\n"}
    monkeypatch.setattr(tasks, "PROGRAM", script(f"exec({kinds!r}[arguments[0]])"))
    name = page.send(clip)[1]["id"]
    choose(page, name, contacts=[mark(0.5, 0.7, 2)], preset="default")
    begun = page.do("POST", f"/api/projects/{name}/run")
    assert begun["state"] == "running"
    assert begun["standing"]["left"] > 0
    found = page.wait(name, lambda each: each["state"] == "done" and not each["waiting"] and not each["making"])
    assert found["message"] == ""
    said = (tmp_path / "studio" / name / "run.log").read_text().splitlines()
    begun = [line for line in said if line.startswith("$ flowsplat ")]
    assert [line.split()[2] for line in begun] == ["run", "export"]
    assert begun[1].endswith("--to html")


def test_what_is_shown_is_what_is_started(tmp_path, clip, monkeypatch):
    monkeypatch.setattr(
        tasks, "PROGRAM", script("say(json.dumps(['flowsplat', *arguments]))\nsay('Error: that was all.')\nsys.exit(2)")
    )
    with serve(tmp_path / "studio", run_options="--train.iterations 7") as page:
        name = page.send(clip)[1]["id"]
        shown = choose(page, name, end=1.25, contacts=[mark(0.5, 0.75, 2)])["command"]
        page.do("POST", f"/api/projects/{name}/run")
        found = page.wait(name, lambda each: each["state"] == "failed")
        assert found["message"] == "that was all."
        first, second, *_ = (tmp_path / "studio" / name / "run.log").read_text().splitlines()
        assert first == f"$ {shown}"
        assert " ".join(json.loads(second)) == shown
        assert "--train.iterations 7 --preset fast --end 1.25" in shown


def test_a_run_is_stopped_and_goes_on(page, clip, monkeypatch):
    monkeypatch.setattr(tasks, "PROGRAM", script(LONG))
    name = page.send(clip)[1]["id"]
    page.do("POST", f"/api/projects/{name}/run")
    page.wait(name, lambda each: each["standing"] and each["standing"]["line"] == "Training: 3 of 10")
    assert page.do("POST", f"/api/projects/{name}/stop")["state"] == "stopping"
    assert page.wait(name, lambda each: each["state"] != "stopping")["state"] == "stopped"
    assert page.do("POST", f"/api/projects/{name}/run")["state"] == "running"
    page.do("DELETE", f"/api/projects/{name}")
    assert page.ask("GET", f"/api/projects/{name}")[0] == 400


def test_a_run_outlives_its_server_and_is_found_again(tmp_path, clip, monkeypatch):
    """Its address stays the same; the next server knows what it does, and how it ended."""
    go = tmp_path / "go"
    monkeypatch.setattr(tasks, "PROGRAM", script(f"while not pathlib.Path({str(go)!r}).exists(): time.sleep(.05)\n{DONE}"))
    with serve(tmp_path / "studio") as page:
        token = page.cookie.partition("=")[2]
        name, other = page.send(clip)[1]["id"], page.send(clip)[1]["id"]
        page.do("POST", f"/api/projects/{name}/run")
        assert page.do("POST", f"/api/projects/{other}/run")["state"] == "waiting"
    with serve(tmp_path / "studio") as page:
        assert page.cookie.partition("=")[2] == token
        states = {each["id"]: each["state"] for each in page.get("/api/projects")["projects"]}
        assert states == {name: "running", other: "waiting"}
    go.touch()
    end = time.monotonic() + 20
    while "its report" not in (tmp_path / "studio" / name / "run.log").read_text():
        assert time.monotonic() < end
        time.sleep(0.05)
    with serve(tmp_path / "studio") as page:
        assert page.wait(name, lambda each: each["state"] != "running")["state"] == "done"
        assert page.wait(other, lambda each: each["state"] not in ("waiting", "running"))["state"] == "done"


def test_a_run_that_was_cut_off_says_so(tmp_path, clip, monkeypatch):
    monkeypatch.setattr(tasks, "PROGRAM", script("say('Training: 3 of 10')\nimport os\nos.kill(os.getpid(), 9)"))
    with serve(tmp_path / "studio") as page:
        name = page.send(clip)[1]["id"]
        page.do("POST", f"/api/projects/{name}/run")
        found = page.wait(name, lambda each: each["state"] == "failed")
        assert "cut off" in found["message"]
        monkeypatch.setattr(tasks, "PROGRAM", script("raise ValueError('of its own')"))
        page.do("POST", f"/api/projects/{name}/run")
        found = page.wait(name, lambda each: each["state"] == "failed")
        assert "ValueError: of its own" in found["message"]


def finish(studio: Path, page: Page, clip: Path, finished: Path) -> str:
    """A scene whose run is done."""
    name = page.send(clip)[1]["id"]
    shutil.copytree(finished, studio / name / "run")
    return str(name)


def test_results_are_listed_and_downloaded(tmp_path, clip, finished):
    with serve(tmp_path / "studio") as page:
        name = finish(tmp_path / "studio", page, clip, finished)
        found = page.get(f"/api/projects/{name}")
        assert (found["state"], found["fixed"]) == ("done", True)
        results, (scene,) = found["results"], found["results"]["scenes"]
        assert b"<html" in page.get(results["report"])
        assert (scene["shot"], scene["title"]) == ("", "")
        video = scene["videos"][0]
        whole = page.get(video["link"])
        status, part, headers = page.ask("GET", video["link"], headers={"Range": "bytes=10-19"})
        assert (status, part) == (206, whole[10:20])
        assert headers["Content-Type"] == "video/mp4"
        saved = page.ask("GET", f"{video['link']}&download=1")[2]["Content-Disposition"]
        assert saved == f"attachment; filename*=UTF-8''{name}-{video['file']}"
        names = [each["name"] for each in scene["exports"]]
        assert {"html", "ply", "npz", "colmap"} <= set(names)
        assert all(each["link"] is None for each in scene["exports"])
        status, said, _ = page.ask("POST", f"/api/projects/{name}/export", {"to": "nothing"})
        assert (status, said["error"][:14]) == (400, "Unknown format")
        status, said, _ = page.ask("PUT", f"/api/projects/{name}/choices", {**found["choices"], "preset": "high"})
        assert status == 400
        assert "another version" in said["error"]
        copy = page.do("POST", f"/api/projects/{name}/copy")
        assert (copy["state"], copy["name"], copy["fixed"]) == ("draft", clip.name, False)
        assert page.get(copy["clip"]) == clip.read_bytes()


def test_the_video_without_what_moves_is_made_by_a_command(tmp_path, clip, finished, monkeypatch):
    """Which is offered as long as it is not there, and where something moves."""
    assert all(read_config(each.options) for each in tasks.RENDERINGS.values()), "flowsplat takes them"
    monkeypatch.setattr(tasks, "PROGRAM", script("say(f'Videos: {out}/renders')"))
    with serve(tmp_path / "studio") as page:
        draft, name = page.send(clip)[1]["id"], finish(tmp_path / "studio", page, clip, finished)
        run = tmp_path / "studio" / name / "run"
        metrics = json.loads((run / "metrics.json").read_text())
        write_json(run / "metrics.json", {**metrics, "objects": []})
        assert page.get(f"/api/projects/{name}")["results"]["scenes"][0]["renderings"] == []
        moving = {"depth": 1.0, "sigma": 0.1, "largest_step": 0.1, "cues": []}
        write_json(run / "metrics.json", {**metrics, "objects": [moving]})
        first, second = page.get(f"/api/projects/{name}")["results"]["scenes"][0]["renderings"]
        assert first["command"].endswith("--render.paths input --render.parts background")
        assert page.ask("POST", f"/api/projects/{name}/render", {"to": "nothing"})[0] == 400
        assert page.ask("POST", f"/api/projects/{draft}/render", {"to": "background"})[0] == 400, "there is no scene yet"
        page.do("POST", f"/api/projects/{name}/render", {"to": "background"})
        page.wait(name, lambda each: not each["making"] and not each["waiting"])
        assert f"$ {first['command']}\n" in (tmp_path / "studio" / name / "run.log").read_text()
        files = json.loads((run / "renders" / "renders.json").read_text())
        made = {"key": "x", "fps": 8.0, "frames": 1, "files": ["input_path_background.mp4"]}
        write_json(run / "renders" / "renders.json", {**files, "input_path_background": made})
        assert page.get(f"/api/projects/{name}")["results"]["scenes"][0]["renderings"] == [second]


def test_an_export_that_is_a_folder_is_packed(tmp_path, clip, finished):
    with serve(tmp_path / "studio") as page:
        name = finish(tmp_path / "studio", page, clip, finished)
        assert page.ask("GET", f"/pack/{name}/colmap")[0] == 400
        page.do("POST", f"/api/projects/{name}/export", {"to": "colmap"})
        ready = page.wait(name, lambda each: not each["making"] and not each["waiting"], 120)
        (link,) = (each["link"] for each in ready["results"]["scenes"][0]["exports"] if each["name"] == "colmap")
        status, _, headers = page.ask("GET", link)
        assert status == 302
        names = zipfile.ZipFile(io.BytesIO(page.get(headers["Location"]))).namelist()
        assert any(each.endswith("cameras.txt") for each in names), names
        assert all(each.startswith("colmap/") for each in names)


def test_nobody_else_reads_the_token_and_one_server_has_the_folder(tmp_path):
    studio = tmp_path / "studio"
    with serve(studio):
        assert stat.S_IMODE((studio / ".token").stat().st_mode) == 0o600
    (studio / ".token").chmod(0o644)
    before = (studio / ".token").read_text()
    with serve(studio):
        assert (studio / ".token").read_text() != before, "others may have read it"


@pytest.mark.parametrize(
    "options", [{"port": 0}, {"max_upload_gb": 0}, {"run_options": "--nothing"}, {"host": "192.0.2.1", "port": 8391}]
)
def test_what_cannot_be_served_is_a_sentence(tmp_path, options):
    with pytest.raises(InputError) as refused:
        StudioServer(tmp_path, StudioOptions(**{"port": free_port(), **options}))
    assert "\n" not in str(refused.value)


def test_a_damaged_project_hides_no_other(tmp_path, clip):
    with serve(tmp_path / "studio") as page:
        name, other = page.send(clip)[1]["id"], page.send(clip)[1]["id"]
    (tmp_path / "studio" / other / "studio.json").write_text("{")
    with serve(tmp_path / "studio") as page:
        assert [each["id"] for each in page.get("/api/projects")["projects"]] == [name]

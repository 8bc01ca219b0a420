"""A clip with cuts becomes a folder of runs, one for each shot; a clip without stays what it was."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import flowsplat
from flowsplat.batch.clips import BatchClip
from flowsplat.batch.run_clip import run_clip
from flowsplat.cli import main
from flowsplat.common.errors import InputError
from flowsplat.geometry import Similarity
from flowsplat.images.video import write_mp4
from flowsplat.pipeline import run_shots
from flowsplat.pipeline.config import RunConfig
from flowsplat.pipeline.folder import RunFolder
from flowsplat.pipeline.shot_list import Place, Shot, read_shots, write_places
from flowsplat.pipeline.shot_places import check_shots, names_frames
from flowsplat.pipeline.shots import config_of
from flowsplat.priors.cameras.same_place import SamePlace
from flowsplat.priors.options import PriorsOptions
from flowsplat.scenes import Scene
from flowsplat.scenes.synthetic import SyntheticScene
from flowsplat.training.trainer import Trainer
from tests.marks import slow

WIDTH, HEIGHT, FPS = 96, 72, 12.0
FAST = (
    "--train.iterations", "6", "--train.checkpoint-every", "3", "--render.paths", "input", "--render.width", "32",
    "--no-final-fit", "--no-refine-poses", "--no-coarse-scene",
)  # fmt: skip


def draw(seed: int, frames: int = 12, first: int = 0) -> list[np.ndarray]:
    scene = SyntheticScene(width=WIDTH, height=HEIGHT, frames=first + frames, fps=FPS, seed=seed)
    return [scene.render(scene.camera(i), scene.timestamps[i]).image for i in range(first, first + frames)]


def title() -> np.ndarray:
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    cv2.putText(image, "PART 2", (8, 42), cv2.FONT_HERSHEY_SIMPLEX, 0.8, (255, 255, 255), 2)
    return image


def write(path: Path, frames: Sequence[np.ndarray]) -> Path:
    write_mp4(path, frames, FPS)
    return path


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Path:
    """Two shots with a title between them."""
    return write(tmp_path_factory.mktemp("cut") / "edited clip.mp4", draw(0) + [title()] * 11 + draw(5))


@pytest.fixture(scope="module")
def single(tmp_path_factory) -> Path:
    return write(tmp_path_factory.mktemp("single") / "clip.mp4", draw(0))


def call(capsys, *arguments: object) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a command."""
    code = 0
    try:
        main([str(argument) for argument in arguments])
    except SystemExit as end:
        code = int(end.code or 0)
    said = capsys.readouterr()
    return code, said.out, said.err


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module")
def stopped(clip, tmp_path_factory) -> Path:
    """A run of the clip that ended in the training of its second shot as a killed process does."""
    out, iterate = tmp_path_factory.mktemp("stopped") / "out", Trainer.iterate

    def die(self):
        if (out / "shots" / "02" / "scene").exists() and self.step == 4:
            raise RuntimeError("killed")
        return iterate(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Trainer, "iterate", die)
        with pytest.raises(RuntimeError, match="killed"):
            main(["run", str(clip), "-o", str(out), *FAST])
    return out


@pytest.fixture(scope="module")
def finished(clip, stopped, tmp_path_factory) -> Path:
    """The same, continued to its end."""
    out = tmp_path_factory.mktemp("finished") / "out"
    shutil.copytree(stopped, out)
    main(["run", str(clip), "-o", str(out), *FAST])
    return out


@pytest.mark.slow
def test_a_run_that_was_killed_in_the_second_shot_goes_on_there(clip, stopped, tmp_path, capsys, monkeypatch):
    assert not (stopped / "shots" / "02" / "model").exists()
    assert json.loads((stopped / "shots" / "02" / "training" / "latest.json").read_text())["step"] == 3
    out = tmp_path / "out"
    shutil.copytree(stopped, out)
    monkeypatch.setattr("flowsplat.pipeline.shots.find_transitions", lambda *_: pytest.fail("looked for cuts again"))
    code, _, told = call(capsys, "run", clip, "-o", out, *FAST)
    assert code == 0
    assert "Going on from step 3 of 6." in told
    before, now = contents(stopped / "shots" / "01"), contents(out / "shots" / "01")
    changed = {name for name in now if before.get(name) != now[name]}
    assert before.keys() == now.keys()
    assert changed <= {"run.json"}  # which counts the seconds that a command worked on it


@pytest.mark.slow
def test_each_shot_is_an_ordinary_run(clip, finished, tmp_path, capsys):
    record = json.loads((finished / "shots.json").read_text())
    assert record["input"] == str(clip)
    assert len(record["shots"]) == 2
    first, second = record["shots"]
    assert first["start"] == 0
    assert first["end"] == pytest.approx(11 / FPS, abs=1e-3)
    assert second["start"] == pytest.approx(23 / FPS, abs=1e-3)
    assert second["end"] == pytest.approx(34 / FPS, abs=1e-3)
    assert sorted(path.name for path in finished.iterdir()) == ["report.html", "shots", "shots.json"]
    assert Scene(finished / "shots" / "02" / "scene").num_frames == 12
    flowsplat.Run(finished / "shots" / "02").model.render(Scene(finished / "shots" / "02" / "scene").cameras[0], 0.0)
    out = tmp_path / "alone"
    seconds = ("--start", second["start"], "--end", second["end"], "--shots", "off")
    assert call(capsys, "run", clip, "-o", out, *seconds, *FAST)[0] == 0
    model = "model/gaussians.safetensors"
    assert (out / model).read_bytes() == (finished / "shots" / "02" / model).read_bytes()


def test_it_says_what_was_left_out_and_the_report_shows_all(finished, clip, capsys, monkeypatch):
    monkeypatch.setattr(Trainer, "run", lambda self: pytest.fail("trained again"))
    code, _, told = call(capsys, "run", clip, "-o", finished, *FAST)
    assert code == 0
    assert "shot 01" in told
    assert "shot 02" in told
    assert "The clip has 2 shots, each a scene of its own (cut at 1.00 s, cut at 1.92 s)" in told
    assert "Left out: 1.00 to 1.83 s, because it is a still image, as a title." in told
    page = (finished / "report.html").read_text()
    for part in (
        "shots/01/report.html",
        "shots/02/report.html",
        "shots/01/renders/input_path_color.mp4",
        "because it is a still image",
    ):
        assert part in page
    assert "Not finished yet" not in page
    assert "Shots 1 and 2 see the same place" in told, "one room, painted in two ways"
    assert "Shots 1 and 2 see the same place" in page
    assert page.count('preload="none" poster="data:image/jpeg') == 2, "seen before it plays"


def test_a_report_of_a_part_says_so(stopped):
    page = (stopped / "report.html").read_text()
    assert "2 shots, each a scene of its own; 1 of them is done." in page
    assert page.count("Not finished yet") == 1


@pytest.mark.parametrize(
    "command", [("view",), ("evaluate",), slow("render"), slow("train"), ("tracks", "--at", "3,3,0"), ("export", "--to", "ply")]
)
def test_commands_on_all_shots_name_them(finished, capsys, command):
    name, *options = command if isinstance(command, tuple) else (command,)
    code, _, told = call(capsys, name, finished, *options)
    assert code == 2
    assert told.count("\n") == 1
    assert "holds 2 shots, each a run of its own: name one, as" in told
    assert "01 (0.00 to 0.92 s), 02 (1.92 to 2.83 s)" in told


def test_python_names_them_too(finished):
    for read in (flowsplat.Run, flowsplat.load):
        with pytest.raises(InputError, match="holds 2 shots"):
            read(finished)


def test_info_tells_of_all_shots(finished, stopped, capsys):
    said = call(capsys, "info", finished)[1]
    assert "2, each a run of its own" in said
    assert said.count("  train: finished") == 2
    assert "Shot 02 (1.92 to 2.83 s)" in said
    said = call(capsys, "info", stopped)[1]
    assert said.count("  train: finished") == 1
    assert said.count("  train: not finished") == 1


def test_a_batch_takes_no_run_of_shots_for_clips(finished, tmp_path):
    from flowsplat.batch.clips import find_clips

    with pytest.raises(InputError, match="no clip"):
        find_clips([finished.parent], RunConfig(), tmp_path)


def test_a_batch_makes_one_record_of_all_shots(finished, clip, tmp_path, monkeypatch):
    config = RunFolder(finished / "shots" / "01").config
    config = replace(config, input=replace(config.input, start=None, end=None))
    attempt = SimpleNamespace(fewer=False, needs=lambda gib: None)
    monkeypatch.setattr(Trainer, "run", lambda self: pytest.fail("trained again"))
    shutil.copytree(finished, tmp_path / "edited")
    record = run_clip(BatchClip("edited", clip, config), tmp_path, None, attempt)
    each = [json.loads((finished / "shots" / name / "metrics.json").read_text()) for name in ("01", "02")]
    assert record["psnr"] == pytest.approx(np.mean([metrics["heldout_frames"]["psnr"] for metrics in each]))
    assert record["gaussians"] == sum(metrics["gaussians"]["total"] for metrics in each)
    assert record["stages"]["train"] == pytest.approx(sum(metrics["seconds"]["train"] for metrics in each))
    assert record["verdict"].startswith("Shot 01: ")
    assert " Shot 02: " in record["verdict"]
    assert record["video"] == "edited/shots/01/renders/input_path_color.mp4"
    assert (tmp_path / record["thumb"]).exists()


@pytest.mark.slow
@pytest.mark.parametrize("start_in_folder", [False, True])
def test_a_clip_without_cuts_is_the_run_that_it_was(single, tmp_path, capsys, start_in_folder):
    """The same files with the same bits, but for times and memory."""
    if start_in_folder:
        (tmp_path / "off").mkdir()
        (tmp_path / "split").mkdir()
    for shots in ("off", "split"):
        assert call(capsys, "run", single, "-o", tmp_path / shots, "--shots", shots, *FAST)[0] == 0
    off, split = contents(tmp_path / "off"), contents(tmp_path / "split")
    timed = ("run.json", "metrics.json", "report.html", "priors.html", "history.json", "events.out.tfevents")
    assert {name for name in off if "tfevents" not in name} == {name for name in split if "tfevents" not in name}
    for name, data in off.items():
        if not any(part in name for part in timed):
            assert split[name] == data, name
    records = [json.loads(each["run.json"]) for each in (off, split)]
    assert records[0]["config"] == records[1]["config"]
    assert records[0]["fingerprint"] == records[1]["fingerprint"]


def test_what_is_no_scene_leaves_one_scene(tmp_path, capsys):
    clip = write(tmp_path / "clip.mp4", draw(0, 9) + [title()] * 12 + draw(5, 9))
    assert run_shots(clip, tmp_path / "out", RunConfig()) is None
    assert "it stays one scene" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_start_and_end_restrict_where_shots_are_looked_for(clip, tmp_path):
    from flowsplat.pipeline.shots import find_shots
    from flowsplat.scenes.clip import InputOptions

    assert find_shots(clip, InputOptions(end=0.95)) is None
    found = find_shots(clip, InputOptions(start=1.2))
    assert found is not None
    assert not isinstance(found, str)
    ((start, end),) = found.spans
    assert start == pytest.approx(23 / FPS, abs=1e-3)  # seconds of the whole input
    assert end == pytest.approx(34 / FPS, abs=1e-3)


def test_settings_that_name_frames_are_of_one_scene(clip, tmp_path):
    from flowsplat.common.settings import with_settings

    for name, value in (
        ("input.holdout_frames", [3]), ("priors.mask_click", ["3,3,0"]), ("priors.given.masks", "masks"),
        ("priors.given.object_depth", "depth"), ("render.bullet_time", 0.0),
    ):  # fmt: skip
        assert run_shots(clip, tmp_path / "out", with_settings(RunConfig(), {name: value})) is None


def test_places_go_to_the_shot_that_they_name():
    """Every kind of them, in the order in which they were given."""
    priors = PriorsOptions(
        mask_click=("0.1,0.5@1/0", "0.2,0.5@2/3", "0.3,0.5@ 2/4=1"), mask_box=("1,2,3,4@2/0",), mask_negative=("9,9@1/2=1",),
        contact=("0.5,0.9@2/11",), same_depth=("3,3@1/4=5,5",), flow="dis",
    )  # fmt: skip
    config = replace(RunConfig(), priors=priors)
    assert not names_frames(config)
    check_shots(priors, 2)
    shots = [Shot(k, k - 1.0, k - 0.5, Path(f"{k:02d}")) for k in (1, 2)]
    first, second = (config_of(shot, config) for shot in shots)
    none = {"mask_click": (), "mask_box": (), "mask_negative": (), "contact": (), "same_depth": ()}
    own = {"mask_click": ("0.1,0.5@0",), "mask_negative": ("9,9@2=1",), "same_depth": ("3,3@4=5,5",)}
    assert first.priors == replace(priors, **{**none, **own})
    own = {"mask_click": ("0.2,0.5@3", "0.3,0.5@4=1"), "mask_box": ("1,2,3,4@0",), "contact": ("0.5,0.9@11",)}
    assert second.priors == replace(priors, **{**none, **own})
    assert (second.input.start, second.input.end) == (1.0, 1.5)


def test_places_of_no_shot_are_refused_before_anything_is_computed(clip, single, stopped, tmp_path, capsys):
    out, before = tmp_path / "out", contents(stopped)
    for source, folder, place, message in (
        (clip, out, "0.5,0.5@3/1", "--contact 0.5,0.5@3/1: there is no shot 3; the clip has 2."),
        (clip, out, "0.5,0.5@2/9", "Shot 2: --contact 0.5,0.5@9: frame 9 is held out"),
        (clip, out, "0.5,0.5@2/40", "Shot 2: --contact 0.5,0.5@40: there is no frame 40"),
        (single, out, "0.5,0.5@1/0", "names shot 1 of a clip with cuts, and this is one scene: give 0.5,0.5@0."),
        (clip, stopped, "0.5,0.5@1", "the clip has 2 shots, so say of which one"),
    ):
        code, _, told = call(capsys, "run", source, "-o", folder, "--contact", place, *FAST)
        assert code == 2
        assert told.strip().splitlines()[-1].startswith("Error: ")
        assert message in told
        assert not out.exists()
    assert contents(stopped) == before


def test_bad_input_leaves_nothing_behind(clip, tmp_path, capsys):
    out = tmp_path / "out"
    for arguments, message in (
        ((tmp_path / "none.mp4",), "does not exist"),
        ((clip, "--start", "9"), "0 of 35 frames"),
        ((clip, "--end", "-1"), "--end"),
        ((clip, "--shots", "some"), "shots"),
        ((clip, "--render.object-depth", "7=1.2", "--render.paths", "none_such"), "none_such"),
    ):
        code, _, told = call(capsys, "run", *arguments, "-o", out, *FAST[:4])
        assert (code, told.strip().splitlines()[-1].startswith("Error: ")) == (2, True), told
        assert message in told
        assert "Traceback" not in told
        assert not out.exists()
    broken = tmp_path / "broken.mp4"
    broken.write_bytes(clip.read_bytes()[:-3000])
    assert call(capsys, "run", broken, "-o", out)[0] == 2
    assert not out.exists()


def test_a_folder_of_shots_takes_no_other_input_and_no_single_scene(clip, single, stopped, tmp_path, capsys):
    before = contents(stopped)
    for arguments, message in (
        ((single,), "belongs to a different input"),
        ((clip, "--resize", "48"), "belongs to a different input"),
        ((clip, "--shots", "off"), "choose another folder with -o to make one scene of all"),
    ):
        code, _, told = call(capsys, "run", *arguments, "-o", stopped, *FAST)
        assert code == 2
        assert message in told.strip().splitlines()[-1]
    assert contents(stopped) == before


EMPTY = '{"version": 1, "input": "a", "fingerprint": "b", "shots": [], "notes": []}'
BACKWARDS = '{"version": 1, "input": "a", "fingerprint": "b", "shots": [{"start": 2, "end": 1}], "notes": []}'


PLACES = (
    '{"version": 1, "input": "a", "fingerprint": "b", "shots": [{"start": 0, "end": 1}, {"start": 1, "end": 2}], "notes": [], '
    '"places": [{"shots": [%s], "similarity": {"scale": %s, "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], '
    '"translation": [0, 0, 0]}, "matches": 9, "pixels": 1, "split_pixels": 1}]}'
)
DAMAGED = ("", "{}", BACKWARDS, EMPTY, "[1]", PLACES % ("1, 3", 1), PLACES % ("2, 1", 1), PLACES % ("1, 2", -1), PLACES % ("1", 1))


def test_shots_of_one_place_are_told_and_kept(tmp_path):
    (tmp_path / "shots.json").write_text(json.dumps({**json.loads(EMPTY), "shots": [{"start": k, "end": k + 1} for k in range(3)]}))
    listed = read_shots(tmp_path)
    assert listed is not None
    assert listed.places is None
    similarity = Similarity(2.0, np.diag([1.0, -1.0, -1.0]), np.array([1.0, 2.0, 3.0]))
    write_places(tmp_path, [Place(1, 3, SamePlace(similarity, 120, 1.5, 2.25))])
    listed = read_shots(tmp_path)
    assert listed is not None
    assert listed.places is not None
    (place,) = listed.places
    assert (place.first, place.second, place.found.matches) == (1, 3, 120)
    assert place.found.similarity.to_json() == similarity.to_json()
    assert listed.remarks == [
        "Shots 1 and 3 see the same place: the cameras of both are known in one world, to about 2.2 pixels by 120 points."
    ]


def test_shots_of_one_place_are_looked_for_again_when_cameras_are_others(finished, clip, tmp_path, capsys, monkeypatch):
    out = Path(shutil.copytree(finished, tmp_path / "out"))
    listed = read_shots(out)
    assert listed is not None
    assert listed.places
    scene = Scene(out / "shots" / "02" / "scene")
    scene.write_cameras([replace(camera, K=camera.K * [[1.1], [1.1], [1]]) for camera in scene.cameras])
    listed = read_shots(out)
    assert listed is not None
    assert listed.places is None
    found = []
    monkeypatch.setattr("flowsplat.pipeline.shots.find_same_place", lambda *scenes: found.append(scenes))
    assert call(capsys, "run", clip, "-o", out, *FAST)[0] == 0
    assert len(found) == 1
    listed = read_shots(out)
    assert listed is not None
    assert listed.places == []


@pytest.mark.parametrize("text", DAMAGED)
def test_a_damaged_record_is_one_line(tmp_path, capsys, clip, text):
    (tmp_path / "shots.json").write_text(text)
    for command in (("run", clip, "-o", tmp_path), ("info", tmp_path), ("evaluate", tmp_path)):
        code, _, told = call(capsys, *command)
        assert (code, told.count("\n")) == (2, 1), told
        assert "shots.json" in told


def test_a_folder_with_one_shot_stands_for_it(finished, tmp_path, capsys):
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    record = json.loads((out / "shots.json").read_text())
    (out / "shots.json").write_text(json.dumps({**record, "shots": record["shots"][:1], "places": []}))
    assert call(capsys, "export", out, "--to", "colmap")[0] == 0
    assert (out / "shots" / "01" / "export").exists()
    assert flowsplat.Run(out).folder == out / "shots" / "01"

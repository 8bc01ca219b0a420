"""Camera paths that somebody adds: in plans, help, titles and the list of names, without a line elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from flowsplat.cli import main
from flowsplat.common.errors import InputError
from flowsplat.common.registry import Entry
from flowsplat.output.report import video_title
from flowsplat.output.videos import RenderOptions, list_rendered, render_videos
from flowsplat.output.videos.paths import PATHS, PathRequest, VideoPath
from flowsplat.output.videos.plans import plan_videos
from flowsplat.pipeline.config import RunConfig, check
from flowsplat.scenes import Scene
from flowsplat.training.checkpoint import load_model
from tests.output.tiny import FRAMES, tiny_run


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tiny_run(tmp_path_factory.mktemp("paths") / "out", size=(32, 24))
    return load_model(folder / "model"), Scene(folder / "scene")


def help_of(capsys, *words: str) -> str:
    with pytest.raises(SystemExit):
        main([*words, "--help"])
    return " ".join(capsys.readouterr().out.split())


def test_an_added_path_is_rendered(run, tmp_path, climb):
    model, scene = run
    (plan,) = plan_videos(model, scene, RenderOptions(paths=("climb",), slow_motion=2.0))
    assert plan.name == "climbed_slow2", "time plays"
    assert len(plan.shots) == 2 * FRAMES - 1
    for camera, own in zip((camera for camera, _ in plan.shots[::2]), scene.cameras, strict=True):
        np.testing.assert_allclose(camera.center, own.center - [0, climb / scene.similarity.scale, 0], atol=1e-6)
    render_videos(model, scene, tmp_path, RenderOptions(paths=("climb",), width=16))
    assert list_rendered(tmp_path) == {"climbed": "climbed.mp4", "climbed_color": "climbed_color.mp4"}
    assert video_title("climbed_slow4_stereo") == "From half a median depth above, 4 times slower, for two eyes"


def test_an_added_path_may_stand_still_and_turn(run, climb):
    model, scene = run
    asked: list[PathRequest] = []

    def note(request: PathRequest):
        asked.append(request)
        return request.own

    PATHS.add(Entry("round", "Round", "Round.", VideoPath(note, "round", stands_still=True, loop_seconds=2, frames=5, kind="gif")))
    (plan,) = plan_videos(model, scene, RenderOptions(paths=("round",), bullet_time=0.25, slow_motion=4.0))
    assert (plan.name, plan.kind, plan.fps, plan.audio_from) == ("round", "gif", 12.5, None)
    assert [t for _, t in plan.shots] == [0.25] * 5
    np.testing.assert_allclose(asked[0].phases, 2 * np.pi * np.arange(5) / 5)
    assert asked[0].moments == [0.25]
    assert asked[0].subject(0.25) == pytest.approx(2.5, rel=0.05)


def test_the_help_says_what_paths_there_are(capsys, climb):
    text = help_of(capsys, "render")
    assert "{" + ",".join(PATHS.names()) + "}" in text
    assert PATHS.names()[:6] == ("input", "stabilized", "orbit", "bullet", "dolly", "wiggle")
    assert "orbit: Round the middle of the clip." in text
    assert "climb: From half a median depth above." in text
    assert "(default: input orbit bullet)" in text


def test_unknown_paths_are_refused_at_once(capsys, tmp_path):
    with pytest.raises(SystemExit) as end:
        main(["run", str(tmp_path / "none.mp4"), "-o", str(tmp_path / "out"), "--render.paths", "input", "spiral"])
    assert end.value.code == 2
    told = capsys.readouterr().err.strip()
    assert len(told.splitlines()) == 1
    assert "spiral" in told
    assert "--render.paths" in told
    with pytest.raises(
        InputError, match="Unknown camera path 'spiral': choose from input, stabilized, orbit, bullet, dolly, wiggle"
    ):
        check(RunConfig(render=RenderOptions(paths=("input", "spiral"))))


def test_two_paths_have_different_files(climb):
    for name, file in (("other", "bullet_time"), ("climb", "other")):
        with pytest.raises(ValueError, match="already"):
            PATHS.add(Entry(name, "", "", VideoPath(lambda request: request.own, file)))

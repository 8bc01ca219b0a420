"""Videos of a scene that is one textured plane, shown by a renderer that needs no training."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import av
import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.gaussians.renderer import Rendering
from flowsplat.geometry import Camera, Similarity
from flowsplat.geometry.cameras import pixel_grid
from flowsplat.output.camera_files import write_camera_file
from flowsplat.output.videos import RenderOptions, list_rendered, read_posters, read_swing, render_videos
from flowsplat.output.videos.amplitudes import SWING_ANGLES
from flowsplat.scenes import Scene
from tests.scene_files import edited

WIDTH, HEIGHT, DEPTH = 64, 48, 4.0

# Said explicitly, because older PyAV do not read the tags of a file: BT.709, limited range in, full range out.
AS_TAGGED = {"src_colorspace": 1, "src_color_range": 1, "dst_color_range": 2}


class Plane:
    """The plane z = DEPTH whose red grows to the right with time; remembers what it was asked for."""

    def __init__(self, blue: float = 0.2):
        self.blue = blue
        self.calls: list[tuple[Camera, float, tuple[Camera, float] | None]] = []

    def render(self, camera: Camera, t: float, flow_to: tuple[Camera, float] | None = None) -> Rendering:
        self.calls.append((camera, t, flow_to))
        grid = pixel_grid(camera.width, camera.height).astype(np.float64)
        rays = camera.unproject(grid, np.ones(grid.shape[:2])) - camera.center
        distance = (DEPTH - camera.center[2]) / rays[..., 2]
        points = camera.center + rays * distance[..., None]
        color = np.stack([np.full(grid.shape[:2], 0.3 + 0.5 * t), np.sin(points[..., 0]) ** 2, 0 * distance + self.blue], -1)
        flow = None if flow_to is None else (flow_to[0].project(points)[0] - grid).astype(np.float32)
        alpha = np.ones(grid.shape[:2], np.float32)
        alpha[:4] = 0
        return Rendering(color.astype(np.float32), alpha, camera.project(points)[1].astype(np.float32), flow)

    def part(self, part: str) -> Plane:
        """Nothing moves: the whole plane is background."""
        return self

    def full_size(self, width: int = WIDTH) -> list[tuple[Camera, float, tuple[Camera, float] | None]]:
        """The calls that made frames, without those that looked for the color scales."""
        return [call for call in self.calls if call[0].width == width]


@pytest.fixture
def scene(tmp_path) -> Scene:
    """Nine frames at 10 a second of a source with 20; the camera moves to the right."""
    times = np.arange(9) / 10
    scene = Scene.create(
        tmp_path / "scene", name="plane", source="test", width=WIDTH, height=HEIGHT, timestamps=times.tolist(), holdout=None,
        source_fps=20.0,
    )  # fmt: skip
    cameras = []
    for t in times:
        viewmat = np.eye(4)
        viewmat[0, 3] = -t
        cameras.append(Camera(viewmat, np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), WIDTH, HEIGHT))
    scene.write_cameras(cameras)
    scene.write_similarity(Similarity(1 / DEPTH))
    return scene


def decode(path: Path) -> tuple[list[np.ndarray], Fraction]:
    with av.open(str(path)) as container:
        rate = container.streams.video[0].average_rate
        assert rate is not None
        frames = list(container.decode(video=0))
    return [frame.reformat(format="rgb24", **AS_TAGGED).to_ndarray() for frame in frames], rate


def test_the_input_path_runs_at_the_rate_of_the_source(scene, tmp_path):
    model = Plane()
    render_videos(model, scene, tmp_path / "renders", RenderOptions(paths=("input",)))
    assert list_rendered(tmp_path / "renders") == {"input_path": "input_path.mp4", "input_path_color": "input_path_color.mp4"}
    frames, rate = decode(tmp_path / "renders" / "input_path_color.mp4")
    assert (len(frames), rate, frames[0].shape) == (17, 20, (HEIGHT, WIDTH, 3))
    assert frames[-1][20, 20, 0] / 255 == pytest.approx(0.3 + 0.5 * 0.8, abs=0.03)
    calls = model.full_size()
    np.testing.assert_allclose([t for _, t, _ in calls], np.arange(17) / 20)
    np.testing.assert_allclose([camera.center[0] for camera, _, _ in calls], np.arange(17) / 20, atol=1e-6)
    for call, following in pairwise(calls):
        assert call[2] is not None
        assert call[2][1] == following[1], "flow leads to the next frame"


def test_panels_show_color_flow_and_depth_to_the_end(scene, tmp_path):
    render_videos(Plane(), scene, tmp_path / "r", RenderOptions(paths=("input",)))
    frames, _ = decode(tmp_path / "r" / "input_path.mp4")
    assert frames[0].shape == (HEIGHT, 3 * WIDTH + 8, 3)
    for frame in (frames[0], frames[8], frames[-1]):
        red, green, blue = frame[24, WIDTH + 36].astype(int)
        assert blue > red, "the camera moves right, so everything flows left: cyan"
        assert green > red
        assert frame[1, WIDTH + 50].max() < 40, "nothing is covered there"
        assert frame[1, 2 * WIDTH + 50].max() < 40


def test_orbit_plays_the_middle_and_bullet_time_stands_still(scene, tmp_path):
    model = Plane()
    render_videos(model, scene, tmp_path, RenderOptions(paths=("orbit", "bullet"), max_frames=7))
    assert list(list_rendered(tmp_path)) == ["orbit", "orbit_color", "bullet_time", "bullet_time_color"]
    calls = model.full_size()
    orbit, bullet = calls[:7], calls[7:]
    np.testing.assert_allclose([t for _, t, _ in orbit], np.arange(5, 12) / 20)
    assert {t for _, t, _ in bullet} == {0.4}
    assert len(bullet) == 7
    for camera, t, _ in orbit + bullet:
        uv, depth = camera.project(np.array([t, 0, DEPTH]))  # what the clip's own camera has in its middle then
        np.testing.assert_allclose(uv, [32, 24], atol=1e-6)
        assert depth == pytest.approx(DEPTH)
    assert len({round(camera.center[0], 6) for camera, _, _ in bullet}) > 3
    assert len(decode(tmp_path / "bullet_time.mp4")[0]) == 7
    swing = read_swing(tmp_path)
    assert swing is not None, "how far they go is kept with them"
    assert swing["degrees"] in SWING_ANGLES
    posters = read_posters(tmp_path, {**list_rendered(tmp_path), "gone": "gone.mp4"})
    assert list(posters) == list(list_rendered(tmp_path)), "what cannot be read has none"
    assert np.abs(posters["orbit_color"].astype(float) - decode(tmp_path / "orbit_color.mp4")[0][0]).mean() < 3


def test_a_width_that_was_given_was_not_measured(scene, tmp_path):
    render_videos(Plane(), scene, tmp_path, RenderOptions(paths=("bullet",), max_frames=2, orbit_angle=5.0))
    assert read_swing(tmp_path) is None


def test_bullet_time_can_be_chosen(scene, tmp_path):
    model = Plane()
    render_videos(model, scene, tmp_path, RenderOptions(paths=("bullet",), max_frames=3, bullet_time=0.0))
    assert {t for _, t, _ in model.full_size()} == {0.0}


def test_a_camera_file(scene, tmp_path):
    shots = [(scene.cameras[0].resize(32, 24), 0.0), (scene.cameras[1].resize(32, 24), 0.5)]
    write_camera_file(tmp_path / "path.json", shots, fps=5)
    options = RenderOptions(paths=(), camera_file=tmp_path / "path.json")
    render_videos(Plane(), scene, tmp_path, options)
    assert list(list_rendered(tmp_path)) == ["custom_path_path", "custom_path_path_color"]
    frames, rate = decode(tmp_path / "custom_path_path_color.mp4")
    assert (len(frames), rate, frames[0].shape) == (2, 5, (24, 32, 3))
    write_camera_file(tmp_path / "my 2nd.json", shots[::-1], fps=5)
    render_videos(Plane(), scene, tmp_path, replace(options, camera_file=tmp_path / "my 2nd.json"))
    assert [name for name in list_rendered(tmp_path) if not name.endswith("_color")] == ["custom_path_path", "custom_path_my-2nd"]


@pytest.mark.parametrize("name", ["path_color", "at_distance_2", "ü" * 100, "𝒫" * 40 + "_slow", "_" * 80])
def test_any_name_of_a_camera_file(scene, tmp_path, name):
    for file in (name, name.replace("_", "-") + "2", "path"):
        write_camera_file(tmp_path / f"{file}.json", [(scene.cameras[0].resize(32, 24), 0.0)], fps=5)
        render_videos(Plane(), scene, tmp_path / "out", RenderOptions(paths=(), camera_file=tmp_path / f"{file}.json"))
    rendered = list_rendered(tmp_path / "out")
    assert len(rendered) == 6, "two videos of each"
    assert sorted(rendered.values()) == sorted(file.name for file in (tmp_path / "out").glob("*.mp4"))


def test_width_and_rate_can_be_chosen(scene, tmp_path):
    model = Plane()
    render_videos(model, scene, tmp_path, RenderOptions(paths=("input",), width=33, fps=5))
    frames, rate = decode(tmp_path / "input_path_color.mp4")
    assert (len(frames), rate, frames[0].shape) == (5, 5, (26, 34, 3))
    camera = model.full_size(33)[0][0]
    assert (camera.width, camera.height) == (33, 25)
    assert camera.K[0, 0] == pytest.approx(60 * 33 / 64)


def test_only_what_changed_is_rendered_again(scene, tmp_path):
    options = RenderOptions(paths=("input", "bullet"), max_frames=4)
    render_videos(Plane(), scene, tmp_path, options)

    again = Plane()
    render_videos(again, scene, tmp_path, options)
    assert len(list_rendered(tmp_path)) == 4
    assert not again.full_size()

    turned = Plane()
    render_videos(turned, scene, tmp_path, replace(options, orbit_angle=9.0))
    assert len(turned.full_size()) == 4, "only bullet time depends on the angle"

    (tmp_path / "input_path_color.mp4").unlink()
    lost = Plane()
    render_videos(lost, scene, tmp_path, replace(options, orbit_angle=9.0))
    assert len(lost.full_size()) == 17

    retrained = Plane(blue=0.8)
    render_videos(retrained, scene, tmp_path, replace(options, orbit_angle=9.0))
    assert len(retrained.full_size()) == 17 + 4
    assert set(json.loads((tmp_path / "renders.json").read_text())) == {"input_path", "bullet_time"}


def test_the_sound_of_the_clip_is_kept(scene, tmp_path):
    with av.open(str(tmp_path / "tone.wav"), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=44100)
        stream.layout = "mono"
        tone = (np.sin(np.arange(44100 * 2) / 10) * 9000).astype(np.int16)
        frame = av.AudioFrame.from_ndarray(tone[None], format="s16", layout="mono")
        frame.sample_rate = 44100
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    shutil.copy(tmp_path / "tone.wav", scene.folder / "tone.wav")
    scene = edited(scene, audio="tone.wav", audio_start=0.5)
    render_videos(Plane(), scene, tmp_path, RenderOptions(paths=("input", "orbit"), max_frames=4))
    for name, streams in (("input_path", 1), ("input_path_color", 1), ("orbit", 0)):
        with av.open(str(tmp_path / f"{name}.mp4")) as container:
            assert len(container.streams.audio) == streams


@pytest.mark.parametrize(
    "audio",
    ["http://127.0.0.1:9/x.mp4", "/etc/hostname", "../tone.wav", "tone.wav", "12:30.mp4", "concat:a|b", ".."],
)
def test_a_scene_names_no_sound_outside_its_folder(scene, tmp_path, audio, monkeypatch):
    """And nothing of the network."""
    opened = []
    monkeypatch.setattr("flowsplat.images.video.open_media", lambda path: opened.append(path))
    (tmp_path / "tone.wav").write_bytes(b"")
    scene = edited(scene, audio=audio, audio_start=0.0)
    assert scene.sound is None
    render_videos(Plane(), scene, tmp_path, RenderOptions(paths=("input",), max_frames=2))
    assert opened == []


def test_a_folder_that_cannot_be_written_is_told(scene, tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="Cannot write"):
        render_videos(Plane(), scene, tmp_path / "file" / "r", RenderOptions(paths=("input",), width=16))


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"paths": ("spiral",)}, "spiral"),
        ({"width": 4}, "wide"),
        ({"fps": 0.0}, "frames a second"),
        ({"fps": float("nan")}, "frames a second"),
        ({"max_frames": 1}, "give 2 to"),
        ({"orbit_angle": 120.0}, "angle"),
        ({"bullet_time": 3.0}, "outside the clip"),
        ({"camera_file": Path("/none/at/all.json")}, "does not exist"),
    ],
)
def test_bad_options_are_refused_before_any_rendering(scene, tmp_path, options, says):
    model = Plane()
    with pytest.raises(InputError, match=says):
        render_videos(model, scene, tmp_path / "r", RenderOptions(**options))
    assert not model.calls

"""What is burnt into a clip is found where the clip moves, and counts for nothing; nothing is found where nothing tells."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from flowsplat.evaluation.scores import score_image
from flowsplat.priors.cameras.stage import CameraOptions, camera_stage
from flowsplat.scenes import Depth, Flow, Scene, Tracks
from flowsplat.scenes.clip import InputOptions
from flowsplat.scenes.ingest import ingest, open_clip
from flowsplat.scenes.overlay import fill_overlay, find_overlay, hide_overlay, look_up_mask

from .conftest import write_image_file, write_video

WIDTH, HEIGHT, FRAMES = 240, 136, 16
Draw = Callable[[np.ndarray, int], np.ndarray]


def scenery(i: int, step: float = 3.0) -> np.ndarray:
    """A wall of blotches in front of which the camera moves to the right, RGB [136, 240, 3] uint8."""
    noise = np.random.default_rng(0).normal(0, 1, (HEIGHT, WIDTH + 200, 3)).astype(np.float32)
    wall = sum(size * cv2.GaussianBlur(noise, (0, 0), size) for size in (1.2, 3.0, 6.0))
    left = round(step * i)
    return np.clip(110 + 60 * wall[:, left : left + WIDTH], 0, 255).astype(np.uint8)


def put(image: np.ndarray, text: str, place: tuple[int, int], color: tuple[int, int, int], alpha: float = 1) -> np.ndarray:
    drawn = cv2.putText(image.copy(), text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.7, color, 2, cv2.LINE_AA)
    return np.rint((1 - alpha) * image + alpha * drawn).astype(np.uint8)


def box(image: np.ndarray, i: int) -> np.ndarray:
    return put(cv2.rectangle(image.copy(), (12, 10), (84, 36), (255, 255, 255), -1), "NEWS", (16, 30), (200, 0, 0))


def half(image: np.ndarray, i: int) -> np.ndarray:
    return put(image, "TV 1", (170, 30), (255, 255, 255), 0.5)


def clock(image: np.ndarray, i: int) -> np.ndarray:
    black = cv2.rectangle(image.copy(), (130, 104), (228, 128), (0, 0, 0), -1)
    return put(black, f"00:{i:02d}:{7 * i % 100:02d}", (134, 123), (255, 255, 255))


def nothing(image: np.ndarray, i: int) -> np.ndarray:
    return image


def drawn_pixels(draw: Draw) -> np.ndarray:
    """[H, W] bool that differ from the image under them in some frame."""
    found = np.zeros((HEIGHT, WIDTH), bool)
    for i in range(FRAMES):
        for level in (0, 255):
            plain = np.full((HEIGHT, WIDTH, 3), level, np.uint8)
            found |= (draw(plain, i) != plain).any(-1)
    return found


@pytest.mark.parametrize("draw", [box, half, clock])
@pytest.mark.parametrize("quality", [None, 70])
def test_what_is_burnt_in_is_found(draw: Draw, quality: int | None):
    images = [draw(scenery(i), i) for i in range(FRAMES)]
    if quality is not None:
        coded = [cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1] for image in images]
        images = [cv2.imdecode(each, cv2.IMREAD_COLOR) for each in coded]
    found, truth = find_overlay(images), drawn_pixels(draw)
    assert found is not None
    assert (found & truth).sum() >= 0.97 * truth.sum()
    near = cv2.dilate(truth.astype(np.uint8), np.ones((25, 25), np.uint8)) > 0
    assert not (found & ~near).any()


def test_two_things_are_both_found():
    found = find_overlay(clock(box(scenery(i), i), i) for i in range(FRAMES))
    assert found is not None
    for draw in (box, clock):
        truth = drawn_pixels(draw)
        assert (found & truth).sum() >= 0.97 * truth.sum()


def still(i: int) -> np.ndarray:
    """The camera stands still, and something passes."""
    image = box(scenery(0), 0)
    image[50:100, 10 * i : 10 * i + 40] = 255 - image[50:100, 10 * i : 10 * i + 40]
    return image


def sky(i: int) -> np.ndarray:
    """A logo before an even sky: a moon would stay, too."""
    image = scenery(i)
    image[:60] = (120, 160, 220)
    return box(image, i)


def rails(i: int) -> np.ndarray:
    """Lines along the motion."""
    image = scenery(i)
    for row in (30, 60, 64, 100):
        image[row : row + 3] = 255
    return image


def hood(i: int) -> np.ndarray:
    """Something that hardly moves before what moves: by two pixels over the clip."""
    image = scenery(i)
    image[20:60, 40 + i // 6 : 100 + i // 6] = scenery(0)[70:110, 40:100]
    return image


def pause(i: int) -> np.ndarray:
    """The camera stands still for most of the clip."""
    return box(scenery(max(0, i - 12)), i)


@pytest.mark.parametrize("scene", [scenery, still, sky, rails, hood, pause])
def test_nothing_is_found_where_nothing_tells(scene: Callable[[int], np.ndarray]):
    assert find_overlay(scene(i) for i in range(FRAMES)) is None


def test_few_frames_and_blank_ones_do_not_tell():
    assert find_overlay(box(scenery(i), i) for i in range(5)) is None
    assert find_overlay(np.zeros((40, 40, 3), np.uint8) for _ in range(12)) is None
    assert find_overlay(iter(())) is None


def test_what_is_filled_is_the_same_whatever_was_there():
    overlay = drawn_pixels(box)
    first, second = (fill_overlay(draw(scenery(0), 0), overlay) for draw in (box, nothing))
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(fill_overlay(first, overlay), first)
    np.testing.assert_array_equal(first[~overlay], scenery(0)[~overlay])
    edges = [np.abs(np.diff(image.astype(int), axis=1))[overlay[:, 1:]].mean() for image in (first, scenery(0))]
    assert edges[0] < 0.7 * edges[1]


def test_flow_from_and_to_what_is_burnt_in_is_not_trusted():
    overlay = np.zeros((4, 6), bool)
    overlay[1, 2] = True
    flow, ones = np.tile(np.float32([1, 0]), (4, 6, 1)), np.ones((4, 6), np.float32)
    expected = ones.copy()
    expected[1, [1, 2]] = 0
    np.testing.assert_array_equal(hide_overlay(overlay, flow, ones), expected)
    assert hide_overlay(None, flow, ones) is ones
    larger = hide_overlay(np.repeat(np.repeat(overlay, 2, 0), 2, 1), flow, ones)  # of the frames, where flow is of half the size
    np.testing.assert_array_equal(larger, expected)
    points = np.array([[2.5, 1.5], [2.0, 1.0], [3.0, 1.5], [-1, 1], [6.5, 1], [np.nan, 1]])
    assert look_up_mask(overlay, points).tolist() == [True, True, False, False, False, False]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for i in range(FRAMES):
        write_image_file(tmp_path / "clip" / "images" / f"{i:05d}.png", box(scenery(i), i))
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        mask[:60, :60] = 255
        write_image_file(tmp_path / "clip" / "masks" / f"{i:05d}.png", mask)
    return tmp_path / "clip"


def prepare(folder: Path, name: str = "scene", **changes) -> Scene:
    options = InputOptions(holdout=8, **changes)
    return ingest(open_clip(folder, options), folder.parent / name, options)


def test_ingest_takes_it_out_and_says_so(folder: Path):
    scene = prepare(folder)
    overlay, truth = scene.overlay, drawn_pixels(box)
    assert overlay is not None
    assert overlay[truth].all()
    said = [note for note in scene.info.notes if "--overlay keep" in note]
    assert len(said) == 1
    assert f"{overlay.mean():.1%}" in said[0]
    for i in (0, 7):
        image, burnt_in = scene.any_frame(i), scene.overlay_frame(i)
        np.testing.assert_array_equal(image, fill_overlay(box(scenery(i), i), overlay))
        assert burnt_in is not None
        assert not burnt_in[~overlay].any()
        np.testing.assert_array_equal(burnt_in[overlay], box(scenery(i), i)[overlay])
    assert not scene.mask(0)[overlay].any()
    assert scene.mask(0)[:60, :60][~overlay[:60, :60]].all()


def test_it_can_be_kept(folder: Path):
    scene = prepare(folder, overlay="keep")
    assert scene.overlay is None
    assert scene.overlay_frame(0) is None
    assert not any("--overlay" in note for note in scene.info.notes)
    np.testing.assert_array_equal(scene.frame(0), box(scenery(0), 0))


def test_held_out_frames_say_nothing_about_it(folder: Path):
    first = prepare(folder).overlay
    write_image_file(folder / "images" / "00007.png", scenery(50))
    second = prepare(folder, "other").overlay
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first, second)


def test_a_stop_in_between_changes_nothing(folder: Path, monkeypatch: pytest.MonkeyPatch):
    whole, write, written = prepare(folder), Scene.write_frame, []

    def stop(self: Scene, i: int, image: np.ndarray) -> None:
        written.append(i)
        if len(written) == FRAMES + 5:
            raise KeyboardInterrupt
        write(self, i, image)

    monkeypatch.setattr(Scene, "write_frame", stop)
    with pytest.raises(KeyboardInterrupt):
        prepare(folder, "stopped")
    monkeypatch.undo()
    scene = prepare(folder, "stopped")
    assert scene.info.notes == whole.info.notes
    for i in range(FRAMES):
        np.testing.assert_array_equal(scene.any_frame(i), whole.any_frame(i))
        np.testing.assert_array_equal(scene.overlay_frame(i), whole.overlay_frame(i))


def test_no_layer_holds_what_is_burnt_in(tmp_path: Path):
    scene = Scene.create(
        tmp_path, name="a", source="a", width=WIDTH, height=HEIGHT, timestamps=[0, 1, 2], holdout=None, source_fps=1
    )
    overlay = drawn_pixels(box)
    scene.write_overlay(overlay)
    ones, zeros = np.ones((HEIGHT, WIDTH), np.float32), np.zeros((HEIGHT, WIDTH, 2), np.float32)
    scene.write_depth(0, Depth(ones, ones))
    scene.write_flow(Flow(0, 1, zeros, ones))
    scene.write_mask(0, ones)
    for known in (scene.depth(0).confidence > 0, scene.flow(0, 1).confidence > 0, scene.mask(0) > 0):
        np.testing.assert_array_equal(known, ~overlay)
    points = np.zeros((1, 3, 2), np.float32)
    points[0] = [[150, 50], [40, 20], [160, 50]]
    scene.write_tracks(Tracks(points, np.ones((1, 3), bool), np.ones((1, 3), np.float32), np.zeros(1, bool)))
    assert scene.tracks.visible.tolist() == [[True, False, True]]
    assert scene.tracks.confidence[0, 1] == 0


def test_it_is_no_proof_that_the_camera_stands(tmp_path: Path):
    """A clock and a logo on half of what has corners."""

    def clip(draw: Draw) -> Scene:
        def dim(i: int) -> np.ndarray:
            image = scenery(i)
            image[:, 100:] = cv2.GaussianBlur(image, (0, 0), 6)[:, 100:]
            return image

        path = write_video(tmp_path / f"{draw.__name__}.mp4", [draw(dim(i), i) for i in range(FRAMES)])
        options = InputOptions(holdout=None)
        scene = ingest(open_clip(path, options), tmp_path / draw.__name__, options)
        camera_stage(scene, CameraOptions())
        return scene

    plain, with_clock = clip(nothing), clip(lambda image, i: clock(box(image, i), i))
    assert with_clock.overlay is not None
    assert plain.overlay is None
    turns = [
        np.degrees(np.arccos(np.clip((np.trace(scene.cameras[-1].viewmat[:3, :3]) - 1) / 2, -1, 1)))
        for scene in (plain, with_clock)
    ]
    steps = [np.linalg.norm(scene.cameras[-1].center) for scene in (plain, with_clock)]
    assert turns[0] + 50 * steps[0] > 1
    assert with_clock.prior("cameras")["static"] == plain.prior("cameras")["static"] is False  # type: ignore[index]


def test_no_figure_is_taken_there():
    rng = np.random.default_rng(0)
    image, target = rng.random((2, 40, 60, 3))
    overlay = np.zeros((40, 60), bool)
    overlay[:20] = True
    moving = np.zeros((40, 60), bool)
    moving[10:30] = True
    changed = image.copy()
    changed[overlay] = 0
    first, second = (score_image(each, target, {"moving": moving}, None, overlay) for each in (image, changed))
    assert first == second
    whole = score_image(image[20:], target[20:], {"moving": moving[20:]}, None)
    assert first["psnr"] == pytest.approx(whole["psnr"])
    assert first["moving"]["psnr"] == pytest.approx(whole["moving"]["psnr"])


def test_clips_without_anything_burnt_in(data: Path):
    """Of DAVIS, lady-running alone has a sign in it."""
    for name in ("bear", "train", "lady-running"):
        options = InputOptions(max_frames=24, holdout=None)
        clip = open_clip(data / "davis" / name, options)
        found = find_overlay(clip.frames(range(clip.num_frames)))
        assert (found is not None) == (name == "lady-running")
    assert found is not None
    assert 0.004 < found.mean() < 0.012
    assert found[24:60, 720:800].mean() > 0.5

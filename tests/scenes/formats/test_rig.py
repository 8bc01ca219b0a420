"""Rig scenes: frames, truth and held-out views by the numbers of the chosen frames."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.scenes.clip import InputOptions
from flowsplat.scenes.formats.rig import open_rig
from flowsplat.scenes.ingest import fingerprint, ingest, kind_of_input

COUNT, WIDTH, HEIGHT = 6, 64, 48
K = [[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]


def pose(x: float) -> list[list[float]]:
    viewmat = np.eye(4)
    viewmat[0, 3] = -x
    return viewmat.tolist()


@pytest.fixture
def rig(tmp_path, make_image, write_image_file) -> Path:
    """Numbers of frames are in every value, so that a mix-up shows."""
    folder = tmp_path / "rig"
    shape = (COUNT, HEIGHT, WIDTH)
    number = np.arange(COUNT).reshape(-1, 1, 1)
    for i in range(COUNT):
        write_image_file(folder / "rgb" / f"{i:05d}.png", make_image(i))
        write_image_file(folder / "masks" / f"{i:05d}.png", np.full((HEIGHT, WIDTH), i, np.uint8))
    cameras = {"K": K, "width": WIDTH, "height": HEIGHT, "w2c": [pose(i) for i in range(COUNT)], "fps": 12}
    (folder / "cameras.json").write_text(json.dumps(cameras))
    np.savez(folder / "depth.npz", depth=np.broadcast_to(number + 5, shape).astype(np.float16))
    flow = np.stack(np.broadcast_arrays(number + np.zeros(shape), number + 0.5), -1).astype(np.float16)
    valid = np.zeros(shape, bool)
    valid[:, :, 32:] = True
    np.savez(folder / "flow.npz", fwd=flow, bwd=-flow, fwd_valid=valid, bwd_valid=~valid)
    points = np.broadcast_to(number, (COUNT, 5, 3)).astype(np.float32)
    visible = np.arange(COUNT)[:, None] >= np.arange(5)
    np.savez(folder / "tracks.npz", points=points, visible=visible, moving=np.arange(5) > 2, birth=np.arange(5))
    times = [0, 4]
    for name in ("left", "up_high"):
        for time in times:
            write_image_file(folder / "heldout" / name / f"{time:05d}.png", make_image(time + 10))
        write_image_file(folder / "heldout" / f"{name}_masks" / "00004.png", np.full((HEIGHT, WIDTH), 3, np.uint8))
        write_image_file(folder / "heldout" / f"{name}_covisible" / "00004.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
    views = {name: {"times": times, "w2c": [pose(time - 2) for time in times]} for name in ("left", "up_high")}
    heldout = {"K": K, "width": WIDTH, "height": HEIGHT, "times": times, "cameras": views}
    (folder / "heldout" / "cameras.json").write_text(json.dumps(heldout))
    return folder


def test_everything_arrives(rig, tmp_path, make_image):
    assert kind_of_input(rig) == "rig"
    scene = ingest(open_rig(rig, InputOptions()), tmp_path / "scene", InputOptions())
    assert scene.train_frames == list(range(COUNT))
    assert scene.heldout_frames == []
    assert scene.info.source_fps == 12
    assert scene.prior("masks") is None
    assert not scene.has_mask(0)
    np.testing.assert_array_equal(scene.frame(3), make_image(3))
    truth = scene.truth
    assert truth is not None
    assert [camera.center[0] for camera in truth.cameras] == list(range(COUNT))
    assert (truth.depth(3).depth == 8).all()
    assert (truth.depth(3).confidence == 1).all()
    assert (truth.mask(4) == 4).all()
    assert len(truth.flow_pairs) == 2 * (COUNT - 1)
    np.testing.assert_array_equal(truth.flow(2, 3).flow[0, 0], [2, 2.5])
    np.testing.assert_array_equal(truth.flow(3, 2).flow[0, 0], [-3, -3.5])
    assert truth.flow(2, 3).trusted[0, [0, 63]].tolist() == [False, True]
    assert truth.flow(3, 2).trusted[0, [0, 63]].tolist() == [True, False]
    tracks = truth.tracks
    assert tracks.points.shape == (5, COUNT, 3)
    assert (tracks.points[:, 4] == 4).all()
    assert tracks.visible[:, 2].tolist() == [True, True, True, False, False]
    assert tracks.moving.tolist() == [False, False, False, True, True]
    views = {view.name: view for view in scene.views}
    assert list(views) == ["left_00000", "left_00004", "up_high_00000", "up_high_00004"]
    view = views["up_high_00004"]
    assert view.frame == 4
    assert view.camera.center[0] == 2
    np.testing.assert_array_equal(scene.view_image(view), make_image(14))
    mask, covisible = scene.view_mask(view), scene.view_mask(view, "covisible")
    assert mask is not None
    assert covisible is not None
    assert mask.all()
    assert covisible.all()
    assert scene.view_mask(views["left_00000"]) is None


def test_chosen_frames(rig, make_image):
    """Frames 2 to 5: truth and views move with their frames."""
    clip = open_rig(rig, InputOptions(start=2 / 12))
    assert clip.num_frames == 4
    np.testing.assert_array_equal(next(clip.frames([1])), make_image(3))
    truth = clip.truth
    assert truth is not None
    assert (truth.depth(1).depth == 8).all()
    assert truth.flow(1, 0).flow[0, 0, 0] == -3
    assert (truth.mask(1) == 3).all()
    assert truth.cameras[1].center[0] == 3
    assert (truth.tracks.points[:, 1] == 3).all()
    assert truth.births.tolist() == [-1, -1, 0, 1, 2]
    assert [(p.view.name, p.view.frame) for p in clip.views()] == [("left_00004", 2), ("up_high_00004", 2)]
    thinned = open_rig(rig, InputOptions(every=2))
    assert thinned.truth is not None
    assert list(thinned.truth.flow_pairs) == []


def test_resized(rig):
    """Half the pixels: half the focal length and half the flow, the same depth."""
    clip = open_rig(rig, InputOptions(resize=32 * 4 // 3))
    truth = clip.truth
    assert truth is not None
    assert (clip.width, clip.height) == (42, 32)
    np.testing.assert_allclose(truth.cameras[0].K[[0, 1], [0, 1]], [60 * 42 / 64, 40])
    assert (truth.depth(2).depth == 7).all()
    np.testing.assert_allclose(truth.flow(2, 3).flow[0, 0], [2 * 42 / 64, 2.5 * 32 / 48])
    image_of_view = next(iter(clip.views()))
    assert image_of_view.image.shape == (32, 42, 3)
    assert (image_of_view.view.camera.width, image_of_view.view.camera.height) == (42, 32)


def test_without_heldout_cameras_frames_are_held_out(rig, tmp_path):
    (rig / "heldout" / "cameras.json").unlink()
    options = InputOptions(holdout=3)
    scene = ingest(open_rig(rig, options), tmp_path / "scene", options)
    assert scene.heldout_frames == [2]
    assert scene.views == []


# -- what cannot be used


def edit(path: Path, **values) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | values))


def refuse(rig: Path, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        ingest(open_rig(rig, InputOptions()), rig.parent / "scene", InputOptions())
    assert "\n" not in str(caught.value)


def test_bad_cameras(rig):
    broken = np.array([pose(i) for i in range(COUNT)])
    broken[2, 0, 0] = 3
    edit(rig / "cameras.json", w2c=broken.tolist())
    refuse(rig, "camera 2 is not finite or not a rotation")


def test_other_number_of_images(rig):
    (rig / "rgb" / "00003.png").unlink()
    refuse(rig, "5 images in rgb/ but 6 cameras")


def test_no_poses(rig):
    (rig / "cameras.json").write_text("[]")
    refuse(rig, "no 'w2c'")


def test_missing_archive(rig):
    (rig / "depth.npz").unlink()
    refuse(rig, r"depth\.npz does not exist")


def test_damaged_archive(rig):
    data = (rig / "flow.npz").read_bytes()
    (rig / "flow.npz").write_bytes(data[: len(data) // 2])
    refuse(rig, r"flow\.npz is damaged")


def test_wrong_shape(rig):
    np.savez(rig / "depth.npz", depth=np.ones((COUNT, 10, 10), np.float16))
    refuse(rig, "depth has shape")


def test_missing_array(rig):
    np.savez(rig / "flow.npz", fwd=np.zeros((COUNT, HEIGHT, WIDTH, 2)))
    refuse(rig, "no array '(bwd|fwd_valid)'")


def test_bad_views(rig):
    edit(rig / "heldout" / "cameras.json", cameras={"left": {"times": [0], "w2c": []}})
    refuse(rig, "held-out cameras")


def test_missing_view(rig):
    (rig / "heldout" / "left" / "00004.png").unlink()
    refuse(rig, r"left/00004\.png is missing")


# -- the real one


def test_workshop(data):
    """Depth, cameras, tracks and flow of the rendered scene belong together."""
    clip = open_rig(data / "rig" / "workshop", InputOptions())
    truth = clip.truth
    assert truth is not None
    assert (clip.num_frames, clip.num_views, clip.source_fps) == (48, 36, 24)
    tracks = truth.tracks
    for i in (0, 20, 46):
        seen = tracks.visible[:, i]
        uv, z = truth.cameras[i].project(tracks.points[seen, i])
        x, y = uv.astype(int).T
        assert np.median(np.abs(truth.depth(i).depth[y, x] - z) / z) < 0.003
    for i, j in ((0, 1), (20, 21), (21, 20), (47, 46)):
        seen = tracks.visible[:, i] & tracks.visible[:, j]
        before, _ = truth.cameras[i].project(tracks.points[seen, i])
        after, _ = truth.cameras[j].project(tracks.points[seen, j])
        x, y = before.astype(int).T
        flow = truth.flow(i, j)
        assert np.median(np.linalg.norm(flow.flow[y, x] - (after - before), axis=1)) < 0.05
        assert flow.trusted[y, x].mean() > 0.95


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("fps", None, "fps is None"),
        ("fps", "abc", "fps is 'abc'"),
        ("fps", 0, "fps is 0"),
        ("width", 0, "is not"),
        ("width", 1e400, "cameras"),
    ],
)
def test_numbers_that_are_none(rig, name, value, message):
    values = json.loads((rig / "cameras.json").read_text())
    (rig / "cameras.json").write_text(json.dumps({**values, name: value}))
    with pytest.raises(InputError, match=message):
        open_rig(rig, InputOptions())


def test_what_was_made_of_it_within_is_no_part_of_it(rig):
    before = fingerprint(rig, InputOptions())
    (rig / "out" / "scene").mkdir(parents=True)
    (rig / "out" / "run.json").write_text("{}")
    (rig / "out" / "scene" / "00000.png").write_text("x")
    assert fingerprint(rig, InputOptions()) == before

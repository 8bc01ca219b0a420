"""The scene on disk: its split, its round trips, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from flowsplat.common.errors import InputError, SplitError
from flowsplat.geometry import Camera, Similarity
from flowsplat.scenes import Depth, Flow, HeldoutView, Scene, Tracks
from flowsplat.scenes.scene import split_frames

WIDTH, HEIGHT, COUNT = 40, 32, 21
CAMERA = Camera(np.eye(4), np.array([[50.0, 0, 20], [0, 50, 16], [0, 0, 1]]), WIDTH, HEIGHT)
ONES = np.ones((HEIGHT, WIDTH), np.float32)


@pytest.fixture
def scene(tmp_path) -> Scene:
    return create(tmp_path / "scene")


def create(folder: Path, holdout: int | None = 10, count: int = COUNT) -> Scene:
    return Scene.create(
        folder,
        name="test",
        source="test",
        width=WIDTH,
        height=HEIGHT,
        timestamps=(np.arange(count) / 10).tolist(),
        holdout=holdout,
        source_fps=10,
    )


def tracks(visible: np.ndarray) -> Tracks:
    count = len(visible)
    points = np.random.default_rng(0).random((count, COUNT, 2), np.float32)
    return Tracks(points, visible, np.full(visible.shape, 0.8, np.float32), np.arange(count) % 2 == 0)


# -- split


def test_split():
    train, heldout = split_frames(50, 10)
    assert heldout == [9, 19, 29, 39]
    assert sorted(train + heldout) == list(range(50))
    # The last frame has no later neighbor to be predicted from.
    assert split_frames(20, 10)[1] == [9]
    assert split_frames(21, 10)[1] == [9, 19]
    assert split_frames(9, 10)[1] == []
    assert split_frames(3, None)[1] == []


def test_frames_to_hold_out_can_be_named():
    assert split_frames(6, 3, (5, 1, 1)) == ([0, 2, 3, 4], [1, 5])
    assert split_frames(6, None, (0,))[1] == [0]
    for wrong in ((6,), (-1, 2)):
        with pytest.raises(InputError, match="numbers from 0 to 5"):
            split_frames(6, 3, wrong)
    with pytest.raises(InputError, match="at least two frames"):
        split_frames(3, None, (0, 1))


@pytest.mark.parametrize(("count", "holdout"), [(1, None), (0, 10), (2, 1), (30, 1)])
def test_split_without_training_frames(count, holdout):
    with pytest.raises(InputError, match="at least two frames"):
        split_frames(count, holdout)


def test_split_is_law(scene, make_image):
    for i in range(COUNT):
        scene.write_frame(i, make_image(i, WIDTH, HEIGHT))
    folder = scene.folder
    assert sorted(p.stem for p in (folder / "heldout" / "frames").iterdir()) == ["00009", "00019"]
    assert len(list((folder / "frames").iterdir())) == COUNT - 2
    np.testing.assert_array_equal(scene.frame(8), make_image(8, WIDTH, HEIGHT))
    np.testing.assert_array_equal(scene.heldout_frame(9), make_image(9, WIDTH, HEIGHT))
    np.testing.assert_array_equal(scene.any_frame(9), make_image(9, WIDTH, HEIGHT))
    depth, mask = Depth(ONES, ONES), np.zeros((HEIGHT, WIDTH), np.uint8)
    flow = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    seen = np.zeros((2, COUNT), bool)
    seen[1, 19] = True
    refused = [
        lambda: scene.frame(9),
        lambda: scene.heldout_frame(8),
        lambda: scene.depth(9),
        lambda: scene.flow(8, 9),
        lambda: scene.flow(9, 10),
        lambda: scene.read_stored_flow(8, 9),
        lambda: scene.mask(19),
        lambda: scene.write_depth(9, depth),
        lambda: scene.write_mask(9, mask),
        lambda: scene.write_flow(Flow(8, 9, flow, ONES)),
        lambda: scene.write_flow(Flow(9, 8, flow, ONES)),
        lambda: scene.write_tracks(tracks(seen)),
    ]
    for call in refused:
        with pytest.raises(SplitError):
            call()
    scene.heldout_masks.write_mask(9, mask + 2)
    assert (folder / "heldout" / "masks" / "00009.png").exists()
    assert (scene.heldout_masks.mask(9) == 2).all()
    assert not scene.has_mask(9)


def test_flow_that_is_not_stored_as_flow_is_refused(scene):
    scene.write_flow(Flow(0, 1, np.zeros((HEIGHT, WIDTH, 2), np.float32), ONES))
    path = scene.folder / "flow" / "00000_00001.npz"
    np.savez(path, **{**np.load(path), "flow": np.full((HEIGHT, WIDTH, 2), np.nan, np.float32)})
    with pytest.raises(InputError, match="int16"):
        scene.flow(0, 1)


# -- round trips


def test_info(scene):
    again = Scene(scene.folder)
    assert (again.name, again.width, again.height, again.num_frames) == ("test", WIDTH, HEIGHT, COUNT)
    np.testing.assert_allclose(again.timestamps, np.arange(COUNT) / 10)
    assert (again.times[0], again.times[-1]) == (0, 1)
    assert again.times[COUNT // 2] == pytest.approx((COUNT // 2) / (COUNT - 1))
    assert again.prior("flow") is None
    again.finish_prior("flow", method="test", pairs=3)
    assert Scene(scene.folder).prior("flow") == {"method": "test", "pairs": 3}


def test_layers(scene):
    rng = np.random.default_rng(0)
    depth = Depth(rng.random((HEIGHT, WIDTH), np.float32) + 1, rng.random((HEIGHT, WIDTH), np.float32))
    scene.write_depth(3, depth)
    np.testing.assert_array_equal(scene.depth(3).depth, depth.depth)
    np.testing.assert_allclose(scene.depth(3).confidence, depth.confidence, atol=0.5 / 255 + 1e-6)
    flow = Flow(8, 10, rng.normal(0, 20, (HEIGHT, WIDTH, 2)).astype(np.float32), depth.confidence)
    scene.write_flow(flow)
    assert scene.flow_pairs == [(8, 10)]
    np.testing.assert_allclose(scene.flow(8, 10).flow, flow.flow, atol=0.5 / 64)
    stored, read = scene.read_stored_flow(8, 10), scene.flow(8, 10)
    assert (stored.units.nbytes + stored.certainty.nbytes) * 2 < read.flow.nbytes + read.confidence.nbytes
    for name in ("flow", "confidence", "trusted"):
        np.testing.assert_array_equal(getattr(stored, name), getattr(read, name))
    mask = rng.integers(0, 4, (HEIGHT, WIDTH)).astype(np.uint8)
    scene.write_mask(0, mask)
    np.testing.assert_array_equal(scene.mask(0), mask)
    visible = rng.random((7, COUNT)) > 0.5
    visible[:, scene.heldout_frames] = False
    written = tracks(visible)
    scene.write_tracks(written)
    read = scene.tracks
    np.testing.assert_array_equal(read.points, written.points)
    np.testing.assert_array_equal(read.visible, visible)
    np.testing.assert_array_equal(read.moving, written.moving)
    np.testing.assert_allclose(read.confidence, 0.8, atol=0.5 / 255 + 1e-6)


def test_flow_that_does_not_fit_is_not_trusted(scene):
    flow = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    flow[0, 0], flow[1, 1, 0], flow[2, 2, 1], flow[3, 3] = 600, np.nan, np.inf, 500
    scene.write_flow(Flow(0, 1, flow, ONES))
    read = scene.flow(0, 1)
    assert np.isfinite(read.flow).all()
    assert not read.trusted[[0, 1, 2], [0, 1, 2]].any()
    assert read.trusted[3, 3]
    assert (read.flow[3, 3] == 500).all()


def test_cameras(scene):
    assert not scene.has_cameras
    cameras = [Camera(np.eye(4) + np.eye(4, k=3) * i, CAMERA.K, WIDTH, HEIGHT) for i in range(COUNT)]
    scene.write_cameras(cameras)
    for read, written in zip(Scene(scene.folder).cameras, cameras, strict=True):
        np.testing.assert_array_equal(read.viewmat, written.viewmat)
        np.testing.assert_array_equal(read.K, written.K)


def test_views_and_truth(scene, make_image):
    assert scene.truth is None
    assert scene.views == []
    image = make_image(1, WIDTH, HEIGHT)
    objects = image[..., 0] > 100
    for name in ("left_00000", "left_00004"):
        scene.write_view(HeldoutView(name, 4, CAMERA), image, objects)
    scene.write_view(HeldoutView("left_00004", 4, CAMERA), image, objects, ~objects)
    views = Scene(scene.folder).views
    assert [view.name for view in views] == ["left_00000", "left_00004"]
    np.testing.assert_array_equal(scene.view_image(views[1]), image)
    np.testing.assert_array_equal(scene.view_mask(views[1]), objects)
    np.testing.assert_array_equal(scene.view_mask(views[1], "covisible"), ~objects)
    assert scene.view_mask(views[0], "covisible") is None
    truth = scene.create_truth()
    truth.write_depth(9, Depth(ONES, ONES))
    assert scene.truth is not None
    assert (scene.truth.depth(9).depth == 1).all()


def test_scale(tmp_path):
    scene = create(tmp_path / "scene")
    scene.write_cameras([CAMERA] * COUNT)
    for i in scene.train_frames:
        scene.write_depth(i, Depth(ONES * 4, ONES))
    assert scene.similarity.scale == pytest.approx(0.25)
    assert Scene(scene.folder).similarity.scale == pytest.approx(0.25)


# -- what cannot be used


def test_not_a_scene(tmp_path):
    with pytest.raises(InputError, match="not a prepared scene"):
        Scene(tmp_path)


def edit(scene: Scene, **values) -> None:
    path = scene.folder / "scene.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | values))


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"version": 99}, "newer flowsplat .* Update flowsplat"),
        ({"version": "one"}, "damaged"),
        ({"width": None}, "damaged"),
        ({"timestamps": [0.0, 2.0, 1.0]}, "rising"),
        ({"timestamps": [0.0] * COUNT}, "rising"),
        ({"timestamps": [0.0]}, "two timestamps"),
        ({"timestamps": "later"}, "damaged"),
        ({"train": [0, 1, 2]}, "either a training or a held-out frame"),
        ({"heldout": [9, 19, 20]}, "either a training or a held-out frame"),
        ({"heldout": None}, "damaged"),
        ({"train": [0], "heldout": list(range(1, COUNT))}, "1 training frame.*at least two"),
        ({"train": [], "heldout": list(range(COUNT))}, "0 training frame.*at least two"),
        ({"train": list(range(COUNT))[::-1], "heldout": []}, "must rise"),
    ],
)
def test_bad_info(scene, values, words):
    edit(scene, **values)
    with pytest.raises(InputError, match=words) as caught:
        Scene(scene.folder)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("missing", ["source", "source_fps", "notes", "priors", "similarity", "train"])
def test_info_that_lacks_something(scene, missing):
    path = scene.folder / "scene.json"
    path.write_text(json.dumps({key: value for key, value in json.loads(path.read_text()).items() if key != missing}))
    with pytest.raises(InputError, match=f"damaged.*{missing}"):
        Scene(scene.folder)


@pytest.mark.parametrize("text", ["", "{", "[]", "3"])
def test_damaged_info(scene, text):
    (scene.folder / "scene.json").write_text(text)
    with pytest.raises(InputError, match="damaged"):
        Scene(scene.folder)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 2.0])
def test_cameras_that_are_none(scene, value):
    cameras = [CAMERA.to_json() for _ in range(COUNT)]
    cameras[3]["viewmat"][0][0] = value
    (scene.folder / "cameras.json").write_text(json.dumps(cameras))
    with pytest.raises(InputError, match=r"camera of frame 3 is not finite or not a rotation|a number that is not finite"):
        _ = scene.cameras


def test_wrong_number_of_cameras(scene):
    (scene.folder / "cameras.json").write_text(json.dumps([CAMERA.to_json()] * 3))
    with pytest.raises(InputError, match="3 cameras for 21 frames"):
        _ = scene.cameras


@pytest.mark.parametrize("value", [{}, [{}], [{"viewmat": 3, "K": [], "width": 1, "height": 1}], ["camera"], 5, None])
def test_damaged_cameras(scene, value):
    (scene.folder / "cameras.json").write_text(json.dumps(value))
    with pytest.raises(InputError, match=r"cameras\.json"):
        _ = scene.cameras


@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0, -1.0])
def test_depth_that_is_none(scene, value):
    depth = ONES.copy()
    depth[5, 5] = value
    scene.write_depth(0, Depth(depth, ONES))
    with pytest.raises(InputError, match="not finite and positive"):
        scene.depth(0)


def test_layers_that_do_not_fit(scene, write_image_file):
    small = np.ones((HEIGHT, WIDTH - 2), np.float32)
    scene.write_depth(0, Depth(small, small))
    scene.write_flow(Flow(0, 1, np.zeros((*small.shape, 2)), small))
    scene.write_mask(0, small)
    for read in (lambda: scene.depth(0), lambda: scene.flow(0, 1), lambda: scene.mask(0)):
        with pytest.raises(InputError, match=r"38, 32|32, 38|38 x 32"):
            read()
    write_image_file(scene.folder / "frames" / "00000.png", np.zeros((HEIGHT, WIDTH - 2, 3), np.uint8))
    with pytest.raises(InputError, match="expected"):
        scene.frame(0)


def test_missing_and_damaged_files(scene, make_image):
    for read in (lambda: scene.frame(0), lambda: scene.depth(0), lambda: scene.mask(0), lambda: scene.tracks):
        with pytest.raises(InputError, match=r"missing|does not exist"):
            read()
    scene.write_frame(0, make_image(0, WIDTH, HEIGHT))
    scene.write_depth(0, Depth(ONES, ONES))
    for path, read in (("frames/00000.png", lambda: scene.frame(0)), ("depth/00000.npz", lambda: scene.depth(0))):
        file = scene.folder / path
        file.write_bytes(file.read_bytes()[:30])
        with pytest.raises(InputError, match="damaged"):
            read()
        file.write_bytes(b"")
        with pytest.raises(InputError, match="damaged"):
            read()


def test_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="is a file, not a folder"):
        create(tmp_path / "file")


# -- the record


def test_the_record_is_written_as_it_was_read(scene):
    path = scene.folder / "scene.json"
    values = json.loads(path.read_text())
    values |= {"source_fps": 10, "later": [1, 2]}  # a whole number, and a key of a newer version
    path.write_text(json.dumps(values))
    opened = Scene(scene.folder)
    assert opened.info.to_json() == values
    opened.finish_prior("flow", method="test")
    assert json.loads(path.read_text()) == values | {"priors": {"flow": {"method": "test"}}}
    assert list(json.loads(path.read_text())) == list(values)


def test_marks_are_in_the_file_only_while_they_hold(scene):
    before = set(scene.info.to_json())
    scene.begin_straightening({"focal": 1.0}, {"method": "tracks"})
    scene.mark_images_complete()
    assert set(scene.info.to_json()) == before | {"lens", "straightening", "images_replaced"}
    scene.finish_straightening("They are straight.")
    scene.mark_ingested()
    again = Scene(scene.folder)
    assert set(again.info.to_json()) == before | {"lens", "ingested"}
    assert again.prior("cameras") == {"method": "tracks"}
    assert again.info.notes == ["They are straight."]


def test_forgotten_depth_takes_the_scale_along(scene):
    scene.write_similarity(Similarity(2.0))
    for name in ("flow", "depth", "tracks"):
        scene.finish_prior(name, method="test")
    scene.amend_prior("flow", objects=True)
    assert scene.prior("flow") == {"method": "test", "objects": True}
    scene.forget_priors(["tracks"])
    assert scene.similarity.scale == 2
    scene.forget_priors(["depth"])
    assert Scene(scene.folder).info.similarity is None
    assert list(scene.info.priors) == ["flow"]

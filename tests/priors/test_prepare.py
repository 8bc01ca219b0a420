"""All priors in order: given ones, true ones, own ones; and held-out frames that nothing but the cameras may see."""

from __future__ import annotations

import json
import re
import shutil
import struct
import sys
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.priors.background.monocular_maps import Monocular
from flowsplat.priors.cameras import CameraOptions
from flowsplat.priors.flow import dis_estimator, flow_stage
from flowsplat.priors.given import GivenPriors
from flowsplat.priors.graph import PRIORS
from flowsplat.priors.options import PriorsOptions
from flowsplat.priors.prepare import prepare_priors, request_of, use_given, use_truth
from flowsplat.scenes import Flow, Scene

from .planes import FRAMES, HEIGHT, WALL, WIDTH, square_at, write_planes

STAGES = ("cameras", "flow", "masks", "depth", "tracks")


def forget_cameras(scene: Scene) -> Scene:
    (scene.folder / "cameras.json").unlink()
    scene.forget_priors(["cameras"])
    return Scene(scene.folder)


def prior_files(scene: Scene) -> dict[str, bytes]:
    """Every prior by its path; the images and the truth are left out."""
    paths = [path for name in ("depth", "flow", "masks") for path in (scene.folder / name).iterdir()]
    paths += [scene.folder / "tracks.npz", scene.folder / "cameras.json", scene.folder / "scene.json"]
    return {path.relative_to(scene.folder).as_posix(): path.read_bytes() for path in paths}


def test_held_out_pixels_change_no_prior(tmp_path: Path):
    results = []
    for name in ("as_it_is", "corrupted"):
        scene = write_planes(tmp_path / name, step=2, square=True, holdout=5)
        assert scene.heldout_frames == [4, 9]
        if name == "corrupted":
            rng = np.random.default_rng(5)
            for i in scene.heldout_frames:
                scene.write_frame(i, rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8))
                scene.heldout_masks.write_mask(i, np.full((HEIGHT, WIDTH), 3, np.uint8))
        seconds = prepare_priors(scene, PriorsOptions())
        assert set(seconds) == {"flow", "masks", "depth", "tracks"}
        results.append(prior_files(scene))
    assert results[0].keys() == results[1].keys()
    assert [path for path in results[0] if results[0][path] != results[1][path]] == []
    assert not any("00004" in path or "00009" in path for path in results[0])


def test_finished_priors_are_kept_and_scratch_is_removed(tmp_path: Path):
    scene = write_planes(tmp_path, step=2, square=True)
    prepare_priors(scene, PriorsOptions())
    assert all(scene.prior(name) is not None for name in STAGES)
    assert scene.info.similarity is not None
    assert not (tmp_path / "multiview").exists()
    before = prior_files(scene)
    assert prepare_priors(Scene(tmp_path), PriorsOptions()) == {}
    assert prior_files(scene) == before


@pytest.fixture(scope="module")
def done(tmp_path_factory) -> Path:
    """A prepared scene; what is there counts as made by us, the cameras included."""
    scene = write_planes(tmp_path_factory.mktemp("done"), step=2, square=True)
    scene.finish_prior("cameras", method="tracks", options=asdict(CameraOptions()))
    prepare_priors(scene, PriorsOptions())
    return scene.folder


@pytest.fixture
def prepared(done: Path, tmp_path: Path) -> Scene:
    shutil.copytree(done, tmp_path / "scene")
    return Scene(tmp_path / "scene")


@pytest.fixture
def networks(monkeypatch) -> None:
    """What stands for networks that are not there: other methods of the same names."""

    def predict_depth(name: str, scene: Scene, *_: object) -> Monocular:
        def inverse(i: int) -> tuple[np.ndarray, np.ndarray]:
            return 1 / scene.truth.depth(i).depth, np.ones((HEIGHT, WIDTH), np.float32)

        return Monocular(name, name, relative=False, inverse=inverse)

    def sam_stage(scene: Scene, segmenter: str, prompts: list, shown_by: str) -> None:
        for i in scene.train_frames:
            scene.write_mask(i, scene.truth.mask(i))
        scene.finish_prior("masks", method=segmenter, verdict=shown_by)

    monkeypatch.setattr("flowsplat.priors.learned.raft.raft_estimator", lambda *_: dis_estimator)
    monkeypatch.setattr("flowsplat.priors.learned.depth.predict_depth", predict_depth)
    monkeypatch.setattr("flowsplat.priors.learned.sam.load_segmenter", lambda name, *_: name)
    monkeypatch.setattr("flowsplat.priors.learned.sam.sam_stage", sam_stage)


def methods(scene: Scene) -> dict[str, str]:
    return {name: scene.prior(name)["method"] for name in STAGES}


@pytest.mark.parametrize(
    ("options", "anew", "method"),
    [
        (PriorsOptions(flow="raft"), {"flow", "masks", "depth", "tracks"}, {"flow": "raft"}),
        (PriorsOptions(masks="sam2"), {"masks", "depth", "tracks"}, {"masks": "sam2"}),
        (PriorsOptions(depth="depth-pro"), {"depth", "tracks"}, {"depth": "depth-pro"}),
    ],
)
def test_another_method_than_the_scene_has_replaces_it(prepared: Scene, networks, capsys, options, anew, method):
    before, had = methods(prepared), prior_files(prepared)
    assert set(prepare_priors(prepared, options)) == anew
    assert methods(prepared) == before | method
    said = " ".join(capsys.readouterr().err.split())
    replaced, kept = (re.search(f"{start}[^:]*: ([^.]*)", said)[1] for start in ("Computed anew", "Already there and kept"))
    assert {entry.split()[0] for entry in replaced.split(", ")} == anew
    assert {entry.split()[0] for entry in kept.split(", ")} == set(STAGES) - anew
    for path, content in prior_files(prepared).items():
        if path.split("/")[0].split(".")[0] in set(STAGES) - anew:
            assert content == had[path]
    assert prepare_priors(Scene(prepared.folder), options) == {}
    # What was asked for then is not undone by who asks for nothing now.
    assert prepare_priors(Scene(prepared.folder), PriorsOptions()) == {}
    assert methods(Scene(prepared.folder)) == before | method


def test_what_is_kept_is_said(prepared: Scene, capsys):
    assert prepare_priors(prepared, PriorsOptions()) == {}
    said = " ".join(capsys.readouterr().err.split())
    assert "kept: cameras (tracks), flow (dis), masks (motion), tracks (patches), depth (multi-view)." in said


def test_given_masks_give_way_to_a_network_that_is_asked_for(prepared: Scene, networks):
    prepared.finish_prior("masks", method="given")
    assert set(prepare_priors(prepared, PriorsOptions(masks="sam3"))) == {"masks", "depth", "tracks"}
    assert methods(prepared)["masks"] == "sam3"


def test_what_would_not_be_made_as_it_was_is_kept(prepared: Scene, networks):
    prepared.finish_prior("masks", method="clicks")
    prepared.finish_prior("depth", method="depth-pro")
    assert set(prepare_priors(prepared, PriorsOptions(flow="raft"))) == {"flow", "tracks"}
    assert set(prepare_priors(prepared, PriorsOptions(masks="sam2", depth="depth-pro"))) == {"masks", "depth", "tracks"}


def test_nothing_is_forgotten_where_a_network_is_missing(prepared: Scene, monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    before = prior_files(prepared)
    for options in (PriorsOptions(depth="depth-pro"), PriorsOptions(masks="sam2")):
        with pytest.raises(InputError, match="needs transformers"):
            prepare_priors(prepared, options)
    assert prior_files(Scene(prepared.folder)) == before


def test_other_camera_options_compute_the_cameras_anew(prepared: Scene, monkeypatch):
    def camera_stage(scene: Scene, options: CameraOptions) -> None:
        scene.write_cameras(scene.truth.cameras)
        scene.finish_prior("cameras", method="tracks", options=asdict(options))

    monkeypatch.setattr("flowsplat.priors.kinds.cameras.camera_stage", camera_stage)
    options = PriorsOptions(cameras=CameraOptions(solver="global"))
    assert set(prepare_priors(prepared, options)) == {"cameras", "masks", "depth", "tracks"}
    assert prepare_priors(prepared, options) == {}
    assert prepare_priors(prepared, PriorsOptions()) == {}
    prepared.finish_prior("depth", method="given")
    with pytest.raises(InputError, match=r"depth of planes \(given\) belongs to the cameras"):
        prepare_priors(prepared, PriorsOptions(cameras=CameraOptions(focal=99.0)))
    assert methods(prepared)["cameras"] == "tracks"
    for method in ("given", "truth", "calibrated"):
        prepared.finish_prior("cameras", method=method)
        assert prepare_priors(prepared, PriorsOptions(cameras=CameraOptions(focal=99.0))) == {}


def test_straightened_images_need_new_flow(prepared: Scene):
    options = PriorsOptions(cameras=CameraOptions(distortion="radial"))
    with pytest.raises(InputError, match="rendered by pinholes"):
        prepare_priors(prepared, options)
    (prepared.folder / "truth").rename(prepared.folder / "other")
    assert PRIORS.stale(request_of(prepared, options)) == set(STAGES)
    prepared.finish_prior("flow", method="given")
    with pytest.raises(InputError, match="Flow of planes were made for the images as they came"):
        prepare_priors(prepared, options)
    assert set(methods(prepared)) == set(STAGES)


def test_truth_replaces_what_was_computed(prepared: Scene, networks):
    assert set(prepare_priors(prepared, PriorsOptions(priors="true", depth="depth-pro"))) == {"truth"}
    assert set(methods(prepared).values()) == {"truth"}
    np.testing.assert_array_equal(prepared.depth(3).depth, prepared.truth.depth(3).depth)
    assert prepared.similarity.scale == pytest.approx(1 / WALL)
    assert prepare_priors(prepared, PriorsOptions(priors="true", flow="raft")) == {}
    assert set(prepare_priors(prepared, PriorsOptions(depth="depth-pro"))) == {"depth"}
    (prepared.folder / "truth").rename(prepared.folder / "other")
    with pytest.raises(InputError, match="no truth"):
        prepare_priors(prepared, PriorsOptions(priors="true"))
    assert methods(Scene(prepared.folder))["depth"] == "depth-pro"


def test_truth_replaces_everything(tmp_path: Path):
    scene = forget_cameras(write_planes(tmp_path, step=2, square=True))
    assert set(prepare_priors(scene, PriorsOptions(priors="true"))) == {"truth"}
    assert {scene.prior(name)["method"] for name in STAGES} == {"truth"}
    np.testing.assert_array_equal(scene.mask(3), scene.truth.mask(3))
    assert scene.similarity.scale == pytest.approx(1 / WALL)
    assert scene.tracks.points.shape == (2, FRAMES, 2)
    np.testing.assert_allclose(scene.tracks.points[0, 3], [WIDTH / 2 - 6, HEIGHT / 2], atol=1e-3)


def test_truth_of_held_out_frames_gives_cameras_only(tmp_path: Path):
    scene = write_planes(tmp_path, step=2, square=True, holdout=5)
    use_truth(scene)
    assert len(scene.cameras) == FRAMES
    assert not any(scene.has_depth(i) or scene.has_mask(i) for i in scene.heldout_frames)
    assert not scene.tracks.visible[:, scene.heldout_frames].any()
    assert scene.tracks.visible[:, scene.train_frames].all()
    # Put together from that of the pairs between.
    assert scene.prior("flow")["method"] == "truth"
    assert (3, 5) not in scene.truth.flow_pairs
    flow = scene.flow(3, 5)
    assert flow.trusted.mean() > 0.8
    expected = scene.truth.flow(3, 4).flow + scene.truth.flow(4, 5).flow
    assert np.median(np.abs(flow.flow - expected)[flow.trusted]) < 1 / 32
    assert "flow" not in prepare_priors(scene, PriorsOptions(priors="true"))


def test_flow_that_the_truth_lacks_is_completed_and_the_true_one_stays(tmp_path: Path):
    scene = write_planes(tmp_path, step=2, square=True, holdout=5)
    (scene.truth.folder / "flow" / "00003_00004.npz").unlink()
    assert "flow" in prepare_priors(scene, PriorsOptions(priors="true"))
    assert scene.prior("flow")["method"] == "dis"
    assert (3, 5) in scene.flow_pairs
    for pair in ((0, 1), (1, 0)):
        np.testing.assert_array_equal(scene.flow(*pair).flow, scene.truth.flow(*pair).flow)


def test_a_filmed_clip_has_no_truth(tmp_path: Path):
    scene = write_planes(tmp_path, step=2, square=False)
    (tmp_path / "truth").rename(tmp_path / "other")
    with pytest.raises(InputError, match="no truth"):
        prepare_priors(scene, PriorsOptions(priors="true"))


def test_one_way_of_given_flow_is_kept_and_the_other_computed(tmp_path: Path):
    scene = write_planes(tmp_path / "scene", step=2, square=False, holdout=5)
    pairs = [(i, i + step) for step in (1, 2) for i in range(FRAMES - step)]
    (tmp_path / "cache").mkdir()
    np.save(tmp_path / "cache" / "flows.npy", np.full((len(pairs), 2, HEIGHT // 2, WIDTH // 2), 0.25, np.float16))
    np.save(tmp_path / "cache" / "flows_masks.npy", np.ones((len(pairs), 1, HEIGHT // 2, WIDTH // 2), bool))
    np.save(tmp_path / "cache" / "ii-jj.npy", np.array(pairs).T)
    assert use_given(scene, GivenPriors(flow=tmp_path / "cache")) == {}
    flow_stage(scene)
    assert scene.prior("flow")["pairs"] == len(scene.train_frames) - 1
    np.testing.assert_array_equal(scene.flow(3, 5).flow[40, 60], [0.5, 0.5])
    assert np.median(scene.flow(5, 3).flow[..., 0]) == pytest.approx(4, abs=0.2)


def test_given_depth_in_other_units_is_fitted_to_the_cameras(tmp_path: Path):
    scene = write_planes(tmp_path / "scene", step=2, square=True, holdout=5)
    for i in scene.train_frames:
        scene.write_mask(i, scene.truth.mask(i))
    scene.finish_prior("masks", method="given")
    (tmp_path / "depth").mkdir()
    for i in range(FRAMES):
        np.savez(tmp_path / "depth" / f"{i:05d}.npz", dep=(7 + i) * scene.truth.depth(i).depth)
    seconds = prepare_priors(scene, PriorsOptions(given=GivenPriors(depth=tmp_path / "depth")))
    assert set(seconds) == {"given", "flow", "depth", "tracks"}
    how = scene.prior("depth")
    assert how["method"] == "given"
    assert "MoSca" in how["verdict"]
    mask = scene.mask(5) > 0
    assert np.median(scene.depth(5).depth[~mask]) == pytest.approx(WALL, rel=0.03)
    assert np.median(scene.depth(5).depth[mask]) == pytest.approx(WALL / 2, rel=0.1)
    assert prepare_priors(scene, PriorsOptions(given=GivenPriors(depth=tmp_path / "depth"))) == {}


def test_clicks_take_the_place_of_other_masks(tmp_path: Path):
    scene = write_planes(tmp_path, step=2, square=True, holdout=5)
    for i in scene.train_frames:
        scene.write_mask(i, np.full((HEIGHT, WIDTH), 1, np.uint8))
    scene.finish_prior("masks", method="given")
    x, y = square_at(3)
    options = PriorsOptions(mask_click=(f"{x + 14},{y + 14}@3",), mask_box=(f"{x - 2},{y - 2},{x + 30},{y + 30}@3",))
    assert set(prepare_priors(scene, options)) == {"flow", "masks", "depth", "tracks"}
    assert scene.prior("masks")["method"] == "clicks"
    assert scene.prior("masks")["objects"] == 1
    true = scene.truth.mask(3) > 0
    assert ((scene.mask(3) > 0) & true).sum() > 0.8 * true.sum()
    assert prepare_priors(scene, options) == {}
    stamp = (tmp_path / "depth" / "00000.npz").stat().st_mtime_ns
    scene.finish_prior("masks", method="given")  # now they come from elsewhere, and shaped depth and tracks
    assert set(prepare_priors(scene, options)) == {"masks", "depth", "tracks"}
    assert (tmp_path / "depth" / "00000.npz").stat().st_mtime_ns > stamp
    with pytest.raises(InputError, match=r"--given.masks and --mask-click.*give one"):
        prepare_priors(scene, PriorsOptions(given=GivenPriors(masks=tmp_path), mask_click=("1,1@0",)))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (PriorsOptions(depth="depth-pro"), "--depth depth-pro needs transformers.*--depth multiview"),
        (PriorsOptions(masks="sam2"), "--masks sam2 needs transformers.*--masks motion"),
        (PriorsOptions(flow="raft"), "--flow raft needs torchvision.*--flow dis"),
        (PriorsOptions(mask_click=("3@4",)), "--mask-click 3@4 cannot be understood"),
    ],
)
def test_what_is_not_there_is_said_before_anything_is_computed(tmp_path: Path, monkeypatch, options, message: str):
    for name in [name for name in sys.modules if name.split(".")[0] == "torchvision"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "transformers", None)
    monkeypatch.setitem(sys.modules, "torchvision", None)
    scene = forget_cameras(write_planes(tmp_path, step=2, square=True))
    with pytest.raises(InputError, match=message):
        prepare_priors(scene, options)
    assert not any(scene.prior(name) for name in STAGES)


def given_files(folder: Path, scene: Scene) -> GivenPriors:
    """Cameras, depth, masks and flow at twice the size of the scene."""
    size = (2 * WIDTH, 2 * HEIGHT)
    for name in ("depth", "masks", "flow"):
        (folder / name).mkdir(parents=True)
    cameras = [camera.resize(*size).to_json() for camera in scene.truth.cameras]
    (folder / "cameras.json").write_text(json.dumps(cameras))
    for i in range(FRAMES):
        np.save(folder / "depth" / f"{i:05d}.npy", cv2.resize(scene.truth.depth(i).depth, size, interpolation=0))
        mask = cv2.resize(scene.truth.mask(i) * 255, size, interpolation=0)
        cv2.imwrite(str(folder / "masks" / f"{i:05d}.png"), mask)
    pairs = [(i, j) for i in range(FRAMES) for j in (i - 1, i + 1) if 0 <= j < FRAMES]
    for i, j in pairs:
        flow = np.full((2 * HEIGHT, 2 * WIDTH, 2), [-4.0 * (j - i), 1], "<f4")
        if i % 2:
            header = struct.pack("<fii", 202021.25, 2 * WIDTH, 2 * HEIGHT)
            (folder / "flow" / f"{i:05d}_{j:05d}.flo").write_bytes(header + flow.tobytes())
        else:
            confidence = np.full((2 * HEIGHT, 2 * WIDTH), 255, np.uint8)
            arrays = {"flow": (flow * 64).astype(np.int16), "confidence": confidence}
            np.savez(folder / "flow" / f"{i:05d}_{j:05d}.npz", **arrays)
    return GivenPriors(folder / "cameras.json", folder / "depth", folder / "masks", folder / "flow")


def test_given_files_are_read_and_resized(tmp_path: Path):
    scene = forget_cameras(write_planes(tmp_path / "scene", step=2, square=True))
    given = given_files(tmp_path / "given", scene)
    seconds = prepare_priors(scene, PriorsOptions(given=given))
    assert set(seconds) == {"given", "tracks"}
    for found, true in zip(scene.cameras, scene.truth.cameras, strict=True):
        np.testing.assert_allclose(found.K, true.K)
        np.testing.assert_allclose(found.viewmat, true.viewmat)
    np.testing.assert_array_equal(scene.depth(4).depth, scene.truth.depth(4).depth)
    np.testing.assert_array_equal(scene.mask(4), scene.truth.mask(4))
    for pair in ((4, 5), (5, 4)):
        flow: Flow = scene.flow(*pair)
        np.testing.assert_allclose(flow.flow, np.broadcast_to([-2.0 * (pair[1] - pair[0]), 0.5], flow.flow.shape))
        assert flow.trusted.all()


def test_given_held_out_masks_are_kept_for_the_evaluation(tmp_path: Path):
    scene = write_planes(tmp_path / "scene", step=2, square=True, holdout=5)
    given = given_files(tmp_path / "given", scene)
    use_given(scene, GivenPriors(masks=given.masks))
    x, y = square_at(4)
    assert scene.heldout_masks.mask(4)[y + 2, x + 2] == 1
    assert not (tmp_path / "scene" / "masks" / "00004.png").exists()


def spoil_cameras(path: Path, change) -> None:
    values = json.loads(path.read_text())
    change(values)
    path.write_text(json.dumps(values))


BAD = {
    "cameras: one too few": (
        "cameras", lambda f: spoil_cameras(f / "cameras.json", lambda v: v.pop()), "11 cameras, but the clip has 12",
    ),
    "cameras: no rotation": (
        "cameras", lambda f: spoil_cameras(f / "cameras.json", lambda v: v[2].update(viewmat=[[2.0] * 4] * 4)), "frame 2",
    ),
    "cameras: no K": ("cameras", lambda f: spoil_cameras(f / "cameras.json", lambda v: v[2].pop("K")), "does not hold cameras"),
    "cameras: other shape": (
        "cameras", lambda f: spoil_cameras(f / "cameras.json", lambda v: v[0].update(width=99)), "another shape",
    ),
    "cameras: no JSON": ("cameras", lambda f: (f / "cameras.json").write_text("[{"), "not readable JSON"),
    "depth: missing": ("depth", lambda f: (f / "depth" / "00003.npy").unlink(), "00003.npy does not exist"),
    "depth: NaN": (
        "depth", lambda f: np.save(f / "depth" / "00003.npy", np.full((HEIGHT, WIDTH), np.nan)), "not finite and positive",
    ),
    "depth: zero": ("depth", lambda f: np.save(f / "depth" / "00003.npy", np.zeros((HEIGHT, WIDTH))), "not finite and positive"),
    "depth: other shape": ("depth", lambda f: np.save(f / "depth" / "00003.npy", np.ones((40, 40))), "another shape"),
    "depth: colors": ("depth", lambda f: np.save(f / "depth" / "00003.npy", np.ones((HEIGHT, WIDTH, 3))), "one depth map"),
    "depth: truncated": ("depth", lambda f: (f / "depth" / "00003.npy").write_bytes(b"\x93NUMPY"), "no readable .npy"),
    "masks: missing": ("masks", lambda f: (f / "masks" / "00003.png").unlink(), "00003.png does not exist"),
    "masks: damaged": ("masks", lambda f: (f / "masks" / "00003.png").write_bytes(b"no"), "00003.png"),
    "masks: other size": (
        "masks", lambda f: cv2.imwrite(str(f / "masks" / "00003.png"), np.zeros((9, 9), np.uint8)), "00003.png",
    ),
    "flow: missing": ("flow", lambda f: (f / "flow" / "00003_00004.flo").unlink(), "00003_00004.npz does not exist"),
    "flow: truncated": ("flow", lambda f: (f / "flow" / "00003_00004.flo").write_bytes(b"PIEH" + bytes(20)), "truncated"),
    "flow: no flow": ("flow", lambda f: (f / "flow" / "00003_00004.flo").write_bytes(bytes(20)), "not a Middlebury"),
    "flow: one array": ("flow", lambda f: np.savez(f / "flow" / "00002_00003.npz", flow=np.zeros((4, 4, 2))), "'confidence'"),
    "flow: NaN": (
        "flow",
        lambda f: np.savez(
            f / "flow" / "00002_00003.npz", flow=np.full((HEIGHT, WIDTH, 2), np.nan), confidence=np.ones((HEIGHT, WIDTH))
        ),
        "not finite",
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> Scene:
    return write_planes(tmp_path_factory.mktemp("plain"), step=2, square=True)


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused_in_one_line(tmp_path: Path, plain: Scene, name: str):
    kind, spoil, message = BAD[name]
    given = given_files(tmp_path, plain)
    spoil(tmp_path)
    with pytest.raises(InputError, match=message) as caught:
        use_given(plain, GivenPriors(**{kind: getattr(given, kind)}))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["cameras", "flow", "masks"])
def test_what_is_there_already_is_not_replaced_by_files_in_silence(tmp_path: Path, name: str):
    scene = write_planes(tmp_path / "scene", step=2, square=True)
    given = given_files(tmp_path / "given", scene)
    use_truth(scene)
    with pytest.raises(InputError, match=f"has {name} already"):
        prepare_priors(scene, PriorsOptions(given=GivenPriors(**{name: getattr(given, name)})))

"""Depth, flow and masks in the layouts of others, written exactly as their code writes them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.priors.given import GivenPriors
from flowsplat.priors.given.depth import _read_known, open_depth
from flowsplat.priors.given.flow import read_flow
from flowsplat.priors.given.truth import consecutive_pairs
from flowsplat.priors.prepare import use_given
from flowsplat.scenes import Scene

from .test_camera_files import droid, megasam, slam_intrinsics

SIZE = (854, 480)
FRAMES = 5


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    """Frame 2 is held out."""
    return Scene.create(
        tmp_path / "scene", name="s", source="", width=SIZE[0], height=SIZE[1], timestamps=range(FRAMES), holdout=3, source_fps=1
    )


def ramp(width: int, height: int, whole: tuple[int, int]) -> np.ndarray:
    """A depth that rises with the position in the whole image, from 1 to 4 across and 0 to 1 down."""
    x, y = (np.arange(width) + 0.5) / whole[0], (np.arange(height) + 0.5) / whole[1]
    return (1 + 3 * x[None] + y[:, None]).astype(np.float32)


EXPECTED = ramp(*SIZE, SIZE)


def test_megasam_depth_is_put_back_where_it_was_cropped(scene: Scene, tmp_path: Path):
    whole, (width, height), _ = slam_intrinsics()
    assert whole != (width, height)
    depths = np.repeat(ramp(width, height, whole)[None], FRAMES, 0).astype(np.float16)
    depths[:, :20, :20] = 1e-3
    megasam(tmp_path / "clip_sgd_cvd_hr.npz", depths=depths)
    given = open_depth(tmp_path / "clip_sgd_cvd_hr.npz", scene)
    found = given.read(3)
    assert given.maker == "MegaSaM"
    # The border that was cut off continues, and nothing is claimed about it.
    np.testing.assert_allclose(found.depth[40:440, 40:800], EXPECTED[40:440, 40:800], rtol=0.01)
    assert (found.confidence[:20, :20] == 0).all()
    assert (found.confidence[60:440, 60:800] == 1).all()
    assert found.confidence[-1, 100] == 0
    assert np.isfinite(found.depth).all()


@pytest.mark.parametrize("suffix", [".npy", ".png"])
def test_shape_of_motion_disparity(scene: Scene, tmp_path: Path, suffix: str):
    folder = tmp_path / "aligned_depth_anything" / "clip"
    folder.mkdir(parents=True)
    disparity = 1 / ramp(*SIZE, SIZE)
    disparity[:10] = 0
    for i in range(FRAMES):
        if suffix == ".npy":
            np.save(folder / f"frame_{i + 1}.npy", disparity)
        else:
            cv2.imwrite(str(folder / f"frame_{i + 1}.png"), np.rint(disparity * 65535).astype(np.uint16))
    given = open_depth(folder, scene)
    assert given.maker == "Shape of Motion"
    np.testing.assert_allclose(given.read(4).depth[10:], EXPECTED[10:], rtol=1e-3)
    assert (given.read(4).confidence[:10] == 0).all()
    assert (given.read(4).confidence[10:] == 1).all()


@pytest.mark.filterwarnings("error")
def test_what_no_float32_holds_is_not_known(scene: Scene, tmp_path: Path):
    values = np.full((scene.height, scene.width), 2.0)
    values[0, 0], values[0, 1], values[0, 2] = 1e300, -1e300, np.nan
    np.save(tmp_path / "00000.npy", values)
    found, known = _read_known(tmp_path / "00000.npy", np.load, 0.0, scene)
    assert known[0, :4].tolist() == [0, 0, 0, 1]
    assert np.isfinite(found).all()


def test_mosca_depth(scene: Scene, tmp_path: Path):
    folder = tmp_path / "uni_depth"
    folder.mkdir()
    depth = ramp(427, 240, (427, 240))
    depth[:5] = 0
    for i in range(FRAMES):
        np.savez_compressed(folder / f"{i:05d}.npz", dep=depth)
    given = open_depth(folder, scene)
    assert given.maker == "MoSca"
    np.testing.assert_allclose(given.read(0).depth[12:], EXPECTED[12:], rtol=0.01)
    assert (given.read(0).confidence[:9] == 0).all()


def test_depth_beside_cameras_of_the_same_maker_is_taken_as_it_is(scene: Scene, tmp_path: Path):
    megasam(tmp_path / "clip.npz")
    later = use_given(scene, GivenPriors(cameras=tmp_path / "clip.npz", depth=tmp_path / "clip.npz"))
    assert later == {}
    assert scene.prior("depth")["method"] == "given"
    assert not scene.has_depth(2)
    assert np.median(scene.depth(1).depth) == 2
    folder = tmp_path / "aligned_depth_anything"
    folder.mkdir()
    for i in range(FRAMES):
        np.save(folder / f"{i:05d}.npy", np.full((48, 85), 0.25, np.float32))
    droid(tmp_path / "droid.npy")
    mine = GivenPriors(cameras=tmp_path / "droid.npy", depth=folder, allow_pickle=True)
    assert use_given(scene, mine) == {}
    assert np.median(scene.depth(1).depth) == 4


def test_depth_beside_other_cameras_waits_to_be_fitted(scene: Scene, tmp_path: Path):
    megasam(tmp_path / "clip.npz")
    assert set(use_given(scene, GivenPriors(depth=tmp_path / "clip.npz"))) == {"depth"}
    assert scene.prior("depth") is None


BAD_DEPTH = {
    "nothing": (lambda f: f / "none", "does not exist. Looked for: .*MoSca"),
    "an archive of something": (lambda f: saved(f / "a.npz", x=np.ones(3)), "needs depths, intrinsic and cam_c2w"),
    "MoSca's of something": (lambda f: [saved(f / f"{i:05d}.npz", x=np.ones(3)) for i in range(5)] and f, "no array 'dep'"),
    "too few": (lambda f: [saved(f / f"f{i}.npz", dep=np.ones((48, 85))) for i in range(4)] and f, "holds 4 files with depth"),
    "another shape": (lambda f: [saved(f / f"f{i}.npz", dep=np.ones((48, 48))) for i in range(5)] and f, "another shape"),
}


def saved(file: Path, **arrays: np.ndarray) -> Path:
    np.savez(file, **arrays)
    return file


@pytest.mark.parametrize("name", BAD_DEPTH)
def test_bad_depth_is_refused_in_one_line(scene: Scene, tmp_path: Path, name: str):
    make, message = BAD_DEPTH[name]
    (tmp_path / "given").mkdir()
    with pytest.raises(InputError, match=message) as caught:
        open_depth(make(tmp_path / "given"), scene)
    assert "\n" not in str(caught.value)


def flow_cache(folder: Path, frames: int = FRAMES) -> None:
    """As MegaSaM's preprocess_flow.py writes it: forward only, the step 1 first."""
    _, (width, height), _ = slam_intrinsics()
    pairs = [(i, i + step) for step in (1, 2, 4) for i in range(frames - step)]
    flows = np.stack(
        [np.broadcast_to(np.array([4.0, -2.0])[:, None, None] * (j - i), (2, height // 2, width // 2)) for i, j in pairs]
    )
    masks = np.ones((len(pairs), 1, height // 2, width // 2), bool)
    masks[:, :, :, :30] = False
    folder.mkdir()
    np.save(folder / "flows.npy", flows.astype(np.float16))
    np.save(folder / "flows_masks.npy", masks)
    np.save(folder / "ii-jj.npy", np.array(pairs).T)


def test_megasam_flow(scene: Scene, tmp_path: Path):
    flow_cache(tmp_path / "cache")
    flows, maker = read_flow(tmp_path / "cache", scene)
    assert maker == "MegaSaM"
    assert [(flow.i, flow.j) for flow in flows] == [(0, 1), (1, 3), (3, 4)]
    (w1, h1), _, _ = slam_intrinsics()
    for flow in flows:
        expected = np.array([8 * SIZE[0] / w1, -4 * SIZE[1] / h1]) * (flow.j - flow.i)
        np.testing.assert_allclose(flow.flow, np.broadcast_to(expected, (*SIZE[::-1], 2)), rtol=1e-3)
        assert not flow.trusted[:, :80].any()
        assert flow.trusted[:440, 110:800].all()


def test_megasam_masks_of_another_size_are_refused(scene: Scene, tmp_path: Path):
    flow_cache(tmp_path / "cache")
    np.save(tmp_path / "cache" / "flows_masks.npy", np.load(tmp_path / "cache" / "flows_masks.npy")[..., 1:])
    with pytest.raises(InputError, match="not as MegaSaM writes it"):
        read_flow(tmp_path / "cache", scene)


def test_flow_one_way_leaves_the_rest_to_the_stage(scene: Scene, tmp_path: Path):
    flow_cache(tmp_path / "cache")
    use_given(scene, GivenPriors(flow=tmp_path / "cache"))
    assert scene.flow_pairs == [(0, 1), (1, 3), (3, 4)]
    assert scene.prior("flow") is None


def test_mosca_flow(scene: Scene, tmp_path: Path):
    for i, j in consecutive_pairs(scene) + [(1, 2)]:
        flow = np.broadcast_to([3.0 * (j - i), 1.0], (240, 427, 2)).astype(np.float16)
        mask = np.ones((240, 427), np.float16)
        mask[:20] = 0
        np.savez_compressed(tmp_path / f"frame_{i + 1}.jpg_to_frame_{j + 1}.jpg.npz", flow=flow, mask=mask)
    flows, maker = read_flow(tmp_path, scene)
    assert maker == "MoSca"
    assert [(flow.i, flow.j) for flow in flows] == consecutive_pairs(scene)
    np.testing.assert_allclose(flows[2].flow[100, 100], [12, 2], rtol=2e-3)
    assert not flows[0].trusted[:38].any()
    assert flows[0].trusted[42:].all()


def test_kitti_flow(scene: Scene, tmp_path: Path):
    for i, j in consecutive_pairs(scene):
        image = np.zeros((*SIZE[::-1], 3), np.uint16)
        image[..., 2], image[..., 1], image[..., 0] = 32768 + 64 * 5, 32768 - 64 * 3, 1  # red u, green v, blue valid
        image[:40] = 0
        cv2.imwrite(str(tmp_path / f"{i:05d}_{j:05d}.png"), image)
    flows, _ = read_flow(tmp_path, scene)
    assert len(flows) == 6
    np.testing.assert_array_equal(flows[0].flow[100, 100], [5, -3])
    assert not flows[0].trusted[:40].any()
    assert flows[0].trusted[40:].all()


def test_depth_is_taken_as_it_is_only_where_its_units_are_known(scene: Scene, tmp_path: Path):
    """Cameras that are computed have units of their own."""
    for i in scene.train_frames:
        np.save(tmp_path / f"{i:05d}.npy", np.full(SIZE[::-1], 3.0, np.float32))
    given = GivenPriors(depth=tmp_path)
    assert "depth" in use_given(scene, given)
    assert scene.prior("depth") is None
    scene.finish_prior("cameras", method="given")
    assert "depth" not in use_given(scene, given)
    assert scene.prior("depth")["method"] == "given"
    np.testing.assert_allclose(scene.depth(0).depth, 3, rtol=1e-3)


def test_sparse_flow_is_not_mixed_with_nothing(scene: Scene, tmp_path: Path):
    """Resized, it stays what it is where it is known."""
    random = np.random.default_rng(0)
    for i, j in consecutive_pairs(scene):
        known = random.random((375, 667)) < 0.3
        image = np.zeros((375, 667, 3), np.uint16)
        image[known] = (1, 32768 - 64 * 3, 32768 + 64 * 5)
        cv2.imwrite(str(tmp_path / f"{i:05d}_{j:05d}.png"), image)
    flow = read_flow(tmp_path, scene)[0][0]
    assert 0.2 < flow.trusted.mean() < 0.4
    expected = np.array([5 * 854 / 667, -3 * 480 / 375])
    np.testing.assert_allclose(flow.flow[flow.trusted], np.broadcast_to(expected, (flow.trusted.sum(), 2)), rtol=1e-4)


def test_flow_of_more_frames_than_the_clip_has_is_refused(scene: Scene, tmp_path: Path):
    for i, j in consecutive_pairs(scene) + [(7, 8)]:
        np.savez(tmp_path / f"{i:05d}_{j:05d}.npz", flow=np.zeros((48, 85, 2), np.float32), confidence=np.ones((48, 85)))
    with pytest.raises(InputError, match="has images up to number 00008, but the clip has 5 frames, 00000 to 00004"):
        read_flow(tmp_path, scene)


def test_masks_of_more_frames_than_the_clip_has_are_refused(scene: Scene, tmp_path: Path):
    for i in range(2 * FRAMES):
        cv2.imwrite(str(tmp_path / f"{i:05d}.png"), np.zeros(SIZE[::-1], np.uint8))
    with pytest.raises(InputError, match="has files with a mask up to number 00009, but the clip has 5 frames"):
        use_given(scene, GivenPriors(masks=tmp_path))


def test_files_that_are_counted_from_one(scene: Scene, tmp_path: Path):
    """As FFmpeg numbers them: one a frame is taken in order; one too many is refused, with the number that stands there."""
    for i in range(FRAMES):
        mask = np.zeros(SIZE[::-1], np.uint8)
        mask[:20, i : i + 20] = 255
        cv2.imwrite(str(tmp_path / f"{i + 1:05d}.png"), mask)
    use_given(scene, GivenPriors(masks=tmp_path))
    assert [int((scene.mask(i) > 0).any(0).argmax()) for i in scene.train_frames] == scene.train_frames
    cv2.imwrite(str(tmp_path / f"{FRAMES + 1:05d}.png"), np.zeros(SIZE[::-1], np.uint8))
    with pytest.raises(InputError, match="up to number 00006, but the clip has 5 frames"):
        use_given(scene, GivenPriors(masks=tmp_path))


def test_depth_as_images_is_named(scene: Scene, tmp_path: Path):
    for i in range(FRAMES):
        cv2.imwrite(str(tmp_path / f"{i:05d}.jpg"), np.full(SIZE[::-1], 90, np.uint8))
    with pytest.raises(InputError, match=r"00000\.jpg cannot be read as depth: it must be 00000\.npy"):
        open_depth(tmp_path, scene)


def test_bad_flow_is_refused_in_one_line(scene: Scene, tmp_path: Path):
    flow_cache(tmp_path / "short", frames=4)
    with pytest.raises(InputError, match="holds 4 images"):
        read_flow(tmp_path / "short", scene)
    with pytest.raises(InputError, match=r"does not exist. Looked for .*cache_flow"):
        read_flow(tmp_path / "none", scene)
    np.save(tmp_path / "short" / "ii-jj.npy", np.zeros((2, 3), int))
    with pytest.raises(InputError, match="not as MegaSaM writes it"):
        read_flow(tmp_path / "short", scene)
    (tmp_path / "kitti").mkdir()
    cv2.imwrite(str(tmp_path / "kitti" / "00000_00001.png"), np.zeros((48, 85, 3), np.uint8))
    with pytest.raises(InputError, match="no flow of KITTI"):
        read_flow(tmp_path / "kitti", scene)


@pytest.mark.parametrize("names", [[f"{i:05d}.png" for i in range(5)], [f"frame{i + 8}.png" for i in range(5)]])
def test_masks_by_number_or_in_order(scene: Scene, tmp_path: Path, names: list[str]):
    for i, name in enumerate(names):
        mask = np.zeros(SIZE[::-1], np.uint8)
        mask[10 * i : 10 * i + 10] = 255
        cv2.imwrite(str(tmp_path / name), mask)
    use_given(scene, GivenPriors(masks=tmp_path))
    assert (scene.mask(3)[30:40] == 1).all()
    assert scene.mask(3).sum() == 10 * SIZE[0]
    assert scene.heldout_masks.mask(2)[20:30].all()


def write_masks(folder: Path, labels: np.ndarray, palette: bool = False) -> Path:
    """The same labels [H, W] in every frame, as gray numbers or as the colors of DAVIS's palette."""
    folder.mkdir()
    colors = np.zeros((256, 3), np.uint8)
    colors[[1, 2, 255]] = [[0, 0, 128], [0, 128, 0], [192, 224, 224]]  # blue, green, red
    for i in range(FRAMES):
        cv2.imwrite(str(folder / f"{i:05d}.png"), colors[labels] if palette else labels)
    return folder


@pytest.mark.parametrize("palette", [False, True])
def test_label_255_beside_numbers_is_no_object(scene: Scene, tmp_path: Path, palette: bool):
    labels = np.zeros((SIZE[1], SIZE[0]), np.uint8)
    labels[:20, :30], labels[20:40, :30], labels[40:60, :30] = 1, 2, 255
    use_given(scene, GivenPriors(masks=write_masks(tmp_path / "masks", labels, palette)))
    for i in scene.train_frames:
        np.testing.assert_array_equal(scene.mask(i), np.where(labels == 255, 0, labels))
    for i in scene.heldout_frames:
        np.testing.assert_array_equal(scene.heldout_masks.mask(i), (labels > 0) & (labels < 255))


def test_white_alone_is_an_object(scene: Scene, tmp_path: Path):
    labels = np.zeros((SIZE[1], SIZE[0]), np.uint8)
    labels[:20, :30] = 255
    use_given(scene, GivenPriors(masks=write_masks(tmp_path / "masks", labels)))
    np.testing.assert_array_equal(scene.mask(scene.train_frames[0]), labels > 0)


def test_masks_by_which_nothing_rests_are_refused_and_nothing_is_written(scene: Scene, tmp_path: Path):
    labels = np.full((SIZE[1], SIZE[0]), 255, np.uint8)
    labels[20:60, 40:90] = 0
    with pytest.raises(InputError, match="Invert masks whose objects are black") as error:
        use_given(scene, GivenPriors(masks=write_masks(tmp_path / "masks", labels)))
    assert "\n" not in str(error.value)
    assert scene.prior("masks") is None
    assert not any(scene.has_mask(i) for i in scene.train_frames)


def test_masks_by_which_everything_moves_are_taken_and_said(scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    labels = np.full((SIZE[1], SIZE[0]), 255, np.uint8)
    use_given(scene, GivenPriors(masks=write_masks(tmp_path / "masks", labels)))
    assert scene.mask(scene.train_frames[0]).all()
    assert "everything moves, and nothing rests" in capsys.readouterr().err


def test_a_large_object_is_no_inverted_mask(scene: Scene, tmp_path: Path):
    labels = np.full((SIZE[1], SIZE[0]), 255, np.uint8)
    labels[:, : SIZE[0] // 5] = labels[: SIZE[1] // 5] = 0
    use_given(scene, GivenPriors(masks=write_masks(tmp_path / "masks", labels)))
    assert scene.mask(scene.train_frames[0]).mean() > 0.6


@pytest.mark.parametrize("suffix", [".npy", ".png"])
def test_depth_of_0_or_nan_is_not_known(scene: Scene, tmp_path: Path, suffix: str):
    """As planar depth, and as depth cameras save it: whole millimeters in 16 bits, of which only the unit has to be fitted."""
    depth = ramp(427, 240, (427, 240))
    depth[:20, :100] = 0
    for i in range(FRAMES):
        if suffix == ".npy":
            depth[20:40, :100] = np.nan
            np.save(tmp_path / f"{i:05d}.npy", depth)
        else:
            cv2.imwrite(str(tmp_path / f"{i:05d}.png"), np.rint(depth * 1000).astype(np.uint16))
    given = open_depth(tmp_path, scene)
    found = given.read(4)
    unknown, unit = (80, 1) if suffix == ".npy" else (40, 65535 / 1000)
    assert given.fits == (("any",) if suffix == ".npy" else ())
    assert (found.confidence[:unknown, :200] == 0).all()
    assert (found.confidence[unknown:] == 1).all()
    assert (found.confidence[:, 200:] == 1).all()
    np.testing.assert_allclose(found.depth[unknown:] * unit, EXPECTED[unknown:], rtol=0.01)
    assert np.isfinite(found.depth).all()


def test_depth_that_is_none_is_refused(scene: Scene, tmp_path: Path):
    for i in range(FRAMES):
        np.save(tmp_path / f"{i:05d}.npy", np.full(SIZE[::-1], -1.0))
    with pytest.raises(InputError, match="depths that are not finite and positive, and no others"):
        open_depth(tmp_path, scene)

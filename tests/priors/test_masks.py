"""Masks of objects: found under a moving and a resting camera, cut out along the image, empty where nothing moves, numbered."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.priors.background.bits import pack
from flowsplat.priors.background.matched_clip import MAX_REST_NOISES, MatchedClip
from flowsplat.priors.background.static_depth import static_depth
from flowsplat.priors.flow import flow_stage
from flowsplat.priors.masks import background_plate, mask_stage
from flowsplat.priors.masks.background_plate import CleanPlate, PlateComparison, compare_detail, compare_light
from flowsplat.priors.masks.colors import ColorModel, look_up
from flowsplat.priors.masks.evidence import AXES, make_tables, read_tables, weigh_plates
from flowsplat.priors.masks.motion import MIN_RESTING_MOTION, RESTING_MOTION_RATIO, compute_own_evidence, estimate_resting_motion
from flowsplat.priors.masks.numbers import number_objects
from flowsplat.priors.masks.photometric_residual import Unexplained
from flowsplat.priors.masks.plane_sweep import largest_share
from flowsplat.scenes import Flow, Scene

from .planes import HEIGHT, WIDTH, write_planes


def overlap(scene: Scene, i: int) -> float:
    found, true = scene.mask(i) > 0, scene.truth.mask(i) > 0
    return float((found & true).sum() / (found | true).sum())


@pytest.mark.parametrize("step", [2, 0])
def test_the_square_is_found(tmp_path: Path, step: int):
    scene = write_planes(tmp_path, step=step, square=True, holdout=5)
    flow_stage(scene)
    mask_stage(scene)
    assert np.mean([overlap(scene, i) for i in scene.train_frames]) > 0.6
    how = scene.prior("masks")
    assert how["method"] == "motion"
    assert {int(n) for i in scene.train_frames for n in np.unique(scene.mask(i))} == {0, 1}
    assert how["objects"] == 1
    assert not any(scene.has_mask(i) for i in scene.heldout_frames)


@pytest.mark.parametrize("step", [2, 0])
def test_where_nothing_moves_masks_are_empty(tmp_path: Path, step: int):
    scene = write_planes(tmp_path, step=step, square=False)
    flow_stage(scene)
    mask_stage(scene)
    assert not any(scene.mask(i).any() for i in scene.train_frames)
    assert scene.prior("masks")["verdict"] == "nothing moves"


def motions(*values: np.ndarray) -> list[SimpleNamespace]:
    return [SimpleNamespace(motion=value.astype(np.float32)) for value in values]


@pytest.mark.parametrize(
    ("usual", "expected"),
    [(0.1, MIN_RESTING_MOTION), (0.5, 0.5 * RESTING_MOTION_RATIO), (2.0, MAX_REST_NOISES), (0.0, MAX_REST_NOISES)],
)
def test_what_rests_is_told_by_the_noise_of_the_clip(usual, expected):
    noise = np.full((30, 40), usual)
    noise[:5] = 20.0  # what moves is a smaller part
    noise[20:] = 0.0  # no match
    assert estimate_resting_motion(motions(noise, noise)) == pytest.approx(expected)


def test_slow_motion_counts_unless_it_fades_from_a_fast_object():
    motion = np.full((90, 160), 0.2)
    motion[20:40, 20:40] = 2.0
    motion[20:40, 100:120] = 12.0
    motion[20:40, 120:123] = 2.0
    evidence = compute_own_evidence(motions(motion), 0, 1.0)
    assert (evidence[20:40, 20:40] > 0).all()
    assert (evidence[22:38, 100:120] > 0).all()
    assert (evidence[22:38, 120:123] < 0).all()
    assert (evidence[60:] < 0).all()


def test_given_masks_stay(tmp_path: Path):
    scene = write_planes(tmp_path, step=2, square=True)
    for i in scene.train_frames:
        scene.write_mask(i, np.full((HEIGHT, WIDTH), 7, np.uint8))
    scene.finish_prior("masks", method="given")
    mask_stage(scene)
    assert (scene.mask(3) == 7).all()


def test_numbers_follow_the_flow_and_parting_objects_part(tmp_path: Path):
    scene = write_planes(tmp_path, step=0, square=False)
    steps = {(i, j): np.full((HEIGHT, WIDTH, 2), [6.0 * (j - i), 0], np.float32) for i in range(12) for j in (i - 1, i + 1)}
    for (i, j), flow in steps.items():
        if 0 <= j < 12:
            scene.write_flow(Flow(i, j, flow, np.ones((HEIGHT, WIDTH), np.float32)))
    for i in scene.train_frames:
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        mask[10:20, 6 * i + 4 : 6 * i + 14] = 1
        mask[20:30, 6 * i + 4 : 6 * i + 14] = i < 6
        mask[32:44, 6 * i + 4 : 6 * i + 14] = i >= 6
        mask[60:70, 6 * i + 4 : 6 * i + 14] = 1
        scene.write_mask(i, mask)
    objects, share = number_objects(scene)
    assert (objects, scene.mask(5)[15, 36], scene.mask(5)[65, 36]) == (3, 1, 2)
    assert scene.mask(11)[15, 72] == 1
    assert scene.mask(11)[38, 72] == 3
    assert scene.mask(11)[65, 72] == 2
    assert share == pytest.approx(310 / (HEIGHT * WIDTH), rel=0.05)


def still_flow(scene: Scene) -> None:
    for i in scene.train_frames:
        for j in (i - 1, i + 1):
            if 0 <= j < scene.num_frames:
                scene.write_flow(Flow(i, j, np.zeros((HEIGHT, WIDTH, 2), np.float32), np.ones((HEIGHT, WIDTH), np.float32)))


def test_objects_that_meet_and_part_keep_their_numbers(tmp_path: Path):
    scene = write_planes(tmp_path, step=0, square=False)
    still_flow(scene)
    for i in scene.train_frames:
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        mask[20:40, 20:40] = 1
        mask[20:50, 44:74] = 1
        mask[25:30, 40:44] = i in range(4, 8)
        scene.write_mask(i, mask)
    objects, _ = number_objects(scene)
    assert objects == 2
    for i in scene.train_frames:
        assert (scene.mask(i)[20:40, 20:40] == 2).all()
        assert (scene.mask(i)[20:50, 44:74] == 1).all()


def test_what_differs_from_the_plate_is_what_moves(tmp_path: Path):
    scene = write_planes(tmp_path, step=2, square=True)
    flow_stage(scene)
    blocked = np.stack([scene.truth.mask(i) > 0 for i in scene.train_frames])
    for i in scene.train_frames:
        scene.write_mask(i, blocked[i])
    clip = MatchedClip(scene)
    found = CleanPlate(clip, static_depth(clip, True), blocked).compare(6)
    seen, moving = found.similar >= 0, blocked[6]
    assert (seen & moving).sum() > 0.5 * moving.sum()
    for residual in (found.similar, found.median):
        assert np.median(residual[seen & ~moving]) < 1
        assert np.median(residual[seen & moving]) > 2.5
    evidence = weigh_plates(read_tables(), found, np.zeros((HEIGHT, WIDTH), np.float32))
    assert np.median(evidence[seen & ~moving]) < -1
    assert np.median(evidence[seen & moving]) > 1


def test_where_no_frame_sees_past_an_object_its_plate_is_unknown(tmp_path: Path):
    scene = write_planes(tmp_path, step=0, square=False)
    flow_stage(scene)
    clip = MatchedClip(scene)
    blocked = np.zeros((len(clip), HEIGHT, WIDTH), bool)
    blocked[:, 20:30, 20:30] = True
    found = CleanPlate(clip, static_depth(clip, False), blocked).compare(5)
    for residual in (found.similar, found.median):
        assert (residual[20:30, 20:30] == -1).all()
        assert (residual[40:, 2:-2] >= 0).all()
        assert residual.max() < 1
    # Without a plate the matches decide alone.
    for motion in (-10, 10):
        evidence = weigh_plates(read_tables(), found, np.full((HEIGHT, WIDTH), motion, np.float32))
        assert (np.sign(evidence[20:30, 20:30]) == np.sign(motion)).all()


@pytest.mark.parametrize("brightness", [0.8, 0.6])
def test_a_shadow_is_no_object(tmp_path: Path, brightness: float):
    scene = write_planes(tmp_path, step=0, square=False)
    dark = scene.frame(5).astype(np.float32)
    dark[20:50, 20:60] *= brightness
    scene.write_frame(5, dark.astype(np.uint8))
    flow_stage(scene)
    clip = MatchedClip(scene)
    found = CleanPlate(clip, static_depth(clip, False), np.zeros((len(clip), HEIGHT, WIDTH), bool)).compare(5)
    evidence = weigh_plates(read_tables(), found, np.full((HEIGHT, WIDTH), -3, np.float32))
    assert np.median(evidence[25:45, 25:55]) < -1


def test_the_middle_plate_is_the_middle_of_what_others_see(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A third of the other frames that look like the pixel by chance explain it to the similar plate alone."""
    monkeypatch.setattr(background_plate, "FEW_FRAMES", 4)
    monkeypatch.setattr(background_plate, "PLATE_OFFSETS", range(1, 6))
    scene = write_planes(tmp_path, step=0, square=False)
    odd = np.full((30, 40, 3), (250, 20, 20), np.uint8)
    for i in (5, 0, 2, 8, 10):
        frame = scene.frame(i).copy()
        frame[20:50, 20:60] = odd
        scene.write_frame(i, frame)
    flow_stage(scene)
    clip = MatchedClip(scene)
    found = CleanPlate(clip, static_depth(clip, False), np.zeros((len(clip), HEIGHT, WIDTH), bool)).compare(5)
    assert np.median(found.similar[25:45, 25:55]) < 1
    assert np.median(found.median[25:45, 25:55]) > 5


def test_light_is_compared_by_brightness_and_tint():
    plate = np.full((20, 20, 3), 120, np.float32)
    brightness, tint = compare_light((0.5 * plate).astype(np.uint8), plate)
    np.testing.assert_allclose(brightness, np.log(66 / 126), rtol=1e-5)
    np.testing.assert_allclose(tint, 0, atol=1e-5)
    red = np.broadcast_to(np.array([120, 60, 60], np.uint8), plate.shape)
    brightness, tint = compare_light(red, plate)
    np.testing.assert_allclose(tint, np.log(126 / 66), rtol=1e-5)


def test_detail_stays_in_a_shadow_and_not_on_an_object():
    rng = np.random.default_rng(0)
    noise = (cv2.GaussianBlur(rng.normal(0, 0.5, (60, 60)), (0, 0), 1.5) for _ in range(2))
    plate, other = (np.repeat(np.clip(120 + 400 * each, 5, 250)[..., None], 3, 2) for each in noise)
    assert compare_detail((0.5 * plate).astype(np.uint8), plate).min() > 0.9
    assert np.abs(compare_detail(other.astype(np.uint8), plate)).mean() < 0.4
    flat = np.full((60, 60, 3), 30, np.uint8)  # black under a car: nothing tells
    np.testing.assert_allclose(compare_detail(flat, plate), 0, atol=1e-3)


def test_evidence_grows_with_what_differs_and_a_shadow_counts_less_than_another_color():
    tables, shape = read_tables(), (1, 12)
    off, zero = np.linspace(0.2, 8, 12, dtype=np.float32).reshape(shape), np.zeros(shape, np.float32)
    evidence = weigh_plates(tables, PlateComparison(off, off, zero, zero + 0.5, zero), zero)
    assert (np.diff(evidence) > -0.1).all()
    assert evidence[0, 0] < -2
    assert evidence[0, -1] > 4
    high, dark = np.full(shape, 4, np.float32), np.full(shape, np.log(0.6), np.float32)
    shadow = weigh_plates(tables, PlateComparison(high, high, dark, zero, zero), zero)
    colored = weigh_plates(tables, PlateComparison(high, high, dark, zero + 0.6, zero), zero)
    assert (shadow + 2 < colored).all()
    on_its_ground = weigh_plates(tables, PlateComparison(high, high, dark, zero, zero + 0.9), zero)
    assert (on_its_ground + 1 < shadow).all()


def test_tables_of_other_knots_are_refused():
    values = {
        name: {"knots": [list(knots) for knots in axes], "log odds": np.zeros([len(knots) for knots in axes]).tolist()}
        for name, axes in AXES.items()
    }
    assert (make_tables(values).look_up("motion", np.array([3.0])) == 0).all()
    values["light"]["knots"][0][0] = -3.0
    with pytest.raises(InputError, match="mask_evidence"):
        make_tables(values)


def test_the_still_scene_explains_all_but_what_moves(tmp_path: Path):
    scene = write_planes(tmp_path, step=3, square=True)
    flow_stage(scene)
    clip = MatchedClip(scene)
    evidence = Unexplained(clip, static_depth(clip, False)).evidence(6)
    assert evidence.shape == (clip.height, clip.width)
    moving = cv2.resize(scene.truth.mask(6), (clip.width, clip.height), interpolation=cv2.INTER_AREA) > 0
    inside = cv2.erode(moving.astype(np.uint8), np.ones((5, 5))) > 0
    outside = cv2.dilate(moving.astype(np.uint8), np.ones((5, 5))) == 0
    assert np.median(evidence[inside]) > 2
    assert (evidence[outside] < 0).mean() > 0.85


def test_what_rests_looks_the_same_at_its_depth_and_what_moves_at_none(tmp_path: Path):
    scene = write_planes(tmp_path, step=4, square=True)
    cameras = scene.cameras
    others = [i for i in range(scene.num_frames) if i != 6]
    intrinsics = np.array([cameras[i].intrinsics for i in (6, *others)], np.float32)
    poses = np.array([cameras[i].pose_from(cameras[6]) for i in others], np.float32)
    asked = np.ones((HEIGHT, WIDTH), bool)
    asked[:20] = False
    words = pack(np.stack([scene.frame(i) for i in others]), np.zeros((len(others), HEIGHT, WIDTH), np.bool_))
    share = largest_share(scene.frame(6), asked, 1.0, intrinsics, poses, words)
    assert (share[:20] == -1).all()
    inside = cv2.erode(scene.truth.mask(6), np.ones((7, 7))) > 0
    outside = cv2.dilate(scene.truth.mask(6), np.ones((7, 7))) == 0
    outside &= asked
    outside[:, :2] = outside[:, -2:] = outside[-2:] = False
    assert np.median(share[inside & asked]) < 0.4
    # The square hides the wall in some of the frames.
    assert np.median(share[outside]) > 0.8


def test_colors_tell_objects_from_what_is_round_them():
    frame = np.full((60, 80, 3), (90, 100, 110), np.uint8)
    moving = np.zeros((60, 80), bool)
    moving[20:40, 30:50] = True
    frame[moving] = (200, 40, 30)
    colors = ColorModel()
    assert colors.table() is None
    colors.add(frame, moving)
    values = look_up(colors.table(), frame)
    assert (values[moving] > 2).all()
    assert (values[~moving] < -2).all()

"""Masks of objects: found under a moving and a resting camera, cut out along the image, empty where nothing moves, numbered."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from flowsplat.priors.background.bits import pack
from flowsplat.priors.background.matched_clip import MAX_REST_NOISES, MatchedClip
from flowsplat.priors.background.static_depth import static_depth
from flowsplat.priors.flow import flow_stage
from flowsplat.priors.masks import mask_stage
from flowsplat.priors.masks.background_plate import CleanPlate
from flowsplat.priors.masks.colors import ColorModel, look_up
from flowsplat.priors.masks.motion import MIN_RESTING_MOTION, RESTING_MOTION_RATIO, compute_own_evidence, estimate_resting_motion
from flowsplat.priors.masks.numbers import number_objects
from flowsplat.priors.masks.photometric_residual import Unexplained
from flowsplat.priors.masks.plane_sweep import largest_share
from flowsplat.priors.masks.stage import NEUTRAL_RESIDUAL
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
    assert {int(n) for i in scene.train_frames for n in np.unique(scene.mask(i))} == {0, 1}
    how = scene.prior("masks")
    assert how["method"] == "motion"
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
    residual = CleanPlate(clip, static_depth(clip, True), blocked).residual(6)
    seen, moving = residual >= 0, blocked[6]
    assert (seen & moving).sum() > 0.5 * moving.sum()
    assert np.median(residual[seen & ~moving]) < 1
    assert np.median(residual[seen & moving]) > 2.5


def test_where_no_frame_sees_past_an_object_its_plate_is_unknown(tmp_path: Path):
    scene = write_planes(tmp_path, step=0, square=False)
    flow_stage(scene)
    clip = MatchedClip(scene)
    blocked = np.zeros((len(clip), HEIGHT, WIDTH), bool)
    blocked[:, 20:30, 20:30] = True
    residual = CleanPlate(clip, static_depth(clip, False), blocked).residual(5)
    assert (residual[20:30, 20:30] == -1).all()
    assert (residual[40:, 2:-2] >= 0).all()
    assert residual.max() < 1


def test_a_shadow_is_no_object(tmp_path: Path):
    scene = write_planes(tmp_path, step=0, square=False)
    dark = scene.frame(5).astype(np.float32)
    dark[20:50, 20:60] *= 0.8
    scene.write_frame(5, dark.astype(np.uint8))
    flow_stage(scene)
    clip = MatchedClip(scene)
    residual = CleanPlate(clip, static_depth(clip, False), np.zeros((len(clip), HEIGHT, WIDTH), bool)).residual(5)
    assert np.median(residual[25:45, 25:55]) < NEUTRAL_RESIDUAL


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

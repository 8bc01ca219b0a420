"""Clicks and boxes: how they are typed, what they cut out, and how it is carried through the clip."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.priors.flow import dis_estimator, flow_stage
from flowsplat.priors.prompts import Prompt, cut_prompts, parse_prompts, prompt_stage, show_at_once
from flowsplat.priors.prompts.cutting import cut_out
from flowsplat.priors.prompts.grabcut import snap_to_edges
from flowsplat.priors.prompts.propagation import Walk
from flowsplat.scenes import Flow, Scene
from flowsplat.scenes.layers import read_image

from .planes import FRAMES, HEIGHT, SIDE, WIDTH, camera_at, square_at, texture, write_planes


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    """A square that moves before a wall that moves too; frame 4 is held out."""
    scene = write_planes(tmp_path_factory.mktemp("planes"), step=2, square=True, holdout=5)
    flow_stage(scene)
    return scene


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def test_clicks_and_boxes_as_they_are_typed(scene: Scene):
    clicks, boxes = ["100,70@3", " 0.25, 0.5 @ 3", "40.5,20@0"], ["10,20,50,60@3", "0.5,0,1,0.5@8"]
    assert parse_prompts(clicks, boxes, scene) == [
        Prompt(3, ((32.0, 40.0),), (10, 20, 50, 60), number=1),
        Prompt(8, (), (64, 0, 128, 40), number=2),
        Prompt(3, ((100.0, 70.0),), number=3),
        Prompt(0, ((40.5, 20.0),), number=4),
    ]
    assert parse_prompts([], ["100,60,150,90@0"], scene)[0].box == (100, 60, 128, 80)


def test_corrections_belong_to_the_object_of_their_number(scene: Scene):
    found = parse_prompts(["60,40@8", "62,44@5=1", "10,10@0=2"], ["10,20,50,60@3"], scene, ["5,5@5=1", "90,70@8"])
    assert found == [
        Prompt(3, (), (10, 20, 50, 60), number=1),
        Prompt(5, ((62.0, 44.0),), None, ((5.0, 5.0),), 1),
        Prompt(8, (), None, ((90.0, 70.0),), 1),
        Prompt(8, ((60.0, 40.0),), None, ((90.0, 70.0),), 2),
        Prompt(0, ((10.0, 10.0),), None, (), 2),
    ]


@pytest.mark.parametrize(
    ("clicks", "beside", "message"),
    [
        ([], ["10,20@3"], "--mask-negative takes away from what --mask-click or --mask-box shows: give one of these, too"),
        (["10,20@3"], ["10,20@3=2"], "--mask-negative 10,20@3=2: there is no object 2; clicks and boxes show 1"),
        (["10,20@3=1"], [], "--mask-click 10,20@3=1: there is no object 1; clicks and boxes show none"),
        (["10,20@3=one"], [], "behind = stands the number of an object, 1 or more"),
        (["10,20@3"], ["10,20"], "--mask-negative 10,20 cannot be understood"),
        (["10,20@3"], ["10,20@3"], "say the opposite of one place on frame 3"),
    ],
)
def test_a_correction_of_nothing_is_refused_in_one_line(scene: Scene, clicks, beside, message: str):
    with pytest.raises(InputError, match=message) as caught:
        parse_prompts(clicks, [], scene, beside)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("clicks", "boxes", "message"),
    [
        (["10,20"], [], r"--mask-click 10,20 cannot be understood: give x,y@frame, for example --mask-click 320,180@0"),
        (["10@3"], [], "cannot be understood"),
        (["a,b@3"], [], "cannot be understood"),
        (["10,20@-1"], [], "cannot be understood"),
        (["10,20@" + 5000 * "1"], [], "cannot be understood"),
        (["500,20@3"], [], "outside the frames, which have 128x80 pixels"),
        (["-5,20@3"], [], "outside"),
        (["10,20@4"], [], "frame 4 is held out for the figures; choose another, for example 3"),
        (["10,20@12"], [], "no frame 12; they count from 0 to 11"),
        ([], ["10,20,30@3"], "give x0,y0,x1,y1@frame"),
        ([], ["30,20,10,40@3"], "is empty"),
        ([], ["200,20,210,40@3"], "is empty"),
    ],
)
def test_what_is_no_prompt_is_refused_in_one_line(scene: Scene, clicks, boxes, message: str):
    with pytest.raises(InputError, match=message) as caught:
        parse_prompts(clicks, boxes, scene)
    assert "\n" not in str(caught.value)


X, Y = square_at(5)
CENTER = ((X + SIDE / 2, Y + SIDE / 2),)
BOX = (X - 6, Y - 4, X + SIDE + 5, Y + SIDE + 6)


@pytest.mark.parametrize("prompt", [Prompt(5, CENTER), Prompt(5, (), BOX), Prompt(5, CENTER, BOX)])
def test_an_object_is_cut_out(scene: Scene, prompt: Prompt):
    (found,) = cut_prompts(scene, [prompt], dis_estimator)
    assert overlap(found, scene.truth.mask(5) > 0) > 0.75


def test_an_object_at_rest_is_cut_out_by_its_colors():
    image = np.full((80, 120, 3), 60, np.uint8)
    image[20:50, 30:70] = [200, 90, 40]
    image = np.clip(image + np.random.default_rng(0).normal(0, 4, image.shape), 0, 255).astype(np.uint8)
    true = np.zeros((80, 120), bool)
    true[20:50, 30:70] = True
    still = Flow(0, 1, np.zeros((80, 120, 2), np.float32), np.ones((80, 120), np.float32))
    for prompt in (Prompt(0, ((50.0, 35.0),)), Prompt(0, (), (22, 14, 80, 58))):
        assert overlap(cut_out(image, still, prompt), true) > 0.95


def test_a_plain_image_gives_what_was_shown():
    image = np.full((60, 90, 3), 128, np.uint8)
    still = Flow(0, 1, np.zeros((60, 90, 2), np.float32), np.ones((60, 90), np.float32))
    found = cut_out(image, still, Prompt(0, ((30.0, 30.0),), (20, 20, 40, 40)))
    assert found[30, 30]
    assert found.sum() <= 400


def posters(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two frames [160, 280, 3] of a wall of posters, before which something of its colors goes by, and its mask in the first."""
    rng = np.random.default_rng(seed)
    colors = np.array([[200, 60, 50], [60, 90, 190], [230, 200, 70], [70, 150, 80], [225, 225, 220]])
    grain = rng.normal(0, 9, (2, 160, 300, 1))
    wall = np.kron(colors[rng.integers(5, size=(8, 15))], np.ones((20, 20, 1))) + grain[0]
    frames, mask = [], np.zeros((160, 280), bool)
    parts = [(slice(46, 100), slice(110, 140), 1), (slice(100, 150), slice(110, 140), 0), (slice(10, 50), slice(138, 178), 2)]
    for i in range(2):
        frame = wall[:, 3 * i : 3 * i + 280].copy()
        for rows, columns, color in parts:  # shirt, trousers, balloon
            moved = slice(columns.start + 2 * i, columns.stop + 2 * i)
            frame[rows, moved] = colors[color] + grain[1, rows, columns]
            mask[rows, columns] = True
        frames.append(np.clip(frame, 0, 255).astype(np.uint8))
    return frames[0], frames[1], mask


def test_what_moves_apart_is_told_from_posters_in_its_colors():
    box, told, by_colors = Prompt(0, (), (100, 5, 186, 156)), [], []
    for seed in range(3):
        first, second, mask = posters(seed)
        flow = Flow(0, 1, dis_estimator(first, second), np.ones(mask.shape, np.float32))
        still = Flow(0, 1, np.zeros_like(flow.flow), flow.confidence)
        told.append(overlap(cut_out(first, flow, box), mask))
        by_colors.append(overlap(cut_out(first, still, box), mask))
    assert min(told) > 0.75
    assert np.mean(told) > np.mean(by_colors) + 0.1


def test_what_they_mean_is_drawn_at_once(scene: Scene):
    prompts = parse_prompts(["100,20@0"], [",".join(map(str, BOX)) + "@5"], scene, ["5,5@5"])
    path = show_at_once(scene, prompts, dis_estimator)
    image = read_image(path)
    assert image.shape == (2 * HEIGHT + 4, WIDTH, 3)
    row = image[HEIGHT + 4 :]
    colored = np.ptp(row[Y + 4 : Y + SIDE - 4, X + 4 : X + SIDE - 4].astype(int), axis=-1).mean()
    assert colored > 3 * np.ptp(row[60:, :20].astype(int), axis=-1).mean()
    assert (row[3:8, 3:8] == [240, 50, 50]).all(-1).any()


def test_a_later_frame_corrects_what_was_found(scene: Scene):
    frames = scene.train_frames
    evidence = [np.where(scene.truth.mask(i) > 0, 4, -4).astype(np.float32) for i in frames]
    for e in evidence:
        e[60:78, 100:124] = 4  # something else that moves
    x, y = square_at(8)
    wrong = Prompt(0, ((112.0, 69.0),))
    alone = Walk(scene, [wrong], evidence).parts()[frames.index(8)].mask
    right = Prompt(8, ((x + SIDE / 2, y + SIDE / 2),), None, ((112.0, 69.0),))
    both = Walk(scene, [wrong, right], evidence).parts()
    true = [scene.truth.mask(i) > 0 for i in frames]
    assert overlap(alone, true[frames.index(8)]) < 0.1
    for i in (7, 8, 10):
        k = frames.index(i)
        assert overlap(both[k].mask, true[k]) > 0.75, i


def test_an_edge_is_moved_to_that_of_the_image():
    image = np.zeros((100, 160, 3), np.uint8)
    image[..., 2] = texture(0, 160, 100)[..., 0] // 3
    image[30:70, 50:100, 0] = 200
    true = image[..., 0] > 0
    shifted = np.roll(true, (1, 2), (0, 1))
    assert overlap(snap_to_edges(image, shifted), true) > 0.98 > overlap(shifted, true)


@pytest.mark.parametrize("start", [0, 5, FRAMES - 1])
def test_a_mask_is_carried_both_ways(scene: Scene, start: int):
    x, y = square_at(start)
    prompt_stage(scene, parse_prompts([], [f"{x - 3},{y - 3},{x + SIDE + 3},{y + SIDE + 3}@{start}"], scene))
    overlaps = [overlap(scene.mask(i) > 0, scene.truth.mask(i) > 0) for i in scene.train_frames]
    assert np.mean(overlaps) > 0.8
    assert min(overlaps) > 0.7
    assert not any(scene.has_mask(i) for i in scene.heldout_frames)
    how = scene.prior("masks")
    assert how["method"] == "clicks"
    assert how["objects"] == 1
    assert how["confidence"] > 0.8


def test_two_prompts_on_one_object_are_one_and_others_are_their_own(scene: Scene):
    boxes = []
    for i in (0, 8):
        x, y = square_at(i)
        boxes.append(f"{x - 3},{y - 3},{x + SIDE + 3},{y + SIDE + 3}@{i}")
    prompt_stage(scene, parse_prompts([], [*boxes, "100,2,120,18@0"], scene))
    assert scene.prior("masks")["objects"] == 2
    x, y = square_at(8)
    assert scene.mask(8)[y + SIDE // 2, x + SIDE // 2] == 1
    assert 2 in np.unique(scene.mask(0)[:20, 95:])


def test_the_same_prompts_give_the_same_masks(scene: Scene):
    prompts = parse_prompts([f"{X + 14},{Y + 14}@5"], [], scene)
    prompt_stage(scene, prompts)
    first = [scene.mask(i) for i in scene.train_frames]
    prompt_stage(scene, prompts)
    for i, mask in zip(scene.train_frames, first, strict=True):
        np.testing.assert_array_equal(scene.mask(i), mask)
    assert first[0].shape == (HEIGHT, WIDTH)


def test_what_is_beside_one_object_leaves_the_others_as_they_are(scene: Scene):
    evidence = [np.where(scene.truth.mask(i) > 0, 4, -4).astype(np.float32) for i in scene.train_frames]
    for e in evidence:
        e[60:78, 100:124] = 4  # moves, where the image has no edge: cut out anew it would be another
    click, far, on = (112.0, 69.0), (20.0, 8.0), (112.0, 69.0)

    def masks(*prompts: Prompt) -> np.ndarray:
        return np.stack([part.mask for part in Walk(scene, prompts, evidence).parts()])

    alone = masks(Prompt(0, (click,)))
    np.testing.assert_array_equal(alone, masks(Prompt(0, (click,), None, (far,)), Prompt(8, (), None, (far,))))
    k = scene.train_frames.index(8)
    assert alone[k, 69, 112]
    assert not masks(Prompt(0, (click,)), Prompt(8, (), None, (on,)))[k, 69, 112]


def test_what_leaves_the_image_is_gone(tmp_path: Path):
    scene = Scene.create(tmp_path, name="s", source="", width=96, height=64, timestamps=range(6), holdout=None, source_fps=1)
    wall, body = texture(0, 96, 64), texture(1, 30, 30)
    for i in range(6):
        frame = wall.copy()
        left = 60 + 12 * i
        frame[20:50, left : left + 30] = body[:, : max(0, 96 - left)]
        scene.write_frame(i, frame)
    flow_stage(scene)
    scene.write_cameras([camera_at(0)] * 6)
    scene.finish_prior("cameras", method="given")
    prompt_stage(scene, parse_prompts([], ["57,17,93,53@0"], scene))
    assert scene.mask(0).sum() > 600
    assert scene.mask(5).sum() < 0.1 * scene.mask(0).sum()

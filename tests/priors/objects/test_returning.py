"""Who leaves and comes back: told by its looks, joined under the earlier number, said in words; and nothing else changes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from flowsplat.geometry import Camera
from flowsplat.priors.objects.distance import Cue
from flowsplat.priors.objects.identity.appearance import MaskedFrames, look
from flowsplat.priors.objects.identity.returning import Pair, join_pairs, list_pairs, read_classifier, score_pairs
from flowsplat.priors.objects.returns import describe_returns, find_returns, join_returns
from flowsplat.priors.objects.shape_offset import ShapePoints
from flowsplat.priors.objects.solving import DynamicObject
from flowsplat.priors.objects.storage import SceneObjects
from flowsplat.scenes import Scene

WIDTH, HEIGHT, FRAMES, FPS = 160, 96, 48, 12.0
K = np.array([[160.0, 0, WIDTH / 2], [0, 160.0, HEIGHT / 2], [0, 0, 1]])
RED, BLUE = ((40, 30, 30), (190, 40, 40), (60, 60, 70)), ((230, 220, 200), (40, 60, 180), (200, 190, 90))
"""Colors of head, coat and trousers."""


@dataclass(frozen=True)
class Person:
    """A box of three colors, 16 by 36 pixels: its number, left and top in every frame, and where it is in the mask."""

    number: int
    colors: Sequence[tuple[int, int, int]]
    left: np.ndarray
    top: int
    shown: np.ndarray


def film(people: Sequence[Person], turns: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, list[Camera]]:
    """Images, masks and cameras; ``turns`` [T] radians to the right, by which all that is seen goes to the left."""
    rng = np.random.default_rng(0)
    images = rng.integers(110, 140, (FRAMES, HEIGHT, WIDTH, 3)).astype(np.uint8)
    masks, cameras = np.zeros((FRAMES, HEIGHT, WIDTH), np.uint8), []
    for k in range(FRAMES):
        angle = 0.0 if turns is None else float(turns[k])
        for person in people:
            left = round(float(person.left[k]) - K[0, 0] * np.tan(angle))
            columns = slice(max(left, 0), max(left + 16, 0))
            for third, color in enumerate(person.colors):
                rows = slice(person.top + 12 * third, person.top + 12 * third + 12)
                here = images[k, rows, columns]
                images[k, rows, columns] = np.clip(color + rng.normal(size=here.shape) * 8, 0, 255)
            if person.shown[k]:
                masks[k, person.top : person.top + 36, columns] = person.number
        viewmat = np.eye(4)
        viewmat[:3, :3] = [[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]]
        cameras.append(Camera(viewmat, K, WIDTH, HEIGHT))
    return images, masks, cameras


def clip_of(images: np.ndarray, masks: np.ndarray, cameras: list[Camera]) -> MaskedFrames:
    return MaskedFrames(np.arange(FRAMES) / FPS, np.zeros(FRAMES, int), cameras, lambda k: masks[k], lambda k: images[k])


def during(first: int, last: int) -> np.ndarray:
    frames = np.arange(FRAMES)
    return (frames >= first) & (frames < last)


GOES_OUT = np.abs(np.linspace(-110, 110, FRAMES)) - 30
"""It walks out of the image on the left and comes back."""
LEAVES_AND_BACK = 20, 27
"""Frames."""
ALONG = np.linspace(60, 110, FRAMES)
BACK = [
    Person(1, RED, GOES_OUT, 20, during(0, FRAMES // 2)), Person(2, BLUE, ALONG, 50, during(0, FRAMES)),
    Person(3, RED, GOES_OUT, 20, during(FRAMES // 2, FRAMES)),
]  # fmt: skip


def test_who_walks_out_and_back_is_one_and_another_person_is_not():
    clip = clip_of(*film(BACK))
    (pair,) = score_pairs(clip)
    assert (pair.before, pair.after) == (1, 3)
    assert (pair.last, pair.first) == LEAVES_AND_BACK
    assert join_pairs([pair], read_classifier().gate) == [pair]
    stranger = [*BACK[:2], replace(BACK[2], colors=BLUE, top=50)]
    (other,) = score_pairs(clip_of(*film(stranger)))
    assert other.probability < 0.5
    assert join_pairs([other], read_classifier().gate) == []


def test_a_camera_that_turns_away_and_back_is_taken_off():
    turns = 0.6 * np.sin(np.linspace(0, np.pi, FRAMES))
    stands = np.full(FRAMES, 90.0)
    people = [Person(1, RED, stands, 20, during(0, 24)), Person(2, RED, stands, 20, during(24, FRAMES))]
    images, masks, cameras = film(people, turns)
    shown = [clip_of(images, masks, cameras), clip_of(images, masks, [cameras[0]] * FRAMES)]
    for clip in shown:
        (pair,), areas = list_pairs(clip)
        ends = [look(clip, number, np.flatnonzero(areas[:, number]), areas[areas[:, number] > 0, number], end)
                for number, end in zip(pair, (True, False), strict=True)]  # fmt: skip
        assert ends[0].height == ends[1].height == pytest.approx(36 / WIDTH)
        np.testing.assert_allclose(ends[0].colors.sum(1), 1)
        assert ends[0].borders.tolist() == ends[1].borders.tolist() == [True, False, False, False]
    assert score_pairs(shown[0])[0].probability > 0.9


def test_only_who_ends_before_another_begins_is_compared():
    always = [Person(n, RED, ALONG - 40 * n, 20, during(0, FRAMES)) for n in (1, 2)]
    assert score_pairs(clip_of(*film(always))) == []
    handed_over = [Person(1, RED, ALONG, 20, during(0, 20)), Person(2, RED, ALONG, 20, during(20, FRAMES))]
    assert score_pairs(clip_of(*film(handed_over))) == []
    apart = [handed_over[0], replace(handed_over[1], shown=during(26, FRAMES))]
    clip = clip_of(*film(apart))
    assert len(score_pairs(clip)) == 1
    assert score_pairs(replace(clip, pieces=np.arange(FRAMES) // 22)) == [], "either side of a cut is a world of its own"


def test_everyone_goes_on_once_and_the_surest_first():
    a_c, b_c, a_d, c_d = (Pair(a, b, 5, 9, p) for a, b, p in ((1, 3, 0.95), (2, 3, 0.97), (1, 4, 0.96), (3, 4, 0.99)))
    assert {(p.before, p.after) for p in join_pairs([a_c, b_c, a_d, c_d], 0.9)} == {(2, 3), (3, 4)}
    assert join_pairs([a_c, b_c], 0.98) == []


def scene_of(folder: Path, images: np.ndarray, masks: np.ndarray, cameras: list[Camera]) -> Scene:
    scene = Scene.create(
        folder, name="people", source="people", width=WIDTH, height=HEIGHT, timestamps=np.arange(FRAMES) / FPS, holdout=None,
        source_fps=FPS,
    )  # fmt: skip
    scene.write_cameras(cameras)
    scene.finish_prior("cameras", method="tracks", breaks=[])
    for t in scene.train_frames:
        scene.write_frame(t, images[t])
        scene.write_mask(t, masks[t])
    scene.finish_prior("masks", method="motion", objects=int(masks.max()), share=0.125, verdict="moving objects")
    return scene


def object_of(number: int, masks: np.ndarray, depth: float, sigma: float) -> DynamicObject:
    seen = (masks == number).any((1, 2))
    frames = np.flatnonzero(seen)
    points = ShapePoints(frames, np.full((len(frames), 2), 5.0), np.full(len(frames), depth), np.full(len(frames), 0.1))
    middles = np.where(seen[:, None], 7.0, np.nan).repeat(2, 1)
    return DynamicObject(number, np.where(seen, depth, np.nan), middles, sigma, True, {f"cue{number}": Cue(0, 1, 1)}, points, 0.1)


def stored(scene: Scene) -> np.ndarray:
    return np.stack([scene.mask(i) for i in scene.train_frames])


def test_masks_objects_and_record_have_the_earlier_number(tmp_path: Path):
    # A fourth begins late: numbers stay without gaps.
    people = [*BACK, Person(4, BLUE, ALONG, 5, during(FRAMES - 2, FRAMES))]
    images, masks, cameras = film(people)
    scene = scene_of(tmp_path, images, masks, cameras)
    objects = [object_of(number, masks, float(number), 0.1 * number) for number in (1, 2, 3, 4)]
    found = join_returns(scene, SceneObjects(objects, np.array([0, -1.0, 0])), find_returns(scene))
    assert (stored(scene) == np.array([0, 1, 2, 1, 3])[masks]).all()
    assert [obj.number for obj in found.objects] == [1, 2, 3]
    one = found.objects[0]
    np.testing.assert_array_equal(one.log_depth, np.where(np.isfinite(objects[0].log_depth), 1.0, objects[2].log_depth))
    assert (one.sigma, list(one.cues)) == (objects[2].sigma, ["cue3"]), "what is said of its distance is the less sure of both"
    assert sorted(one.points.frame_of.tolist()) == np.flatnonzero(np.isfinite(one.log_depth)).tolist()
    record = scene.prior("masks")
    assert record["objects"] == 3
    (told,) = record["returns"]
    assert (told["object"], told["leaves"], told["back"]) == (1, *(round(k / FPS, 3) for k in LEAVES_AND_BACK))
    assert describe_returns(record) in record["verdict"]
    assert "object 1 leaves at 1.7 s and is back at 2.2 s, sure to" in record["verdict"]
    assert record["verdict"].startswith("2 moving objects and 1 small part on 12.5% of the image; ")


def test_who_may_be_back_is_said_and_not_joined(tmp_path: Path):
    images, masks, cameras = film(BACK)
    scene = scene_of(tmp_path, images, masks, cameras)
    found = SceneObjects([], np.array([0, -1.0, 0]))
    unsure = replace(find_returns(scene)[0], probability=0.7)
    assert join_returns(scene, found, [unsure], replace(read_classifier(), gate=0.9, maybe=0.5)) is found
    assert (stored(scene) == masks).all()
    words = "object 1 leaves at 1.7 s and may be back at 2.2 s as object 3 (70%)"
    assert scene.prior("masks")["verdict"] == f"3 moving objects on 12.5% of the image; {words}"
    scene.amend_prior("masks", verdict="3 moving objects on 12.5% of the image")
    join_returns(scene, found, [replace(unsure, probability=0.1)], replace(read_classifier(), gate=0.9, maybe=0.5))
    assert describe_returns(scene.prior("masks")) == "", "what an earlier run found is taken out"


def test_a_clip_in_which_nobody_ends_before_another_begins_stays_bit_for_bit(tmp_path: Path):
    people = [Person(1, RED, ALONG, 20, during(0, FRAMES)), Person(2, RED, ALONG, 58, during(0, 20))]
    scene = scene_of(tmp_path, *film(people))
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    found = SceneObjects([], np.array([0, -1.0, 0]))
    assert join_returns(scene, found, find_returns(scene)) is found
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before

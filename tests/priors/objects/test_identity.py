"""Numbers of objects: discs that cross, limbs, masks that break, too few tracks, cuts, and masks that came with numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from flowsplat.common.threads import set_thread_count, thread_count
from flowsplat.geometry import Camera
from flowsplat.priors.objects.identity import MaskedTracks, identify_objects, identify_tracks, paint
from flowsplat.scenes import Flow, Scene, Tracks

WIDTH, HEIGHT, FRAMES = 160, 120, 24
LIFE = 9
"""Frames after which a track ends and another begins in its place."""
NOISE = 0.15
"""Pixels by which tracks are off."""


@dataclass(frozen=True)
class Body:
    """Something that moves, nearer than those before it in a list.

    Attributes:
        holds: whether points [..., 2] in its own coordinates, in pixels about its middle, are on it.
        pose: by frame, its middle [2] and its turn in radians.
        follow: whether there are tracks on it.
    """

    holds: Callable[[np.ndarray], np.ndarray]
    pose: Callable[[int], tuple[np.ndarray, float]]
    follow: bool = True

    def matrix(self, t: int) -> tuple[np.ndarray, np.ndarray]:
        middle, turn = self.pose(t)
        return np.asarray(middle, float), np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])

    def covers(self, t: int, pixels: np.ndarray) -> np.ndarray:
        middle, turn = self.matrix(t)
        return self.holds((pixels - middle) @ turn)


def disc(radius: float, pose: Callable[[int], tuple[np.ndarray, float]], follow: bool = True) -> Body:
    return Body(lambda p: np.linalg.norm(p, axis=-1) <= radius, pose, follow)


def along(start: tuple[float, float], step: tuple[float, float], turn: float = 0.0) -> Callable[[int], tuple[np.ndarray, float]]:
    return lambda t: (np.array(start) + t * np.array(step), turn * t)


@dataclass(frozen=True)
class Clip:
    """What is known of bodies: true numbers [T, H, W] (0 where none, or where the mask has a hole), and tracks."""

    true: np.ndarray
    points: np.ndarray
    visible: np.ndarray
    body: np.ndarray
    flow: np.ndarray

    def numbered(self, masks: list[np.ndarray] | None = None) -> np.ndarray:
        """The masks after numbers were found, [T, H, W]; the area must not change."""
        before = [(m > 0).astype(np.uint8) for m in self.true] if masks is None else masks
        clip = MaskedTracks(self.points, self.visible, before)
        result = np.zeros_like(self.true)

        def write(k: int, mask: np.ndarray) -> None:
            result[k] = mask

        highest = paint(clip, identify_tracks(clip), lambda k: self.flow[k], write)
        assert ((result > 0) == (np.stack(before) > 0)).all()
        assert highest == result.max()
        return result


def film(bodies: list[Body], holes: Callable[[int, np.ndarray], np.ndarray] | None = None, frames: int = FRAMES) -> Clip:
    """Render bodies; ``holes`` [H, W] says where the mask of a frame is missing."""
    pixels = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), -1)
    true, flow = np.zeros((frames, HEIGHT, WIDTH), np.uint8), np.zeros((frames, HEIGHT, WIDTH, 2), np.float32)
    for t in range(frames):
        for index, body in enumerate(bodies):
            inside = body.covers(t, pixels)
            (m0, r0), (m1, r1) = body.matrix(t), body.matrix(t + 1)
            true[t][inside] = index + 1
            flow[t][inside] = ((pixels[inside] - m0) @ r0) @ r1.T + m1 - pixels[inside]
    seen_as = true.copy()
    for t in range(frames):
        if holes is not None:
            true[t][holes(t, pixels)] = 0
    grid = np.stack(np.meshgrid(np.arange(-60, 61, 4.0), np.arange(-60, 61, 4.0)), -1).reshape(-1, 2)
    points, visible, owner = [], [], []
    rng = np.random.default_rng(0)
    for index, body in enumerate(bodies):
        for n, place in enumerate(grid[body.holds(grid)] if body.follow else []):
            path = np.stack([m + r @ place for m, r in (body.matrix(t) for t in range(frames))])
            column, row = np.clip(path.astype(int), 0, [WIDTH - 1, HEIGHT - 1]).T
            in_image = (path >= 0).all(1) & (path < [WIDTH, HEIGHT]).all(1)
            seen = in_image & (seen_as[np.arange(frames), row, column] == index + 1)
            for start in range(-(n % LIFE), frames, LIFE):
                lives = seen & (np.arange(frames) >= start) & (np.arange(frames) < start + LIFE + 2)
                if lives.any():
                    points.append(path + rng.normal(size=path.shape) * NOISE)
                    visible.append(lives)
                    owner.append(index + 1)
    return Clip(
        true, np.array(points, np.float32).reshape(-1, frames, 2), np.array(visible, bool).reshape(-1, frames),
        np.array(owner, int), flow,
    )  # fmt: skip


def shares(true: np.ndarray, found: np.ndarray) -> dict[int, tuple[int, float]]:
    """By true number: the found number that most of its pixels have, and their share."""
    result = {}
    for number in np.unique(true[true > 0]):
        counts = np.bincount(found[true == number])
        result[int(number)] = int(counts.argmax()), float(counts.max() / counts.sum())
    return result


CROSSING = [disc(16, along((30, 56), (4.5, 0.3), 0.05)), disc(14, along((130, 66), (-4.3, 0)))]


def test_objects_that_cross_keep_their_numbers():
    clip = film(CROSSING)
    found = shares(clip.true, clip.numbered())
    assert found[1][0] != found[2][0]
    assert min(share for _, share in found.values()) > 0.98
    assert np.unique(clip.numbered()).tolist() == [0, 1, 2]


def test_objects_that_touch_for_a_while_are_two():
    # They go side by side, in one part of the mask, one of them rolling, and then part.
    def parts(t: int) -> tuple[np.ndarray, float]:
        return np.array([60.0 + 2 * t + 4 * max(0, t - 5), 60.0]), 0.1 * t

    clip = film([disc(14, along((30, 60), (2, 0))), disc(14, parts)], frames=16)
    found = shares(clip.true, clip.numbered())
    assert found[1][0] != found[2][0]
    assert min(share for _, share in found.values()) > 0.95


def test_limbs_belong_to_the_body():
    torso = Body(lambda p: (np.abs(p) <= [8, 20]).all(-1), along((40, 50), (3, 0)))

    def leg(phase: float) -> Body:
        def pose(t: int) -> tuple[np.ndarray, float]:
            turn = 0.6 * np.sin(t / 2 + phase)
            return np.array([40 + 3 * t, 68]) + 16 * np.array([-np.sin(turn), np.cos(turn)]), turn

        return Body(lambda p: (np.abs(p) <= [4, 17]).all(-1), pose)

    clip = film([leg(0), leg(np.pi), torso])
    assert np.unique(clip.numbered()).tolist() == [0, 1]


@pytest.mark.parametrize("spans", [[(8, 12), (17, 19)], [(4, 20)]])
def test_a_mask_that_breaks_is_one_object(spans: list[tuple[int, int]]):
    """A strip of the mask is missing, now and then or for long."""
    pose = along((50, 60), (2.5, 0.5), 0.02)

    def holes(t: int, pixels: np.ndarray) -> np.ndarray:
        broken = any(first <= t < last for first, last in spans)
        return (np.abs(pixels[..., 0] - pose(t)[0][0]) < 4) & broken

    found = film([disc(22, pose)], holes).numbered()
    assert np.unique(found).tolist() == [0, 1]


def test_what_moves_farther_than_its_size_is_another_object():
    # Close to each other all the time, but one goes up and down.
    bodies = [disc(12, along((50, 60), (2, 0))), disc(12, lambda t: (np.array([82.0 + 2 * t, 60 + 30 * np.sin(t / 3)]), 0.0))]
    clip = film(bodies)
    found = shares(clip.true, clip.numbered())
    assert found[1][0] != found[2][0]
    assert min(share for _, share in found.values()) > 0.95


def test_the_number_of_threads_changes_nothing():
    clip = film(CROSSING)
    masks = [(m > 0).astype(np.uint8) for m in clip.true]
    owners = identify_tracks(MaskedTracks(clip.points, clip.visible, masks))
    threads = thread_count()
    try:
        set_thread_count(1)
        assert (identify_tracks(MaskedTracks(clip.points, clip.visible, masks)) == owners).all()
    finally:
        set_thread_count(threads)


def test_what_has_no_tracks_goes_to_its_neighbor_or_stays():
    main = along((50, 60), (2, 0))
    near = disc(3, lambda t: (main(t)[0] + [0, -26], 0.0), follow=False)
    far = disc(6, along((140, 20), (-1, 0)), follow=False)
    clip = film([disc(20, main), near, far])
    found = shares(clip.true, clip.numbered([np.array([0, 1, 2, 3], np.uint8)[mask] for mask in clip.true]))
    assert found[1][0] == found[2][0] != found[3][0]
    assert found[1][1] == found[2][1] == found[3][1] == 1


def test_without_tracks_numbers_stay_apart():
    clip = film([disc(12, along((40, 30), (2, 0)), False), disc(12, along((40, 90), (2, 0)), False)])
    found = shares(clip.true, clip.numbered(list(clip.true)))
    assert found == {1: (1, 1.0), 2: (2, 1.0)}


def scene_of(folder: Path, clip: Clip, masks: np.ndarray, method: str, breaks: list[int]) -> Scene:
    frames = len(clip.true)
    scene = Scene.create(
        folder, name="discs", source="discs", width=WIDTH, height=HEIGHT, timestamps=np.arange(frames) / 24.0, holdout=None,
        source_fps=24.0,
    )  # fmt: skip
    K = np.array([[150.0, 0, WIDTH / 2], [0, 150.0, HEIGHT / 2], [0, 0, 1]])
    scene.write_cameras([Camera(np.eye(4), K, WIDTH, HEIGHT)] * frames)
    scene.finish_prior("cameras", method="tracks", breaks=breaks)
    for t in scene.train_frames:
        scene.write_frame(t, np.full((HEIGHT, WIDTH, 3), 128, np.uint8))
        scene.write_mask(t, masks[t])
    for i, j in pairwise(scene.train_frames):
        sure = np.ones((HEIGHT, WIDTH), np.float32)
        scene.write_flow(Flow(i, j, clip.flow[i], sure))
        scene.write_flow(Flow(j, i, -clip.flow[j], sure))
    scene.finish_prior("masks", method=method)
    scene.write_tracks(Tracks(clip.points, clip.visible, clip.visible.astype(np.float32), np.ones(len(clip.body), bool)))
    return scene


def stored(scene: Scene) -> np.ndarray:
    return np.stack([scene.mask(i) for i in scene.train_frames])


def test_either_side_of_a_cut_has_numbers_of_its_own(tmp_path: Path):
    # What is in one place before and after the cut is not the same.
    cut = 12
    clip = film([disc(16, along((60, 60), (1, 0)))])
    before = clip.visible[:, :cut].any(1) & clip.visible[:, cut:].any(1)
    visible = clip.visible.copy()
    visible[before, cut:] = False
    scene = scene_of(tmp_path, Clip(clip.true, clip.points, visible, clip.body, clip.flow), clip.true, "motion", [cut])
    scene.finish_prior("masks", method="motion", objects=5, share=0.125, verdict="5 moving parts on 12.5% of the image")
    assert identify_objects(scene) == 2
    found = stored(scene)
    assert np.unique(found[:cut]).tolist() == [0, 1]
    assert np.unique(found[cut:]).tolist() == [0, 2]
    masks = scene.prior("masks")
    assert masks["objects"] == 2
    assert masks["verdict"] == "2 moving objects on 12.5% of the image", "parts that turned out to be one are one"


def test_numbers_that_came_with_masks_stay_and_one_for_all_is_split(tmp_path: Path):
    clip = film(CROSSING)
    swapped = np.where(clip.true > 0, 1 + (np.arange(FRAMES)[:, None, None] % 2), 0).astype(np.uint8)
    kept = scene_of(tmp_path / "kept", clip, swapped, "given", [])
    assert identify_objects(kept) == 2
    assert (stored(kept) == swapped).all()
    ours = scene_of(tmp_path / "ours", clip, swapped, "motion", [])
    one = scene_of(tmp_path / "one", clip, 7 * (clip.true > 0), "given", [])
    assert identify_objects(ours) == identify_objects(one) == 2
    for scene in (ours, one):
        found = shares(clip.true, stored(scene))
        assert found[1][0] != found[2][0]
        assert min(share for _, share in found.values()) > 0.98
    again = stored(ours)
    identify_objects(ours)
    assert (stored(ours) == again).all()


def test_nothing_masked_is_no_object(tmp_path: Path):
    clip = film(CROSSING)
    scene = scene_of(tmp_path, clip, np.zeros_like(clip.true), "motion", [])
    assert identify_objects(scene) == 0

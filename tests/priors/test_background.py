"""The static scene: exact matches give exact depth, neighbors help, what is hidden comes from other frames."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flowsplat.common.threads import in_threads
from flowsplat.geometry import Camera
from flowsplat.priors.background.fill import fill, upsample
from flowsplat.priors.background.fuse import fuse
from flowsplat.priors.background.longflow import LongFlows
from flowsplat.priors.background.multiview import solve_multiview
from flowsplat.priors.background.reprojection import uncover
from flowsplat.priors.background.static_depth import Background
from flowsplat.priors.continuity import Continuity
from flowsplat.priors.flow import dis_estimator, flow_stage
from flowsplat.priors.given import consecutive_pairs
from flowsplat.scenes import Flow
from tests.geometry.still import camera_flow

from .planes import HEIGHT, WIDTH, write_planes

K = np.array([[60.0, 0, 24], [0, 60, 16], [0, 0, 1]])
SIZE = (48, 32)


def camera(x: float = 0, y: float = 0, z: float = 0, turn: float = 0) -> Camera:
    viewmat = np.eye(4)
    viewmat[:3, :3] = Rotation.from_euler("y", turn, degrees=True).as_matrix()
    viewmat[:3, 3] = -viewmat[:3, :3] @ [x, y, z]
    return Camera(viewmat, K, *SIZE)


def slanted() -> np.ndarray:
    rows, columns = np.mgrid[: SIZE[1], : SIZE[0]]
    return (3 + 0.02 * columns + 0.03 * rows).astype(np.float32)


def solve(others: list[Camera], depth: np.ndarray, **change: np.ndarray):
    flows = np.stack([camera_flow(depth, camera(), other) for other in others]).astype(np.float32)
    flows = flows + change.get("error", 0)
    return solve_multiview(camera(), others, flows, np.ones(flows.shape[:3], np.float32))


OTHERS = [camera(0.1), camera(-0.15, 0.05), camera(0.3, 0, 0.1, 2.0), camera(-0.4, 0, 0, -3.0)]


def test_exact_matches_give_exact_depth():
    solution = solve(OTHERS, slanted())
    np.testing.assert_allclose(1 / solution.inverse_depth, slanted(), rtol=2e-3)
    assert solution.motion.max() < 0.5


def test_information_is_the_squared_parallax():
    information = solve([camera(0.4), camera(-0.3)], slanted()).information
    np.testing.assert_allclose(information, (60 * 0.4 / slanted()) ** 2 + (60 * 0.3 / slanted()) ** 2, rtol=0.01)


def test_one_wrong_match_is_outvoted():
    error = np.zeros((4, *SIZE[::-1], 2), np.float32)
    error[3, 10:20, 10:20] = [9, 4]
    np.testing.assert_allclose(1 / solve(OTHERS, slanted(), error=error).inverse_depth, slanted(), rtol=0.02)


def test_what_moves_off_the_epipolar_line_stands_out():
    error = np.zeros((4, *SIZE[::-1], 2), np.float32)
    for index, steps in enumerate((1, -1, 2, -2)):
        error[index, 10:20, 10:20] = [0.3 * steps, 2 * steps]
    motion = solve(OTHERS, slanted(), error=error).motion
    assert np.median(motion[10:20, 10:20]) > 5
    assert np.median(motion[22:]) < 0.5


@pytest.mark.parametrize("others", [[camera(), camera()], [camera(turn=2), camera(turn=-3)]])
def test_without_travel_nothing_is_known(others):
    solution = solve(others, slanted())
    assert solution.information.max() < 1e-6


def test_untrusted_matches_are_not_used():
    flows = np.full((1, *SIZE[::-1], 2), 7, np.float32)
    solution = solve_multiview(camera(), [camera(0.1)], flows, np.full((1, *SIZE[::-1]), 0.4, np.float32))
    assert solution.information.max() == 0
    assert solution.motion.max() == 0


def test_neighbors_that_agree_are_averaged_and_those_that_do_not_vote_against():
    one = np.ones(SIZE[::-1], np.float32)
    inverse, weight, votes = fuse(one / 3, one, camera(), [(one / 3.05, 3 * one, camera(0.1)), (one / 3, one, camera(-0.1))])
    assert 3.02 < 1 / inverse[16, 24] < 3.04
    assert weight[16, 24] == pytest.approx(5, rel=0.02)
    assert votes[16, 24] == 2
    inverse, weight, votes = fuse(one / 3, one, camera(), [(one / 6, 100 * one, camera(0.3))])
    assert inverse[16, 24] == pytest.approx(1 / 3)
    assert weight[16, 24] == 1
    assert votes[16, 24] == -1


def test_filling_stops_at_an_edge_of_the_image():
    guide = np.zeros((32, 48, 3), np.uint8)
    guide[:, 24:] = 200
    values = np.where(np.arange(48) < 24, 1.0, 2.0) * np.ones((32, 1))
    weights = np.zeros((32, 48), np.float32)
    weights[4:28, [2, 8, 14, 20, 28, 34, 40, 46]] = 100
    filled, support = fill(values.astype(np.float32), weights, guide)
    np.testing.assert_allclose(filled, values, atol=0.05)
    assert (support > 0).all()
    np.testing.assert_allclose(upsample(filled, np.kron(guide, np.ones((2, 2, 1), np.uint8)), 96, 64)[:, 60:], 2, atol=0.05)


def test_without_any_value_all_is_the_mean():
    filled, support = fill(np.full((16, 16), 3, np.float32), np.zeros((16, 16), np.float32), np.zeros((16, 16, 3), np.uint8))
    np.testing.assert_allclose(filled, 3)
    assert support.max() == 0


def test_hidden_pixels_come_from_other_frames():
    one = np.ones(SIZE[::-1], np.float32)
    hidden = np.zeros(SIZE[::-1], bool)
    hidden[10:20, 10:20] = True
    values, weights = uncover(hidden, one, np.where(hidden, 0, one), camera(), [(one / 3, 7 * one, camera(0.05))])
    np.testing.assert_allclose(values[11:19, 11:19], 1 / 3, rtol=1e-3)
    assert weights[15, 15] == 7
    assert values[25, 25] == 1


def test_what_shows_hardly_any_parallax_is_known_to_be_far():
    """A sky at the median's parallax of 100 pixels would show .5 of them if it were 200 times as far: its inverse depth is sure."""
    median, (width, height) = 1 / 2, SIZE
    inverse = np.full((height, width), median, np.float32)
    inverse[:10] = median / 200
    information = ((100 * inverse / median) ** 2).astype(np.float32)

    class Clip:
        cameras, continuity = [camera()], SimpleNamespace(same_piece=lambda k, j: True)

        def __len__(self):
            return 1

        def mask(self, k):
            return np.zeros((height, width), np.uint8)

        def image(self, k):
            return np.zeros((height, width, 3), np.uint8)

        def __getitem__(self, k):
            return SimpleNamespace(inverse_depth=inverse, information=information, motion=np.zeros_like(inverse))

    Clip.width, Clip.height, Clip.median = width, height, median
    known, weight, _ = Background(Clip(), has_masks=True).sure(0)
    assert (weight[:6] > 0).all()
    np.testing.assert_allclose(known[:6], 0.01 * median, rtol=1e-3)
    np.testing.assert_allclose(known[14:], median, rtol=1e-3)


def test_what_one_moment_alone_saw_stays_behind_the_object():
    """A near box at the left is seen in the first frames; later, and out of reach of the plate, the object is before it."""
    count, (width, height), hidden = 60, SIZE, np.s_[8:24, 6:20]
    box, wall = 1 / 3, 1 / 6

    class Clip:
        median, cameras = wall, [camera(0.001 * k) for k in range(count)]
        continuity = SimpleNamespace(same_piece=lambda k, j: True)

        def __len__(self):
            return count

        def mask(self, k):
            mask = np.zeros((height, width), np.uint8)
            mask[hidden] = k >= 10
            return mask

        def image(self, k):
            return np.zeros((height, width, 3), np.uint8)

        def __getitem__(self, k):
            inverse = np.full((height, width), wall, np.float32)
            inverse[hidden] = box
            return SimpleNamespace(inverse_depth=inverse, information=np.full_like(inverse, 100), motion=np.zeros_like(inverse))

    Clip.width, Clip.height = width, height
    background, inside = Background(Clip(), has_masks=True), np.s_[14:18, 11:15]
    assert background.plate(50)[inside].max() < 1.1 * wall
    np.testing.assert_allclose(background.compute_foremost(50)[inside], box, rtol=0.01)
    np.testing.assert_allclose(background.compute_foremost(50)[:, 30:], wall, rtol=0.01)


def test_long_flows_reach_far(tmp_path: Path):
    scene = write_planes(tmp_path, step=2, square=False)
    flow_stage(scene)
    flows = LongFlows(scene, Continuity(scene))
    assert flows.neighbors(1) == [0, 2, 3, 5, 9]
    flow, confidence = flows.matches(1, 9)
    inside = (slice(5, -5), slice(20, -5))
    assert np.median(np.abs(flow[inside] - [-8, 0])) < 0.1
    assert np.median(confidence[inside]) > 0.8
    flows.forget(12)
    np.testing.assert_array_equal(flows.matches(1, 9)[0], flow)


def test_threads_that_ask_together_find_the_same_long_flows(tmp_path: Path):
    """And none is computed twice."""
    scene = write_planes(tmp_path, step=2, square=True)
    flow_stage(scene)
    asked: list[tuple[int, int]] = []

    def estimate(a, b, guess=None):
        asked.append((int(a.sum()), int(b.sum())))
        return dis_estimator(a, b, guess)

    together, alone = LongFlows(scene, Continuity(scene), estimate), LongFlows(scene, Continuity(scene))
    others = [4 + step for stride in (1, 2, 4) for step in (-stride, stride)]
    for found, j in zip(in_threads(lambda j: together.matches(4, j), others, 3), others, strict=True):
        for mine, theirs in zip(found, alone.matches(4, j), strict=True):
            np.testing.assert_array_equal(mine, theirs)
    assert len(set(asked)) == len(asked)


def test_long_flows_are_those_of_the_chosen_method(tmp_path: Path):
    scene = write_planes(tmp_path, step=2, square=False)
    flow_stage(scene)
    guesses = []

    def estimate(a: np.ndarray, b: np.ndarray, guess: np.ndarray | None = None) -> np.ndarray:
        assert a.shape == b.shape == (HEIGHT, WIDTH, 3)
        guesses.append(guess)
        return np.full((HEIGHT, WIDTH, 2), 6, np.float32)

    flows = LongFlows(scene, Continuity(scene), estimate)
    np.testing.assert_allclose(flows.matches(1, 3)[0], 3)
    assert [guess.shape for guess in guesses] == [(HEIGHT, WIDTH, 2)] * 2  # there and back, from neighbors' flow
    assert np.median(np.abs(guesses[0] - [-4, 0])) < 0.1
    assert np.median(np.abs(flows.matches(3, 4)[0] - [-1, 0])) < 0.1


def test_given_flow_that_knows_nothing_is_no_match(tmp_path: Path):
    """Nothing both ways looks like a perfect round trip."""
    scene = write_planes(tmp_path, step=2, square=False)
    for i, j in consecutive_pairs(scene):
        confidence = np.ones((HEIGHT, WIDTH), np.float32)
        confidence[:, : WIDTH // 2] = 0
        scene.write_flow(Flow(i, j, np.zeros((HEIGHT, WIDTH, 2), np.float32), confidence))
    scene.finish_prior("flow", method="given")
    _, confidence = LongFlows(scene, Continuity(scene)).matches(3, 4)
    middle = confidence.shape[1] // 2
    assert confidence[:, : middle - 2].max() == 0
    assert confidence[:, middle + 2 :].min() > 0.9

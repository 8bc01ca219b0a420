from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from flowsplat.geometry.cameras import pixel_grid
from flowsplat.priors.flow import compose, dis_flow, flow_stage, forward_backward_confidence
from flowsplat.scenes import Scene


def texture(height: int, width: int, seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).uniform(0, 255, (height, width)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def test_composition_adds_constant_flows_and_follows_the_first_one():
    ab = np.full((20, 30, 2), (3.0, 1.0), np.float32)
    bc = pixel_grid(30, 20) * 0.1
    expected = ab + 0.1 * (pixel_grid(30, 20) + ab)
    inside = np.s_[:-2, :-4]
    np.testing.assert_allclose(compose(ab, bc)[inside], expected[inside], atol=0.01)


def test_confidence_crosses_one_half_at_the_limit_and_is_zero_outside():
    forward = np.full((10, 20, 2), (10.0, 0.0), np.float32)
    limit = 0.5 + 0.05 * 10
    for error, trusted in ((0.0, True), (0.98 * limit, True), (1.02 * limit, False)):
        backward = -forward + np.array([0, error], np.float32)
        confidence = forward_backward_confidence(forward, backward)
        assert (confidence[:, :10] >= 0.5).all() == trusted
        assert (confidence[:, 10:] == 0).all()


@pytest.mark.parametrize("shift", [(2, 1), (-3, 2)])
def test_flow_finds_a_shift(shift):
    big = texture(140, 200)
    a, b = big[20:120, 20:180], big[20 - shift[1] : 120 - shift[1], 20 - shift[0] : 180 - shift[0]]
    error = np.linalg.norm(dis_flow(a, b) - np.array(shift), axis=-1)
    assert np.median(error) < 0.1


@pytest.mark.parametrize("size", [(1, 1), (3, 5), (2, 200), (12, 16), (48, 64)])
def test_tiny_images_have_finite_flow(size):
    a, b = texture(*size), texture(*size, seed=1)
    flow = dis_flow(a, b)
    assert flow.shape == (*size, 2)
    assert np.isfinite(flow).all()
    assert np.isfinite(dis_flow(a, b, initial=flow)).all()
    assert np.isfinite(dis_flow(a, b, fine=True)).all()


def test_the_stage_joins_training_frames_across_held_out_ones_and_resumes(tmp_path):
    big = texture(80, 120)
    scene = Scene.create(tmp_path / "scene", name="s", source="", width=64, height=48, timestamps=range(6), holdout=3, source_fps=1)
    for i in range(6):
        scene.write_frame(i, np.repeat(big[10:58, 10 + i : 74 + i, None], 3, 2))
    flow_stage(scene)
    assert scene.train_frames == [0, 1, 3, 4, 5]
    assert set(scene.flow_pairs) == {(0, 1), (1, 0), (1, 3), (3, 1), (3, 4), (4, 3), (4, 5), (5, 4)}
    assert np.median(scene.flow(1, 3).flow[..., 0]) == pytest.approx(-2, abs=0.1)
    assert scene.prior("flow")["trusted"] > 0.9
    assert "pixels match" in scene.prior("flow")["verdict"]
    first, lost = (scene.folder / "flow" / name for name in ("00000_00001.npz", "00004_00005.npz"))
    stamp, content = first.stat().st_mtime_ns, lost.read_bytes()
    lost.unlink()
    flow_stage(scene)
    assert first.stat().st_mtime_ns == stamp
    assert lost.read_bytes() == content


def test_measured_flow_of_a_real_pair():
    if "FLOWSPLAT_DATA" not in os.environ:
        pytest.skip("FLOWSPLAT_DATA is not set")
    folder = Path(os.environ["FLOWSPLAT_DATA"]) / "flow" / "rubberwhale"
    raw = np.fromfile(folder / "flow10.flo", np.float32)
    width, height = raw[1:3].view(np.int32)
    truth = raw[3:].reshape(height, width, 2)
    a, b = (cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE) for name in ("frame10.png", "frame11.png"))
    known = (np.abs(truth) < 1e9).all(-1)
    error = np.linalg.norm(dis_flow(a, b, fine=True) - truth, axis=-1)[known]
    assert error.mean() < 0.15
    assert error.mean() < np.linalg.norm(dis_flow(a, b) - truth, axis=-1)[known].mean()

import doctest

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

from flowsplat.evaluation import metrics, scores
from flowsplat.evaluation.metrics import MAX_PSNR, depth_abs_rel, end_point_error, mean_inside, psnr, ssim_map


def images(seed: int, height: int = 40, width: int = 56) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    smooth = np.linspace(0, 1, height)[:, None, None] * np.linspace(1, 0.3, width)[None, :, None]
    a = np.clip(smooth + rng.normal(0, 0.05, (height, width, 3)), 0, 1)
    return a, np.clip(a + rng.normal(0, 0.1, a.shape), 0, 1)


def tensor(image: np.ndarray) -> torch.Tensor:
    return torch.tensor(image.transpose(2, 0, 1)[None])


@pytest.mark.parametrize("module", [metrics, scores])
def test_the_examples_in_the_docstrings(module):
    results = doctest.testmod(module, extraglobs={"np": np})
    assert results.attempted >= 1
    assert results.failed == 0


@pytest.mark.parametrize("size", [(40, 56), (11, 11), (7, 30)])
def test_ssim_is_that_of_torchmetrics_up_to_the_border(size):
    a, b = images(0, *size)
    reference, full = structural_similarity_index_measure(tensor(a), tensor(b), data_range=1.0, return_full_image=True)
    assert ssim_map(a, b).mean() == pytest.approx(float(reference), abs=1e-6)
    np.testing.assert_allclose(ssim_map(a, b), full[0].numpy().transpose(1, 2, 0), atol=1e-6)


def test_psnr_is_that_of_torchmetrics():
    a, b = images(1)
    assert psnr(a, b) == pytest.approx(float(peak_signal_noise_ratio(tensor(a), tensor(b), data_range=1.0)), abs=1e-5)


def test_values_beyond_the_range_are_clipped_first():
    white = np.ones((10, 10, 3))
    assert psnr(white * 1.7, white) == MAX_PSNR
    assert ssim_map(-white, 0 * white).mean() == pytest.approx(1)


def test_a_mask_selects_the_pixels_whose_error_is_averaged():
    a, b = images(2)
    mask = np.zeros(a.shape[:2], bool)
    mask[5:20, 5:30] = True
    only_inside = a.copy()
    only_inside[mask] = b[mask]
    assert psnr(only_inside, a, ~mask) == MAX_PSNR
    assert psnr(only_inside, a, mask) == pytest.approx(psnr(b, a, mask))
    assert psnr(b, a, mask) == pytest.approx(psnr(b[5:20, 5:30], a[5:20, 5:30]))
    assert mean_inside(ssim_map(b, a), mask) == pytest.approx(ssim_map(a, b)[mask].mean())


def test_a_full_mask_changes_nothing():
    a, b = images(3)
    full = np.ones(a.shape[:2], bool)
    assert psnr(a, b, full) == pytest.approx(psnr(a, b))
    assert mean_inside(ssim_map(a, b), full) == pytest.approx(ssim_map(a, b).mean())


@pytest.mark.parametrize(("count", "measured"), [(0, False), (49, False), (50, True)])
def test_regions_below_fifty_pixels_are_not_measured(count, measured):
    a, b = images(4)
    mask = (np.arange(a[..., 0].size) < count).reshape(a.shape[:2])
    flow = np.zeros((*mask.shape, 2))
    values = [
        psnr(a, b, mask),
        mean_inside(ssim_map(a, b), mask),
        end_point_error(flow, flow + 1, mask),
        depth_abs_rel(a[..., 0] + 1, b[..., 0] + 1, mask),
    ]
    assert [value is not None for value in values] == [measured] * 4


def test_end_point_error_ignores_what_is_not_valid():
    truth = np.zeros((20, 20, 2))
    flow = truth + [0.6, 0.8]
    flow[:5] = np.nan
    valid = np.ones((20, 20), bool)
    valid[:5] = False
    flow[10, 10] = [100, 0]
    error = end_point_error(flow, truth, valid)
    assert error["median"] == pytest.approx(1)
    assert error["mean"] == pytest.approx((299 + 100) / 300)


def test_depth_is_not_aligned():
    truth = np.random.default_rng(5).uniform(1, 4, (20, 20))
    valid = np.ones_like(truth, bool)
    assert depth_abs_rel(2 * truth, truth, valid)["mean"] == pytest.approx(1)
    assert depth_abs_rel(0 * truth, truth, valid) == {"mean": 1.0, "median": 1.0}


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 1000), noise=st.floats(0, 0.3))
def test_metrics_are_symmetric_and_bounded(seed, noise):
    a, _ = images(seed, 12, 13)
    b = np.clip(a + np.random.default_rng(seed + 1).normal(0, noise, a.shape), 0, 1)
    assert psnr(a, b) == pytest.approx(psnr(b, a))
    np.testing.assert_allclose(ssim_map(a, b), ssim_map(b, a))
    assert 0 <= psnr(a, b) <= MAX_PSNR
    assert -1 <= ssim_map(a, b).mean() <= 1 + 1e-12

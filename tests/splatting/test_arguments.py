"""What ``rasterize`` and ``rasterization`` are given: taken as it is meant, or refused in a sentence that names the argument."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from flowsplat import rasterization, rasterize

SIZE = {"width": 24, "height": 16}


def gaussians(dtype: Any = np.float32) -> dict[str, Any]:
    rng = np.random.default_rng(0)
    values = {
        "means": rng.normal(size=(9, 3)) + [0, 0, 4], "quats": rng.normal(size=(9, 4)), "scales": rng.uniform(0.1, 0.4, (9, 3)),
        "opacities": rng.uniform(0.2, 0.9, 9), "features": rng.uniform(size=(9, 3)), "viewmat": np.eye(4),
        "K": np.array([[20, 0, 12], [0, 20, 8], [0, 0, 1.0]]),
    }  # fmt: skip
    return {name: value.astype(dtype) for name, value in values.items()}


def many(values: dict[str, Any]) -> dict[str, Any]:
    """As ``rasterization`` names them, for one camera."""
    values = {**values, "colors": values["features"], "viewmats": values["viewmat"][None], "Ks": values["K"][None]}
    return {name: value for name, value in values.items() if name not in ("features", "viewmat", "K")}


def tensors(values: dict[str, Any]) -> dict[str, Any]:
    return {name: torch.from_numpy(value) for name, value in values.items()}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_arrays_of_numpy_are_taken(dtype):
    expected = rasterize(**tensors(gaussians()), **SIZE)[0]
    image = rasterize(**gaussians(dtype), **SIZE)[0]
    assert image.dtype == torch.float32
    torch.testing.assert_close(image, expected, rtol=0, atol=1e-5)
    torch.testing.assert_close(rasterization(**many(gaussians(dtype)), **SIZE)[0][0], expected, rtol=0, atol=1e-5)


def test_arrays_beside_tensors_become_what_these_are():
    given = tensors(gaussians(np.float64))
    given["viewmat"], given["K"] = np.eye(4, dtype=np.float32), gaussians()["K"].astype(int)
    assert rasterize(**given, **SIZE)[0].dtype == torch.float64


def test_gradients_reach_tensors_beside_arrays():
    given = gaussians()
    given["means"] = torch.from_numpy(given["means"]).requires_grad_()
    rasterize(**given, **SIZE)[0].sum().backward()
    assert given["means"].grad.abs().sum() > 0


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"scales": torch.ones(9, 3, dtype=torch.float64)}, "scales is float64, means float32"),
        ({"opacities": torch.ones(9, dtype=torch.int64)}, "opacities must be of a float type, not int64"),
        ({"opacities": "all"}, "opacities must be a tensor or an array of numbers, not str"),
        ({"quats": [[1, 0], [0]]}, "quats must be a tensor or an array of numbers, not list"),
        ({"means": torch.full((9, 3), torch.nan)}, "means must be finite"),
        ({"width": 0}, "width must be a whole number of pixels"),
        ({"height": 16.5}, "height must be a whole number of pixels"),
        ({"eps2d": float("nan")}, "eps2d must be a number, not nan"),
        ({"near_plane": None}, "near_plane must be a number, not None"),
    ],
)
def test_what_is_wrong_is_named(change, said):
    with pytest.raises(ValueError, match=said):
        rasterize(**{**tensors(gaussians()), **SIZE, **change})
    with pytest.raises(ValueError, match=said):
        rasterization(**{**many(tensors(gaussians())), **SIZE, **change})

"""LPIPS from a file of AlexNet's weights, against torchmetrics', with weights drawn at random."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch

from flowsplat.common.errors import InputError
from flowsplat.evaluation.lpips_network import LAYERS, open_lpips


def draw_weights() -> dict[str, torch.Tensor]:
    """Of the size that keeps features neither small nor large."""
    g = torch.Generator().manual_seed(0)
    found = {}
    for name, shape, *_ in LAYERS:
        found[f"{name}.weight"] = torch.randn(shape, generator=g) * (2 / (shape[1] * shape[2] * shape[3])) ** 0.5
        found[f"{name}.bias"] = 0.1 * torch.randn(shape[0], generator=g)
    return found


@pytest.fixture
def path(tmp_path):
    torch.save(draw_weights(), tmp_path / "alexnet.pth")
    return tmp_path / "alexnet.pth"


def features(weights: dict[str, torch.Tensor]) -> torch.nn.Sequential:
    """AlexNet's, as torchvision has them."""
    layers: list[torch.nn.Module] = []
    for _, (out, before, size, _), stride, padding, pools in LAYERS:
        layers += [torch.nn.MaxPool2d(3, 2)] if pools else []
        layers += [torch.nn.Conv2d(before, out, size, stride, padding), torch.nn.ReLU()]
    network = torch.nn.Sequential(*layers)
    network.load_state_dict({name.removeprefix("features."): value for name, value in weights.items()})
    return network


def test_it_is_the_distance_of_torchmetrics(path, monkeypatch):
    lpips = pytest.importorskip("torchmetrics.functional.image.lpips")
    monkeypatch.setattr(lpips, "_get_tv_model_features", lambda *_: features(draw_weights()))
    theirs = lpips._LPIPS(pretrained=True, net="alex", pnet_rand=True)
    rng = np.random.default_rng(1)
    a, b = rng.random((2, 70, 90, 3), dtype=np.float32)
    b = 0.7 * a + 0.3 * b
    expected = theirs(*(torch.from_numpy(image).permute(2, 0, 1)[None] for image in (a, b)), normalize=True)
    metric = open_lpips(path)
    assert metric(a, b) == pytest.approx(float(expected), rel=1e-4)
    assert float(expected) > 1e-3
    assert metric(a, a) == 0
    assert metric(a[:63], b[:63]) is None
    assert metric(2 * a, np.clip(2 * a, 0, 1)) == 0


@pytest.mark.parametrize("spoil", ["missing", "shape", "nan", "type", "bytes", "nowhere"])
def test_another_file_is_refused_in_one_line(spoil, path):
    weights = draw_weights()
    if spoil == "missing":
        del weights["features.8.bias"]
    elif spoil == "shape":
        weights["features.3.weight"] = weights["features.3.weight"][:9]
    elif spoil == "nan":
        weights["features.0.bias"][3] = torch.nan
    elif spoil == "type":
        weights["features.0.bias"] = weights["features.0.bias"].double()
    torch.save(weights, path)
    if spoil == "bytes":
        path.write_bytes(b"none")
    elif spoil == "nowhere":
        path.unlink()
    with pytest.raises(InputError, match=re.escape(str(path))) as error:
        open_lpips(path)
    assert "\n" not in str(error.value)

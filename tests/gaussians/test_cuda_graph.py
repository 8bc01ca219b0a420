"""Frames in buffers of a fixed size, beside those of the ordinary way; captured in a graph where there is a GPU."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from flowsplat.common import devices
from flowsplat.gaussians import model
from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.render import render
from flowsplat.geometry import Similarity
from flowsplat.splatting.rules import EPS2D
from tests.gaussians.test_flow import camera
from tests.gaussians.test_gaussians import FROZEN, random_model

pytest.importorskip("triton", reason="Triton is not installed")
from flowsplat.gaussians.cuda_graph import FixedRenderer
from flowsplat.gaussians.culling import capacity
from tests.marks import slow

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
SIZE = 40, 24


@pytest.mark.parametrize(("with_flow", "eps2d"), [slow(False, EPS2D), (True, EPS2D), (False, 30.0)])
def test_frames_are_those_of_the_ordinary_way_whatever_came_before(with_flow, eps2d, monkeypatch):
    monkeypatch.setattr(capacity, "GRANULE", 8)
    gaussians = random_model(40, replace(FROZEN, freeze_background=True))
    gaussians.sh_degree = 1
    gaussians.params["means"][:, :2] *= 2
    renderer = FixedRenderer(gaussians.to(DEVICE), *SIZE, with_flow, eps2d)
    for t in (0.1, 0.5, 0.1):
        view = camera((0.1 * t, 0, 0), width=SIZE[0], height=SIZE[1])
        flow_to = (camera((0.05, 0.02, 0), width=SIZE[0], height=SIZE[1]), t + 0.1) if with_flow else None
        image, alpha = renderer.render(view, t, flow_to)
        expected = render(gaussians, view, t, flow_to=flow_to, eps2d=eps2d)
        assert float(expected.alpha.max()) > 0.3
        assert image.shape[2] == (7 if with_flow else 4)
        np.testing.assert_allclose(alpha.cpu(), expected.alpha, atol=2e-5)
        np.testing.assert_allclose(image[..., : expected.image.shape[2]].cpu(), expected.image, atol=2e-4)
    assert renderer.captures >= 2  # 20 rest, and there were 8 rows


def test_a_scene_that_is_looked_at_is_drawn_so(monkeypatch):
    gaussians = random_model().to(DEVICE)
    plain = SceneModel(gaussians, Similarity(), 0.0, 2.0)
    fast = replace(plain, graphs=True)
    monkeypatch.setattr(devices, "kernels_for", lambda value: "triton")
    monkeypatch.setattr(model, "_MAX_GRAPHS", 1)
    for width in (16, 17):
        view, other = camera(width=width, height=16), camera((0.05, 0.02, 0), width=width, height=16)
        ours = fast.render(view, 0.5, (other, 0.7))
        assert list(fast._drawn_by) == [(width, 16, True, EPS2D)]
    monkeypatch.undo()
    expected = plain.render(view, 0.5, (other, 0.7))
    for name in ("color", "alpha", "depth", "flow"):
        np.testing.assert_allclose(getattr(ours, name), getattr(expected, name), atol=1e-3, err_msg=name)
    assert not fast.part("objects")._drawn_by


def test_it_draws_what_it_was_made_for():
    renderer = FixedRenderer(random_model().to(DEVICE), *SIZE, False)
    with pytest.raises(ValueError, match="without flow"):
        renderer.render(camera(width=SIZE[0], height=SIZE[1]), 0.5, (camera(), 0.6))
    with pytest.raises(ValueError, match="images of"):
        renderer.render(camera(), 0.5)

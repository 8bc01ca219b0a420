"""What images say about single Gaussians: the kernel against its oracle, and against a scene that is off by what is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from flowsplat.gaussians.density import DensityStatistics
from flowsplat.gaussians.render import render_active
from flowsplat.training.dynamic_evidence import add_residuals, cpu, reference
from flowsplat.training.photometric_loss import PhotometricTargets
from tests.training.handful import HEIGHT, WIDTH, a_few, seen, tiny


def rendered_frame(flow_model, count=200):
    """Opaque Gaussians rendered with flow, who was drawn, and what the image should show: with trust in most of it."""
    gaussians = a_few(tiny("default"), count)
    gaussians.params["logit_opacities"] += 4
    gaussians.params["log_scales"] += 0.7
    observations = seen(gaussians)
    frame, following = observations[0], observations[1]
    active = gaussians.active(frame.time, frame.camera)
    rendered = render_active(
        gaussians, active, frame.camera, flow_to=(following.camera, following.time), flow_model=flow_model, gradients={}
    )
    trusted = np.random.default_rng(1).random((HEIGHT, WIDTH)) < 0.8
    return gaussians, active, rendered, PhotometricTargets(frame.image, flow=frame.forward.flow, flow_trusted=trusted)


@pytest.mark.parametrize("flow_model", ["mean", "displacement", "affine"])
def test_residuals_match_their_oracle(flow_model):
    gaussians, active, rendered, targets = rendered_frame(flow_model)
    found = []
    for module in (reference, cpu):
        statistics = DensityStatistics.zeros(len(gaussians))
        for drawn in (rendered.projected.visible, torch.arange(len(active.rows)) % 2 == 0):
            module.add_residuals(statistics, active, drawn, rendered, targets)
        found.append(statistics)
    assert (found[0].flow_visits == 2).any()
    assert (found[0].flow_visits == 1).any()
    assert (found[0].flow_visits == 0).any()
    for name, expected in vars(found[0]).items():
        torch.testing.assert_close(getattr(found[1], name), expected, rtol=1e-4, atol=1e-5)


def test_residuals_are_what_the_image_is_off():
    gaussians, active, rendered, _ = rendered_frame("displacement")
    alpha = rendered.alpha.detach()
    color = (255 * rendered.color.detach()).round().clamp(0, 205).to(torch.uint8).numpy()
    flow = (rendered.flow.detach() / alpha[..., None]).numpy() + np.float32([3, -4])
    targets = PhotometricTargets(color, flow=flow, flow_trusted=np.ones((HEIGHT, WIDTH), bool))
    rendered = replace(rendered, image=torch.cat([torch.from_numpy(color) / 255 + 0.2, rendered.image[..., 3:]], -1))
    statistics = DensityStatistics.zeros(len(gaussians))
    add_residuals(statistics, active, rendered.projected.visible, rendered, targets)
    visits = statistics.flow_visits
    assert visits.any()
    torch.testing.assert_close(statistics.flow_residual, 5 * visits, rtol=1e-4, atol=0)
    torch.testing.assert_close(statistics.color_residual, 0.2 * visits, rtol=1e-4, atol=0)

"""A 4D scene in memory of which half is active at a time, and the clip that it would be trained on."""

from __future__ import annotations

import numpy as np
import torch

from flowsplat.gaussians.gaussians4d import Gaussians4D, parameter_shapes
from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.gaussians.observations import Observation, Observations
from flowsplat.gaussians.render import render
from flowsplat.geometry import Camera, Similarity
from flowsplat.scenes import Flow
from flowsplat.splatting.harmonics import harmonics_from_colors
from flowsplat_benchmarks.scripts.cpu_parts.work_load import WorkLoad, work_load

FRAMES = 6
"""Frames that the scene is made for."""
BACKGROUND_SHARE = 0.4
"""Share of the Gaussians that is background, always active. The others are objects, each active around one of the frames: with
six frames 0.4 + 0.6 / 6 = one half is active in every frame."""
PRESENCE_REACH = 0.1
"""How long before and after its center time an object is active: half the distance of two frames."""


def gaussians(config: ModelConfig, count: int, width: int, height: int) -> Gaussians4D:
    """``count`` Gaussians; those that are active in a frame look like ``work_load`` of half as many, at median depth 1."""
    resting, moving = round(count * BACKGROUND_SHARE), round(count * (1 - BACKGROUND_SHARE) / FRAMES)
    loads = [work_load(resting + moving, width, height, seed=seed) for seed in range(FRAMES)]
    shuffled = [np.random.default_rng(seed).permutation(resting + moving) for seed in range(FRAMES)]
    chosen = [(loads[0], shuffled[0][:resting])]
    chosen += [(load, rows[-moving:]) for load, rows in zip(loads, shuffled, strict=True)]
    times = np.repeat([0.5, *np.arange(FRAMES) / (FRAMES - 1)], [resting] + [moving] * FRAMES)
    dynamic = torch.arange(len(times)) >= resting

    def gathered(field: str) -> torch.Tensor:
        return torch.from_numpy(np.concatenate([getattr(load, field)[rows] for load, rows in chosen]))

    unit = float(np.median(loads[0].means[:, 2]))
    log_lambda = float(np.log(-2 * np.log(config.p_min) / PRESENCE_REACH**2))
    opacities = gathered("opacities")
    params = {name: torch.zeros(len(times), *shape) for name, shape in parameter_shapes(config).items()}
    params["means"], params["log_scales"] = gathered("means") / unit, torch.log(gathered("scales") / unit)
    params["quats"], params["logit_opacities"] = gathered("quats"), torch.log(opacities / (1 - opacities))
    params["sh"][:, 0] = harmonics_from_colors(gathered("colors"))
    params["times"] = torch.from_numpy(times.astype(np.float32))
    params["log_lambdas"] = torch.where(dynamic, log_lambda, float(np.log(1e-6)))
    # Two pixels to the right and one down from frame to frame.
    pixel = 1 / loads[0].camera.K[0, 0]
    params["mean_poly"][dynamic, 0] = torch.tensor([2 * pixel, pixel, 0.0], dtype=torch.float32) * (FRAMES - 1)
    return Gaussians4D(params, dynamic, config, config.sh_degree)


def cameras(load: WorkLoad) -> list[Camera]:
    """Return a camera that moves to the side by a pixel from frame to frame."""
    result = []
    for k in range(FRAMES):
        viewmat = np.eye(4)
        viewmat[0, 3] = -k / load.camera.K[0, 0]
        result.append(Camera(viewmat, load.camera.K, load.camera.width, load.camera.height))
    return result


def observations(scene: Gaussians4D, width: int, height: int) -> Observations:
    """Return what cameras see of it: noisy images, depth, and flow to the next frame."""
    rng = np.random.default_rng(0)
    path = cameras(work_load(1, width, height))
    frames = []
    for k, camera in enumerate(path):
        following = (path[k + 1], (k + 1) / (FRAMES - 1)) if k + 1 < FRAMES else None
        seen = render(scene, camera, k / (FRAMES - 1), flow_to=following)
        alpha = seen.alpha.numpy()
        covered, divisor = alpha > 0.5, np.maximum(alpha, 1e-6)
        noisy = seen.color.numpy() + rng.normal(0, 0.05, (height, width, 3))
        flow = None
        if seen.flow is not None:
            flow = Flow(k, k + 1, seen.flow.numpy() / divisor[..., None], covered.astype(np.float32))
        frames.append(
            Observation(
                frame=k,
                time=k / (FRAMES - 1),
                camera=camera,
                image=(np.clip(noisy, 0, 1) * 255).astype(np.uint8),
                depth=np.where(covered, seen.depth.numpy() / divisor, 1).astype(np.float32),
                depth_trusted=covered,
                object_ids=np.zeros((height, width), np.uint8),
                forward=flow,
                backward=None,
            )
        )
    return Observations(frames, Similarity())

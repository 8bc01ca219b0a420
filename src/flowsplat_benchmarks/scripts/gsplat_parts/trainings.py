"""gsplat's strategies, unchanged, fit Gaussians to an image: with the kernels and with the reference."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from flowsplat.splatting import rasterization
from flowsplat_benchmarks.scripts.gsplat_parts.reference import Rasterize

WIDTH, HEIGHT = 96, 64
"""Pixels of the image."""
STEPS, START = 300, 300
"""Of a training: steps, and Gaussians at its beginning."""
SEEDS = (0, 1, 2)
"""Of the Gaussians at its beginning. Rounding alone makes a training another one: see how far apart seeds are."""
RATES = {"means": 2e-3, "scales": 1e-2, "quats": 1e-2, "opacities": 5e-2, "colors": 2.5e-2}
"""Learning rates."""
StrategyName = Literal["DefaultStrategy", "DefaultStrategy, absgrad", "MCMCStrategy"]
STRATEGIES: tuple[StrategyName, ...] = ("DefaultStrategy", "DefaultStrategy, absgrad", "MCMCStrategy")


@dataclass(frozen=True)
class Trained:
    """What came of a training: PSNR in dB, Gaussians at its end, seconds of the processor."""

    psnr: float
    count: int
    seconds: float


def draw_target() -> Tensor:
    """[H, W, 3]: rings that get finer outwards, a weave, wavy stripes."""
    y, x = torch.meshgrid((torch.arange(HEIGHT) + 0.5) / HEIGHT, (torch.arange(WIDTH) + 0.5) / HEIGHT, indexing="ij")
    u, v = 0.8 * x + 0.6 * y, 0.8 * y - 0.6 * x
    rings, weave = torch.sin(60 * ((x - 0.6) ** 2 + (y - 0.4) ** 2)), torch.sin(20 * u) * torch.sin(27 * v)
    return 0.5 + 0.4 * torch.stack([rings, weave, torch.sin(45 * v + 4 * torch.sin(7 * u))], -1)


def train(draw: Rasterize, strategy_name: StrategyName, steps: int = STEPS, seed: int = 0) -> Trained:
    """Fit the image with one of gsplat's strategies, which adds Gaussians in the second quarter and a bit of the third."""
    from gsplat.strategy import DefaultStrategy, MCMCStrategy

    torch.manual_seed(seed)
    absgrad, is_mcmc, target = "absgrad" in strategy_name, strategy_name == "MCMCStrategy", draw_target()
    viewmats, Ks = torch.eye(4)[None], torch.tensor([[[HEIGHT, 0, WIDTH / 2], [0, HEIGHT, HEIGHT / 2], [0, 0, 1.0]]])
    sheet = torch.tensor([2 * WIDTH / HEIGHT, 2, 0.4])
    params = torch.nn.ParameterDict(
        {
            "means": (torch.rand(START, 3) - 0.5) * sheet + torch.tensor([0, 0, 2.0]),
            "scales": torch.full((START, 3), (WIDTH / HEIGHT / START) ** 0.5).log(),
            "quats": torch.randn(START, 4),
            "opacities": torch.full((START,), 0.1).logit(),
            "colors": torch.rand(START, 3).logit(),
        }
    )
    optimizers = {name: torch.optim.Adam([params[name]], lr=rate, eps=1e-15) for name, rate in RATES.items()}
    when = {"refine_start_iter": steps // 4, "refine_stop_iter": 2 * steps // 3}
    strategy: Any = (
        MCMCStrategy(cap_max=2 * START, noise_lr=1e3, refine_every=steps // 30, **when)
        if is_mcmc
        else DefaultStrategy(absgrad=absgrad, grow_grad2d=5e-3 if absgrad else 1e-3, refine_every=steps // 10, **when)
    )
    strategy.check_sanity(params, optimizers)
    state, options = strategy.initialize_state(), {"packed": False} if draw is rasterization else {}
    began = time.process_time()
    for step in range(steps):
        images, _, info = draw(
            params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid(), params["colors"].sigmoid(),
            viewmats, Ks, WIDTH, HEIGHT, absgrad=absgrad, **options,
        )  # fmt: skip
        if not is_mcmc:
            strategy.step_pre_backward(params, optimizers, state, step, info)
        ((images[0] - target).abs().mean() + 0.01 * params["opacities"].sigmoid().mean()).backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        if is_mcmc:
            strategy.step_post_backward(params, optimizers, state, step, info, lr=RATES["means"])
        else:
            strategy.step_post_backward(params, optimizers, state, step, info, packed=False)
    error = float(((images[0].detach() - target) ** 2).mean().log10())
    return Trained(-10 * error, len(params["means"]), time.process_time() - began)

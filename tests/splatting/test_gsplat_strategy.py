"""``rasterization`` under gsplat's own strategies, as its users train: they are unchanged, with our operators in MCMC's place."""

from __future__ import annotations

import itertools
import re

import pytest
import torch

from flowsplat import gsplat_ops
from flowsplat.splatting import rasterization
from tests.splatting.test_gsplat_api import HEIGHT, WIDTH, functional, leaves_of, make


@pytest.fixture(scope="module")
def gsplat():
    return pytest.importorskip("gsplat")


def textured(width: int, height: int) -> torch.Tensor:
    """[H, W, 3]: rings that get finer outwards, a weave, wavy stripes."""
    y, x = torch.meshgrid((torch.arange(height) + 0.5) / height, (torch.arange(width) + 0.5) / height, indexing="ij")
    u, v = 0.8 * x + 0.6 * y, 0.8 * y - 0.6 * x
    rings = torch.sin(120 * ((x - 0.6) ** 2 + (y - 0.4) ** 2))
    stripes = torch.sin(90 * v + 4 * torch.sin(7 * u))
    return 0.5 + 0.4 * torch.stack([rings, torch.sign(torch.sin(40 * u) * torch.sin(55 * v)), stripes], -1)


def fit(
    width, height, count, steps, *, refine=True, cameras=1, packed=True, absgrad=False, backend="auto", kind="default", **settings
):
    """Fit the image with a strategy of gsplat, as its users write it. Returns PSNR and the number of Gaussians over time."""
    from gsplat.strategy import DefaultStrategy, MCMCStrategy

    torch.manual_seed(0)
    target = textured(width, height)
    viewmats = torch.eye(4).repeat(cameras, 1, 1)
    Ks = torch.tensor([[height, 0, width / 2], [0, height, height / 2], [0, 0, 1.0]]).repeat(cameras, 1, 1)
    extent = torch.tensor([2 * width / height, 2, 0.4])
    params = torch.nn.ParameterDict(
        {
            "means": (torch.rand(count, 3) - 0.5) * extent + torch.tensor([0, 0, 2.0]),
            "scales": torch.full((count, 3), (width / height / count) ** 0.5).log(),
            "quats": torch.randn(count, 4),
            "opacities": torch.full((count,), 0.1).logit(),
            "colors": torch.rand(count, 3).logit(),
        }
    )
    rates = {"means": 2e-3, "scales": 1e-2, "quats": 1e-2, "opacities": 5e-2, "colors": 2.5e-2}
    optimizers = {name: torch.optim.Adam([params[name]], lr=rate, eps=1e-15) for name, rate in rates.items()}
    is_default = kind == "default"
    strategy = DefaultStrategy(absgrad=absgrad, verbose=True, **settings) if is_default else MCMCStrategy(verbose=True, **settings)
    strategy.check_sanity(params, optimizers)
    state, counts = strategy.initialize_state(), []
    for step in range(steps):
        images, _, info = rasterization(
            params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid(),
            params["colors"].sigmoid(), viewmats, Ks, width, height, packed=packed, absgrad=absgrad, backend=backend,
        )  # fmt: skip
        if refine and is_default:
            strategy.step_pre_backward(params, optimizers, state, step, info)
        error = images - target
        (error.abs().mean() + 0.01 * params["opacities"].sigmoid().mean()).backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        if refine:
            last = {"packed": packed} if is_default else {"lr": rates["means"]}
            strategy.step_post_backward(params, optimizers, state, step, info, **last)
        counts.append(len(params["means"]))
    return -10 * float((error.detach() ** 2).mean().log10()), counts


@pytest.fixture(scope="module")
def without_growth(gsplat):
    return fit(96, 64, 400, 200, cameras=2, refine=False)[0]


@pytest.mark.parametrize(("packed", "absgrad"), itertools.product([True, False], [True, False]))
def test_default_strategy_grows(gsplat, without_growth, packed, absgrad):
    settings = {"refine_start_iter": 80, "refine_every": 20, "grow_grad2d": 5e-3 if absgrad else 5e-4}
    psnr, counts = fit(96, 64, 400, 200, cameras=2, packed=packed, absgrad=absgrad, **settings)
    assert counts[99] == 400 < counts[100] < counts[-1] < 8000
    assert psnr > without_growth + 0.5


def test_default_strategy_counts_every_camera(gsplat):
    from gsplat.strategy import DefaultStrategy

    for packed in (True, False):
        leaves = leaves_of(make(cameras=3), torch.float32)
        params = {name: torch.nn.Parameter(leaf.detach()) for name, leaf in leaves.items() if name not in ("viewmats", "Ks")}
        images, alphas, info = rasterization(
            **params, viewmats=leaves["viewmats"], Ks=leaves["Ks"], width=WIDTH, height=HEIGHT, packed=packed
        )
        strategy = DefaultStrategy()
        state = strategy.initialize_state()
        strategy.step_pre_backward(params, {}, state, 0, info)
        functional(images, alphas).backward()
        strategy.step_post_backward(params, {}, state, 0, info, packed=packed)
        per_camera = [
            rasterization(**{**values, "viewmats": values["viewmats"][c : c + 1], "Ks": values["Ks"][c : c + 1]}, width=WIDTH,
                          height=HEIGHT, packed=False)[2]["radii"][0, :, 0] > 0
            for values in [leaves] for c in range(3)
        ]  # fmt: skip
        assert torch.equal(state["count"], torch.stack(per_camera).sum(0).float())
        assert bool((state["grad2d"] > 0).any())


def test_mcmc_strategy_adds_and_moves(gsplat, without_growth):
    gsplat_ops.install()
    settings = {"refine_start_iter": 80, "refine_every": 20, "cap_max": 500, "noise_lr": 1e3}
    psnr, counts = fit(96, 64, 400, 200, cameras=2, kind="mcmc", **settings)
    assert counts[99] == 400 < counts[100] < counts[-1] == 500
    assert psnr > without_growth


@pytest.mark.slow
def test_mcmc_strategy_ends_where_the_oracle_does(gsplat):
    gsplat_ops.install()
    settings = {"refine_start_iter": 100, "refine_every": 50, "cap_max": 500, "noise_lr": 1e3, "kind": "mcmc"}
    found, counts = fit(64, 64, 300, 400, **settings)
    expected, expected_counts = fit(64, 64, 300, 400, backend="reference", **settings)
    print(f"kernels {found:.2f} dB, oracle {expected:.2f} dB")
    assert counts[-1] == expected_counts[-1] > 350
    assert abs(found - expected) < 1


@pytest.mark.slow
def test_default_strategy_ends_where_the_oracle_does(gsplat):
    settings = {"refine_start_iter": 100, "refine_every": 50, "grow_grad2d": 1e-3}
    found, counts = fit(64, 64, 300, 400, **settings)
    expected, expected_counts = fit(64, 64, 300, 400, backend="reference", **settings)
    print(f"kernels {found:.2f} dB, {counts[-1]} Gaussians; oracle {expected:.2f} dB, {expected_counts[-1]} Gaussians")
    assert counts[-1] > 350
    assert abs(found - expected) < 0.5


@pytest.mark.slow
def test_default_strategy_grows_and_prunes_ten_thousand(gsplat, capsys):
    psnr, counts = fit(256, 192, 10_000, 2000, grow_grad2d=7e-4)
    pruned = sum(map(int, re.findall(r"(\d+) GSs pruned", capsys.readouterr().out)))
    alone, _ = fit(256, 192, 10_000, 2000, refine=False)
    print(f"{psnr:.2f} dB with {counts[-1]} Gaussians, {pruned} pruned on the way; {alone:.2f} dB with the 10000 alone")
    assert counts[-1] > 12_000
    assert pruned > 100
    assert psnr > alone + 1

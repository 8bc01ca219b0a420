"""What has broken rasterizers before, in any mixture: no harm is done, and the answer is the oracle's where that is sure of it."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from flowsplat.splatting import blend, project, rasterize
from flowsplat.splatting.cpu import functions

INPUTS = ("means", "quats", "scales", "opacities", "features")


def plain(g: torch.Generator) -> dict[str, torch.Tensor]:
    """One ordinary Gaussian."""
    mean = torch.randn(3, generator=g) * torch.tensor([0.8, 0.8, 0.5]) + torch.tensor([0.0, 0, 3])
    return {
        "means": mean,
        "quats": torch.randn(4, generator=g),
        "scales": torch.exp(0.5 * torch.randn(3, generator=g) - 2),
        "opacities": torch.rand(1, generator=g)[0],
        "features": torch.randn(3, generator=g),
    }


def _set(name: str, *value: float):
    def change(gaussian: dict[str, torch.Tensor]) -> None:
        gaussian[name] = torch.tensor(value if len(value) > 1 or name == "means" else value[0])

    return change


def _depth(z: float):
    def change(gaussian: dict[str, torch.Tensor]) -> None:
        gaussian["means"][2] = z

    return change


FINITE = {
    "plain": lambda gaussian: None,
    "behind": _depth(-1.0),
    "in the plane of the camera": _depth(1e-9),
    "straddling the near plane": _depth(0.0101),
    "just behind the near plane": _depth(0.0099),
    "opacity 0": _set("opacities", 0.0),
    "opacity 1": _set("opacities", 1.0),
    "barely visible": _set("opacities", 1 / 255 + 1e-5),
    "no rotation at all": _set("quats", 0.0, 0.0, 0.0, 0.0),
    "no size": _set("scales", 0.0, 0.0, 0.0),
    "tiny": _set("scales", 1e-7, 1e-7, 1e-7),
    "huge": _set("scales", 1e4, 1e4, 1e4),
    "needle": _set("scales", 1e-6, 1e-6, 30.0),
    "disc": _set("scales", 0.5, 0.5, 1e-7),
    "far away": _set("means", 1e6, 0.0, 3.0),
    "coincident": _set("means", 0.1, 0.1, 2.5),
}
BROKEN = {
    "NaN mean": _set("means", float("nan"), 0.0, 3.0),
    "infinite mean": _set("means", 0.0, float("inf"), 3.0),
    "infinite scale": _set("scales", float("inf"), 1.0, 1.0),
    "NaN quaternion": _set("quats", float("nan"), 1.0, 0.0, 0.0),
}


def scene(seed: int, kinds: list[str]) -> dict[str, torch.Tensor]:
    """Gaussians of these kinds, float32."""
    g = torch.Generator().manual_seed(seed)
    gaussians = []
    for kind in kinds:
        gaussians.append(plain(g))
        {**FINITE, **BROKEN}[kind](gaussians[-1])
    if not gaussians:
        return {name: value[None][:0] for name, value in plain(g).items()}
    return {name: torch.stack([gaussian[name] for gaussian in gaussians]) for name in INPUTS}


def camera(width: int, height: int) -> tuple[torch.Tensor, torch.Tensor]:
    K = torch.tensor([[40.0, 0, width / 2], [0, 42, height / 2], [0, 0, 1]])
    return torch.eye(4), K


def draw(values, size, weights, dtype=torch.float32):
    """Image and gradients; every pixel counts by its weight. By parts, so that broken values get through."""
    leaves = {name: value.to(dtype).requires_grad_() for name, value in values.items()}
    viewmat, K = (value.to(dtype) for value in camera(*size))
    projected = project(leaves["means"], leaves["quats"], leaves["scales"], leaves["opacities"], viewmat, K, *size)
    image, alphas = blend(projected, leaves["opacities"], leaves["features"], *size)
    g = torch.Generator().manual_seed(5)
    rendered = torch.cat([image, alphas[..., None]], -1)
    functional = torch.randn(rendered.shape, generator=g, dtype=torch.float64).to(dtype) * weights.to(dtype)[..., None]
    gradients = torch.autograd.grad((rendered * functional).sum(), list(leaves.values()), allow_unused=True)
    zeros = [torch.zeros_like(leaf) for leaf in leaves.values()]
    return rendered.detach(), [zero if g is None else g for g, zero in zip(gradients, zeros, strict=True)], projected


@given(
    st.integers(0, 2**31), st.lists(st.sampled_from(sorted({**FINITE, **BROKEN})), max_size=24),
    st.sampled_from([(1, 1), (8, 64), (9, 65), (31, 17), (1, 40), (70, 1)]),
)  # fmt: skip
@settings(max_examples=60, deadline=None)
def test_nothing_does_harm(seed, kinds, size):
    values, weights = scene(seed, kinds), torch.ones(size[1], size[0])
    rendered, gradients, projected = draw(values, size, weights)
    again, gradients_again, _ = draw(values, size, weights)
    assert rendered.shape == (size[1], size[0], 4)
    assert torch.isfinite(rendered).all()
    assert torch.equal(rendered, again)
    assert float(rendered[..., 3].min()) >= 0
    assert float(rendered[..., 3].max()) <= 1
    for name, gradient, repeated in zip(INPUTS, gradients, gradients_again, strict=True):
        assert torch.isfinite(gradient).all(), name
        assert torch.equal(gradient, repeated), name
        assert not gradient[~projected.visible].any(), f"{name} of culled Gaussians"


def at_a_cut(values, size) -> torch.Tensor:
    """[H, W] where a change in the seventh digit makes a jump: an alpha at 1/255, a pixel about to stop, two depths alike."""
    ones = torch.ones(size[1], size[0])
    exact = draw(values, size, ones, torch.float64)[0]
    jumps = torch.zeros(size[1], size[0], dtype=torch.bool)
    for seed in range(6):
        g = torch.Generator().manual_seed(seed)
        moved = {
            name: value.double() * (1 + 2e-6 * torch.randn(value.shape, generator=g, dtype=torch.float64))
            for name, value in values.items()
        }
        jumps |= (draw(moved, size, ones, torch.float64)[0] - exact).abs().amax(-1) > 5e-5
    return jumps


def sensitivity(values, size, weights, exact):
    """How far the float64 gradients get from the ``exact`` ones by a change in the seventh digit: of six changes, the most."""
    farthest = [0.0] * len(exact)
    for seed in range(77, 83):
        g = torch.Generator().manual_seed(seed)
        moved = {
            name: value.double() * (1 + 1e-7 * torch.randn(value.shape, generator=g, dtype=torch.float64))
            for name, value in values.items()
        }
        gradients = draw(moved, size, weights, torch.float64)[1]
        farthest = [max(most, float((a - b).norm())) for most, a, b in zip(farthest, gradients, exact, strict=True)]
    return farthest


@given(st.integers(0, 2**31), st.lists(st.sampled_from(sorted(FINITE)), min_size=1, max_size=20))
@settings(max_examples=40, deadline=None)
def test_gradients_agree_wherever_the_answer_is_well_conditioned(seed, kinds):
    size = (31, 17)
    values = scene(seed, kinds)
    keep = ~at_a_cut(values, size)
    rendered, expected, _ = draw(values, size, keep, torch.float64)
    found_image, found, _ = draw(values, size, keep)
    assert float(((found_image.double() - rendered) * keep[..., None]).abs().max()) < 1e-3
    for name, exact, change, ours in zip(INPUTS, expected, sensitivity(values, size, keep, expected), found, strict=True):
        norm = float(exact.norm())
        if norm > 0 and change < 1e-5 * norm:
            assert float((ours.double() - exact).norm()) <= 1e-3 * norm, name


@pytest.mark.parametrize("seed", range(8))
def test_gradients_of_ordinary_scenes_are_right_to_the_fifth_digit(seed):
    size = (50, 37)
    values = scene(seed, ["plain"] * 60)
    keep = ~at_a_cut(values, size)
    assert float(keep.float().mean()) > 0.9
    _, expected, _ = draw(values, size, keep, torch.float64)
    _, found, _ = draw(values, size, keep)
    for name, exact, ours in zip(INPUTS, expected, found, strict=True):
        assert float((ours.double() - exact).norm()) <= 1e-5 * float(exact.norm()), name


def test_thousands_of_coincident_gaussians():
    values = scene(0, ["coincident"] * 5000)
    size, weights = (24, 20), torch.ones(20, 24)
    rendered, gradients, _ = draw(values, size, weights)
    exact, expected, _ = draw(values, size, weights, torch.float64)
    assert float((rendered.double() - exact).abs().max()) < 1e-3
    assert all(torch.isfinite(gradient).all() for gradient in gradients)
    assert torch.equal(rendered, draw(values, size, weights)[0])
    assert float(exact[..., 3].max()) > 0.999
    for name, theirs, ours in zip(INPUTS, expected, gradients, strict=True):
        if name in ("opacities", "features"):
            assert float((ours.double() - theirs).norm()) <= 1e-3 * float(theirs.norm()), name


def test_more_instances_than_can_be_numbered_are_refused(monkeypatch):
    values = scene(1, ["plain"] * 20)
    monkeypatch.setattr(functions, "MAX_INSTANCES", 5)
    with pytest.raises(ValueError, match="too many"):
        rasterize(*values.values(), *camera(64, 48), 64, 48)

"""The oracle against first principles, and the CPU kernels against the oracle: values, gradients, hostile input."""

from __future__ import annotations

import threading

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from flowsplat.common.threads import set_thread_count, thread_count
from flowsplat.geometry.rotations import covariances
from flowsplat.splatting import rasterize
from flowsplat.splatting.cpu import functions
from flowsplat.splatting.cpu.blending import E0, E1, E2, E3, E4, E5
from flowsplat.splatting.cpu.workspace import Lease, Workspace

WIDTH, HEIGHT = 50, 37
NAMES = ("means", "quats", "scales", "opacities", "features", "viewmat", "K")


def random_gaussians(count: int, channels: int, seed: int = 0, spread: float = 0.8, size: float = -2.0) -> dict[str, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    means = spread * normal(count, 3)
    means[:, 2] += 3
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, 3] = torch.tensor([0.1, -0.1, 0.2])
    return {
        "means": means,
        "quats": normal(count, 4),
        "scales": torch.exp(0.5 * normal(count, 3) + size),
        "opacities": torch.rand(count, generator=g, dtype=torch.float64),
        "features": normal(count, channels),
        "viewmat": viewmat,
        "K": torch.tensor([[40.0, 0, 25], [0, 42, 18], [0, 0, 1]], dtype=torch.float64),
    }


def in_float32(values):
    """The numbers that a float32 can hold, so that no difference comes from there."""
    return {name: value.float().double() for name, value in values.items()}


def run(values, backend, covars=None, **options):
    """Outputs and the gradients of a fixed random functional of them."""
    dtype = torch.float64 if backend == "reference" else torch.float32
    leaves = {name: value.detach().to(dtype).requires_grad_() for name, value in values.items()}
    extra = {} if covars is None else {"covars": covars.detach().to(dtype).requires_grad_()}
    image, alphas, info = rasterize(*leaves.values(), WIDTH, HEIGHT, backend=backend, **extra, **options)
    info["means2d"].retain_grad()
    g = torch.Generator().manual_seed(9)
    total = (image * torch.randn(image.shape, generator=g, dtype=torch.float64).to(dtype)).sum()
    total = total + (alphas * torch.randn(alphas.shape, generator=g, dtype=torch.float64).to(dtype)).sum()
    visible = info["radii"][:, 0] > 0
    weights = torch.randn(len(visible), generator=g, dtype=torch.float64).to(dtype)
    total = total + (info["depths"] * weights)[visible].sum()
    total.backward()
    gradients = {name: leaf.grad for name, leaf in {**leaves, **extra}.items() if leaf.grad is not None}
    gradients["means2d"] = info["means2d"].grad
    return image.detach(), alphas.detach(), info, gradients


def relative(a: torch.Tensor, b: torch.Tensor) -> float:
    a, b = a.detach().double(), b.detach().double()
    return float((a - b).norm() / b.norm().clamp(min=1e-9))


@pytest.mark.parametrize("channels", [1, 3, 6, 11])
@pytest.mark.parametrize("with_covars", [False, True])
def test_kernels_match_the_oracle(channels, with_covars):
    values = in_float32(random_gaussians(70, channels))
    covars = covariances(values["quats"], values["scales"]) if with_covars else None
    expected = run(values, "reference", covars)
    found = run(values, "cpu", covars)
    assert relative(found[0], expected[0]) < 2e-6
    assert relative(found[1], expected[1]) < 2e-6
    for name in ("depths", "conics"):
        visible = expected[2]["radii"][:, 0] > 0
        assert relative(found[2][name][visible], expected[2][name][visible]) < 1e-5
    assert (found[2]["radii"] - expected[2]["radii"]).abs().max() <= 1
    assert set(found[3]) == set(expected[3])
    for name, gradient in expected[3].items():
        assert relative(found[3][name], gradient) < 1e-5, name


def test_gradients_of_the_oracle_are_the_derivatives():
    values = random_gaussians(5, 2, seed=3, size=-1.0)
    values["opacities"] = values["opacities"] * 0.5 + 0.2

    def smooth(*leaves):
        # Far from every cut: large Gaussians and few pixels, so that no alpha crosses 1/255.
        image, alphas, _ = rasterize(*leaves, 5, 4, backend="reference")
        return image, alphas

    values["K"] = torch.tensor([[4.0, 0, 2.5], [0, 4.2, 2], [0, 0, 1]], dtype=torch.float64)
    values["scales"] = values["scales"] * 4
    assert torch.autograd.gradcheck(smooth, tuple(v.requires_grad_() for v in values.values()), eps=1e-7, atol=1e-5)


def test_one_gaussian_has_the_alpha_of_the_formula():
    viewmat, K = torch.eye(4), torch.tensor([[20.0, 0, 10], [0, 20, 10], [0, 0, 1]])
    image, alphas, info = rasterize(
        torch.tensor([[0.0, 0, 2]]), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.2), torch.tensor([0.8]),
        torch.tensor([[1.0, 0.5]]), viewmat, K, 20, 20,
    )  # fmt: skip
    variance = (20 * 0.2 / 2) ** 2 + 0.3
    d2 = (0.5**2 + 2.5**2) / variance
    assert float(alphas[9, 12]) == pytest.approx(0.8 * np.exp(-d2 / 2), rel=1e-4)
    assert float(image[9, 12, 1]) == pytest.approx(0.4 * np.exp(-d2 / 2), rel=1e-4)
    assert info["means2d"][0].tolist() == [10, 10]
    assert float(alphas[0, 0]) == 0  # below 1/255


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_alpha_is_clamped_and_a_full_pixel_stops(backend):
    dtype = torch.float64 if backend == "reference" else torch.float32
    count = 6
    means = torch.zeros(count, 3, dtype=dtype)
    means[:, 2] = torch.arange(count) + 2.0
    features = torch.eye(count, dtype=dtype)
    quats = torch.tensor([[1.0, 0, 0, 0]], dtype=dtype).expand(count, 4)
    K = torch.tensor([[10.0, 0, 4.5], [0, 10, 4.5], [0, 0, 1]], dtype=dtype)
    opacities = torch.ones(count, dtype=dtype, requires_grad=True)
    image, alphas, _ = rasterize(
        means, quats, torch.full((count, 3), 5.0, dtype=dtype), opacities, features, torch.eye(4, dtype=dtype), K, 9, 9,
        backend=backend,
    )  # fmt: skip
    # 0.999, then 0.001 * 0.999 would leave 1e-6 <= 1e-4: the second is not drawn, nor anything behind it.
    assert float(image[4, 4, 0]) == pytest.approx(0.999, abs=1e-6)
    assert float(image[4, 4, 1:].abs().max()) == 0
    assert float(alphas[4, 4]) == pytest.approx(0.999, abs=1e-6)
    image[4, 4].sum().backward()
    assert float(opacities.grad.abs().max()) == 0  # clamped or not drawn: no gradient


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_equal_depths_are_ordered_by_index(backend):
    dtype = torch.float64 if backend == "reference" else torch.float32
    values = random_gaussians(40, 3, seed=5)
    values["means"][:, 2] = 3.0
    image, _, _, _ = run(values, backend)
    flipped = {name: value if name in ("viewmat", "K") else value.flip(0) for name, value in values.items()}
    other, _, _, _ = run(flipped, backend)
    assert image.dtype == dtype
    assert float((image - other).abs().max()) > 1e-3


def test_background_shows_where_nothing_covers():
    values = random_gaussians(1, 2)
    values["means"][0] = torch.tensor([50.0, 0, 3])
    image, alphas, info = rasterize(*(v.float() for v in values.values()), WIDTH, HEIGHT, background=torch.tensor([0.25, 0.75]))
    assert float(alphas.abs().max()) == 0
    assert torch.equal(image, torch.tensor([0.25, 0.75]).expand(HEIGHT, WIDTH, 2))
    assert info["radii"].abs().sum() == 0


@pytest.mark.parametrize(("width", "height"), [(1, 1), (16, 16), (17, 33), (15, 1)])
def test_odd_sizes(width, height):
    values = random_gaussians(30, 3, seed=11)
    arguments = [v.float() for v in values.values()]
    image, alphas, _ = rasterize(*arguments, width, height, backend="cpu")
    expected, alphas_expected, _ = rasterize(*values.values(), width, height, backend="reference")
    assert image.shape == (height, width, 3)
    torch.testing.assert_close(image.double(), expected, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(alphas.double(), alphas_expected, atol=1e-5, rtol=1e-5)


def test_no_gaussian_at_all():
    values = {name: v if name in ("viewmat", "K") else v[:0] for name, v in random_gaussians(4, 3).items()}
    for backend in ("cpu", "reference"):
        dtype = torch.float32 if backend == "cpu" else torch.float64
        image, alphas, _ = rasterize(*(v.to(dtype) for v in values.values()), 20, 10, backend=backend)
        assert float(image.abs().max()) == 0
        assert float(alphas.abs().max()) == 0


@pytest.mark.all_cores
def test_same_bits_with_any_number_of_threads():
    values = random_gaussians(2000, 6, seed=13, spread=1.0, size=-3.0)
    threads = thread_count()
    results = []
    try:
        for count in (1, threads, 1):
            set_thread_count(count)
            image, alphas, _, gradients = run(values, "cpu")
            results.append([image, alphas, *gradients.values()])
    finally:
        set_thread_count(threads)
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            assert torch.equal(a, b)


def test_two_passes_can_be_alive_at_once():
    values = {name: v.float().requires_grad_() for name, v in random_gaussians(50, 3).items()}
    first, _, _ = rasterize(*values.values(), WIDTH, HEIGHT)
    doubled = {**values, "means": values["means"] * 1.1}
    second, _, _ = rasterize(*doubled.values(), WIDTH, HEIGHT)
    (alone,) = torch.autograd.grad(first.sum(), values["means"], retain_graph=True)
    (again,) = torch.autograd.grad(first.sum() + 0 * second.sum(), values["means"])
    assert torch.equal(alone, again)


@given(st.integers(0, 10_000))
@settings(max_examples=15, deadline=None)
def test_order_of_gaussians_does_not_matter(seed):
    values = random_gaussians(40, 3, seed=seed)
    shuffle = torch.randperm(40, generator=torch.Generator().manual_seed(seed))
    shuffled = {name: v if name in ("viewmat", "K") else v[shuffle] for name, v in values.items()}
    results = []
    for version in (values, shuffled):
        leaves = {name: value.float().requires_grad_() for name, value in version.items()}
        image, _, _ = rasterize(*leaves.values(), WIDTH, HEIGHT)
        (image**2).sum().backward()
        results.append((image.detach(), leaves["means"].grad))
    (a, ga), (b, gb) = results
    assert torch.equal(a, b)
    assert relative(gb, ga[shuffle]) < 1e-6


def test_exponential_is_accurate():
    x = np.linspace(-1, 0, 10001)
    value = (((((E5 * x + E4) * x + E3) * x + E2) * x + E1) * x + E0) ** 8
    assert np.abs(value / 2.0 ** (8 * x) - 1).max() < 2e-6


def test_bad_arguments_are_named():
    values = random_gaussians(3, 2)
    arguments = list(values.values())
    with pytest.raises(ValueError, match="float32"):
        rasterize(*arguments, 8, 8, backend="cpu")
    with pytest.raises(ValueError, match="unknown backend"):
        rasterize(*arguments, 8, 8, backend="quantum")
    with pytest.raises(ValueError, match="features"):
        rasterize(*arguments[:4], torch.ones(2, 2), *arguments[5:], 8, 8)
    for k, name in enumerate(NAMES):
        broken = [value.clone() for value in arguments]
        broken[k].view(-1)[1] = float("nan") if k % 2 else float("inf")
        with pytest.raises(ValueError, match=f"{name} must be finite"):
            rasterize(*broken, 8, 8)
    with pytest.raises(ValueError, match="quats"):
        rasterize(arguments[0], None, None, *arguments[3:], 8, 8)


@pytest.mark.parametrize("sigma", [3e3, 1e5])
def test_long_thin_gaussians_are_drawn(sigma):
    """Whatever their direction: float32 knows little of the determinant of such a conic."""
    for angle in np.linspace(0.05, 3.1, 23):
        values = {
            "means": torch.tensor([[0.0, 0.0, 1.0]]),
            "quats": torch.tensor([[np.cos(angle / 2), 0, 0, np.sin(angle / 2)]], dtype=torch.float32),
            "scales": torch.tensor([[sigma / 50, 1e-5, 1e-5]]),
            "opacities": torch.tensor([0.9]),
            "features": torch.ones(1, 1),
            "viewmat": torch.eye(4),
            "K": torch.tensor([[50.0, 0, 16.5], [0, 50, 12.5], [0, 0, 1]]),
        }
        alphas = rasterize(*values.values(), 33, 25, backend="cpu")[1]
        assert float(alphas[12, 16]) == pytest.approx(0.9, abs=0.02)


def test_any_number_of_channels(monkeypatch):
    values = in_float32(random_gaussians(70, 7))
    monkeypatch.setattr(functions, "MAX_CHANNELS", 3)
    expected, found = run(values, "reference"), run(values, "cpu")
    assert relative(found[0], expected[0]) < 2e-6
    assert relative(found[1], expected[1]) < 2e-6
    for name, gradient in expected[3].items():
        assert relative(found[3][name], gradient) < 1e-5, name


def test_a_second_derivative_is_refused():
    values = {name: v.float().requires_grad_() for name, v in random_gaussians(20, 3).items()}
    image, _, _ = rasterize(*values.values(), WIDTH, HEIGHT)
    (gradient,) = torch.autograd.grad((image**2).sum(), values["means"], create_graph=True)
    with pytest.raises(RuntimeError, match="differentiable"):
        gradient.sum().backward()


def test_a_lease_may_end_while_another_begins():
    def end():
        lease = Lease()
        with Workspace._lock:  # as where the garbage collector runs in the middle of acquiring
            del lease

    thread = threading.Thread(target=end, daemon=True)
    thread.start()
    thread.join(5)
    assert not thread.is_alive()

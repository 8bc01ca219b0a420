"""gsplat's operators by torch: against first principles, gsplat's torch reference, and in gsplat's own functions and optimizer."""

from __future__ import annotations

import math
import subprocess
import sys
from types import SimpleNamespace

import pytest
import torch

from flowsplat import gsplat_ops
from flowsplat.geometry.rotations import quats_to_rotations


def numbers(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


BINOMIALS = torch.tensor([[math.comb(n, k) for k in range(51)] for n in range(51)], dtype=torch.float64)


def relocation_of_the_paper(opacity: float, count: int) -> tuple[float, float]:
    """Eq. 9, as it stands there."""
    new = 1 - (1 - opacity) ** (1 / count)
    total = sum(math.comb(i - 1, k) * (-1) ** k / math.sqrt(k + 1) * new ** (k + 1) for i in range(1, count + 1) for k in range(i))
    return new, opacity / total


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_relocation_is_that_of_the_paper(dtype):
    opacities = torch.tensor([0.05, 0.3, 0.7, 0.95, 0.99, 0.5], dtype=dtype)
    ratios = torch.tensor([1, 2, 3, 7, 20, 51])
    scales = torch.rand(6, 3, generator=torch.Generator().manual_seed(0)).to(dtype) + 0.1
    new, larger = gsplat_ops.compute_relocation(opacities, scales, ratios, BINOMIALS)
    assert (new.dtype, larger.dtype) == (dtype, dtype)
    for i, (opacity, count) in enumerate(zip(opacities.tolist(), ratios.tolist(), strict=True)):
        expected, factor = relocation_of_the_paper(opacity, count)
        assert float(new[i]) == pytest.approx(expected, rel=1e-5)
        torch.testing.assert_close(larger[i], factor * scales[i], rtol=1e-5, atol=0)
    torch.testing.assert_close(new[:1], opacities[:1])  # one alone stays as it is


def test_no_more_share_a_place_than_there_are_binomials():
    one = torch.tensor([0.6]), torch.ones(1, 3)
    found = gsplat_ops.compute_relocation(*one, torch.tensor([40]), BINOMIALS[:9, :9])
    expected = gsplat_ops.compute_relocation(*one, torch.tensor([9]), BINOMIALS)
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))
    for count in (0, -3):
        assert torch.equal(gsplat_ops.compute_relocation(*one, torch.tensor([count]), BINOMIALS)[0], one[0])


def test_nothing_to_relocate():
    new, scales = gsplat_ops.compute_relocation(torch.zeros(0), torch.zeros(0, 3), torch.zeros(0, dtype=torch.int64), BINOMIALS)
    assert (new.shape, scales.shape) == ((0,), (0, 3))


def test_opacities_may_be_a_column():
    """As Splatfacto has them."""
    opacities, scales, ratios = torch.tensor([0.2, 0.5, 0.9]), torch.ones(3, 3), torch.tensor([1, 2, 9])
    new, larger = gsplat_ops.compute_relocation(opacities, scales, ratios, BINOMIALS)
    column, same = gsplat_ops.compute_relocation(opacities[:, None], scales, ratios, BINOMIALS)
    assert torch.equal(column, new[:, None])
    assert torch.equal(same, larger)


def test_gaussians_that_share_a_place_look_as_the_one_did():
    """The integral over a line through the middle, of n of them blended front to back."""
    opacity, count = 0.8, 4
    new, scale = relocation_of_the_paper(opacity, count)
    x = torch.linspace(-12, 12, 4001, dtype=torch.float64)
    one = opacity * torch.exp(-0.5 * x**2)
    together = 1 - (1 - new * torch.exp(-0.5 * (x / scale) ** 2)) ** count
    assert float(together.sum()) == pytest.approx(float(one.sum()), rel=1e-6)
    assert float(together.max()) == pytest.approx(opacity)


@pytest.mark.parametrize("shape", [(), (5,), (2, 3)])
@pytest.mark.parametrize("triu", [False, True])
def test_covariances_and_their_inverses(shape, triu):
    quats, scales = numbers(*shape, 4), numbers(*shape, 3, seed=1).exp()
    covars, precis = gsplat_ops.quat_scale_to_covar_preci(quats, scales, triu=triu)
    R = quats_to_rotations(quats)
    expected = R @ torch.diag_embed(scales**2) @ R.mT
    inverse = torch.linalg.inv(expected)
    if triu:
        rows, columns = torch.triu_indices(3, 3)
        expected, inverse = expected[..., rows, columns], inverse[..., rows, columns]
    torch.testing.assert_close(covars, expected)
    torch.testing.assert_close(precis, inverse)
    assert gsplat_ops.quat_scale_to_covar_preci(quats, scales, compute_preci=False)[1] is None


def test_harmonics_are_orthonormal():
    """Mean over many directions of the product of two of them, times 4 pi."""
    directions = numbers(20_000, 3)
    one_each = torch.eye(25, dtype=torch.float64)[None, :, :, None].expand(len(directions), 25, 25, 3)
    basis = gsplat_ops.spherical_harmonics(4, directions[:, None].expand(-1, 25, 3), one_each)[..., 0]
    products = 4 * math.pi * (basis.T @ basis) / len(directions)
    assert float((products - torch.eye(25, dtype=torch.float64)).abs().max()) < 0.1


def test_masks_leave_zeros():
    dirs, coeffs = numbers(6, 3), numbers(6, 9, 3)
    masks = torch.tensor([True, False, True, True, False, False])
    found = gsplat_ops.spherical_harmonics(2, dirs, coeffs, masks)
    assert torch.equal(found[masks], gsplat_ops.spherical_harmonics(2, dirs[masks], coeffs[masks]))
    assert not bool(found[~masks].any())


def test_adam_steps_where_it_may():
    param, grad = numbers(5, 2, 3), numbers(5, 2, 3, seed=1)
    mean, square = 0.1 * numbers(5, 2, 3, seed=2), numbers(5, 2, 3, seed=3).abs()
    valid = torch.tensor([True, False, True, False, False])
    found = [value.clone() for value in (param, mean, square)]
    gsplat_ops.adam(found[0].requires_grad_(), grad, *found[1:], valid, 0.01, 0.9, 0.999, 1e-8)
    new_mean, new_square = 0.9 * mean + 0.1 * grad, 0.999 * square + 0.001 * grad**2
    expected = param - 0.01 * new_mean / (new_square.sqrt() + 1e-8), new_mean, new_square
    for now, new, old in zip(found, expected, (param, mean, square), strict=True):
        torch.testing.assert_close(now.detach()[valid], new[valid])
        assert torch.equal(now.detach()[~valid], old[~valid])
    everything = param.clone()
    gsplat_ops.adam(everything, grad, mean, square, None, 0.01, 0.9, 0.999, 1e-8)
    torch.testing.assert_close(everything, expected[0])


@pytest.mark.parametrize(
    ("call", "named"),
    [
        (lambda: gsplat_ops.compute_relocation(numbers(3), numbers(2, 3), torch.ones(3), BINOMIALS), "scales"),
        (lambda: gsplat_ops.compute_relocation(numbers(3), numbers(3, 3), torch.ones(2), BINOMIALS), "ratios"),
        (lambda: gsplat_ops.compute_relocation(numbers(3, 2), numbers(3, 3), torch.ones(3), BINOMIALS), "opacities"),
        (lambda: gsplat_ops.quat_scale_to_covar_preci(numbers(3, 3), numbers(3, 3)), "quats"),
        (lambda: gsplat_ops.quat_scale_to_covar_preci(numbers(3, 4), numbers(2, 3)), "scales"),
        (lambda: gsplat_ops.spherical_harmonics(5, numbers(3, 3), numbers(3, 36, 3)), "degrees_to_use"),
        (lambda: gsplat_ops.spherical_harmonics(2, numbers(3, 3), numbers(3, 4, 3)), "coeffs"),
        (lambda: gsplat_ops.spherical_harmonics(1, numbers(3, 2), numbers(3, 4, 3)), "dirs"),
        (lambda: gsplat_ops.spherical_harmonics(1, numbers(3, 3), numbers(3, 4, 3), torch.ones(2)), "masks"),
        (lambda: gsplat_ops.adam(*(numbers(3, 2),) * 3, numbers(3), None, 1, 1, 1, 1), "exp_avg_sq"),
        (lambda: gsplat_ops.adam(*(numbers(3, 2),) * 4, torch.ones(2), 1, 1, 1, 1), "valid"),
    ],
)
def test_what_does_not_fit_is_named(call, named):
    with pytest.raises(ValueError, match=f"^{named} must"):
        call()


def test_without_gsplat_there_is_nothing_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(ImportError):
        gsplat_ops.install()


def test_another_version_is_refused(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(__version__="1.4.0"))
    with pytest.raises(ImportError, match=r"gsplat 1\.5, and this is gsplat 1\.4\.0"):
        gsplat_ops.install()


# --- in gsplat itself ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def gsplat():
    module = pytest.importorskip("gsplat", reason="gsplat is not installed")
    gsplat_ops.install()
    return module


@pytest.mark.parametrize("triu", [False, True])
@pytest.mark.parametrize("parts", [(True, True), (True, False), (False, True)])
def test_its_covariances_are_those_of_its_reference(gsplat, triu, parts):
    from gsplat.cuda._torch_impl import _quat_scale_to_covar_preci

    results = []
    for function in (gsplat.quat_scale_to_covar_preci, _quat_scale_to_covar_preci):
        leaves = numbers(7, 4).requires_grad_(), numbers(7, 3, seed=1).exp().requires_grad_()
        found = [value for value, wanted in zip(function(*leaves, *parts, triu), parts, strict=True) if wanted]
        sum((value * numbers(*value.shape, seed=2)).sum() for value in found).backward()
        results.append([*found, *(leaf.grad for leaf in leaves)])
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a, b)


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_its_harmonics_are_those_of_its_reference(gsplat, degree):
    from gsplat.cuda._torch_impl import _spherical_harmonics

    results = []
    for function in (gsplat.spherical_harmonics, _spherical_harmonics):
        leaves = numbers(7, 3).requires_grad_(), numbers(7, 25, 3, seed=1).requires_grad_()
        colors = function(degree, *leaves)
        (colors * numbers(7, 3, seed=2)).sum().backward()
        slope = torch.zeros(7, 3, dtype=torch.float64) if leaves[0].grad is None else leaves[0].grad
        results.append([colors, slope, leaves[1].grad])
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-8)


def test_its_selective_adam_steps_where_it_may(gsplat):
    param = torch.nn.Parameter(numbers(6, 3).float())
    before = param.detach().clone()
    optimizer = gsplat.SelectiveAdam([{"params": [param], "lr": 0.001}], eps=1e-15, betas=(0.9, 0.999))
    visible = torch.tensor([True, True, False, True, False, False])
    for _ in range(3):
        (param**2).sum().backward()
        optimizer.step(visible)
        optimizer.zero_grad()
    assert torch.equal(param.detach()[~visible], before[~visible])
    assert bool((param.detach()[visible].abs() < before[visible].abs()).all())


def test_its_relocation_asks_ours(gsplat):
    from gsplat.relocation import compute_relocation

    ratios = torch.tensor([1, 2, 9])
    given = torch.tensor([0.2, 0.5, 0.9]), torch.ones(3, 3)
    found = compute_relocation(*given, ratios.clone(), BINOMIALS.float())
    expected = gsplat_ops.compute_relocation(*given, ratios, BINOMIALS)
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


def test_what_is_not_there_is_named(gsplat):
    from gsplat.cuda._backend import _C

    with pytest.raises(AttributeError, match=r"operator intersect_tile needs a GPU.*relocation"):
        _ = _C.intersect_tile


def test_compiled_operators_keep_what_is_on_a_gpu():
    class Theirs:
        other = "theirs"

        @staticmethod
        def relocation(*args):
            return "on a GPU"

    class OnGpu(torch.Tensor):
        is_cuda = True

    operators = gsplat_ops._Operators(Theirs)
    assert operators.other == "theirs"
    assert operators.relocation(torch.ones(1).as_subclass(OnGpu)) == "on a GPU"
    new, _ = operators.relocation(torch.tensor([0.5]), torch.ones(1, 3), torch.tensor([1]), BINOMIALS, 51)
    assert new.tolist() == [0.5]
    assert operators.adam is gsplat_ops.adam


def test_it_may_be_installed_before_gsplat_looks_for_a_compiler(gsplat):
    """And again, and after; nothing is printed."""
    code = (
        "import flowsplat.gsplat_ops as ops; ops.install(); ops.install(); import gsplat, torch\n"
        "covars, _ = gsplat.quat_scale_to_covar_preci(torch.eye(4)[:1], torch.ones(1, 3))\n"
        "from gsplat.cuda._backend import _C; assert isinstance(_C, ops._Operators); print(covars.tolist())"
    )
    result = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]]"

"""The kernel of the colors against the oracle, and the oracle against its own derivative."""

from __future__ import annotations

import pytest
import torch

from flowsplat.splatting.harmonics import colors_from_harmonics, colors_in_torch, harmonics_basis


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("stored", [16, None])
def test_the_kernel_matches_the_oracle(degree, stored):
    g = torch.Generator().manual_seed(degree)
    sh = torch.randn(300, stored or (degree + 1) ** 2, 3, generator=g)
    directions = torch.randn(300, 3, generator=g) * torch.rand(300, 1, generator=g) * 5
    weights = torch.randn(300, 3, generator=g)
    results = []
    for function, dtype in ((colors_in_torch, torch.float64), (colors_from_harmonics, torch.float32)):
        leaves = [value.to(dtype).requires_grad_() for value in (sh.clone(), directions.clone())]
        colors = function(*leaves, degree)
        (colors * weights.to(dtype)).sum().backward()
        results.append([colors.detach(), *(leaf.grad for leaf in leaves)])
    assert 0.05 < float((results[0][0] == 0).double().mean()) < 0.6  # some are clamped
    for exact, ours in zip(*results, strict=True):
        assert float((ours.double() - exact).norm()) < 2e-6 * float(exact.norm())


def test_coefficients_alone_may_want_a_gradient():
    sh = torch.randn(5, 4, 3, requires_grad=True)
    colors_from_harmonics(sh, torch.randn(5, 3), 1).sum().backward()
    assert torch.isfinite(sh.grad).all()


def test_the_basis_is_orthonormal():
    g = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(400_000, 3, generator=g, dtype=torch.float64), dim=-1)
    basis = harmonics_basis(directions, 3)
    products = basis.T @ basis / len(basis) * 4 * torch.pi
    assert float((products - torch.eye(16)).abs().max()) < 0.03

"""What is written into a tensor between forward and backward: the gradient is that of what was drawn, or torch refuses it."""

from __future__ import annotations

import re

import pytest
import torch

from flowsplat import rasterization, rasterize
from flowsplat.geometry.rotations import covariances
from flowsplat.splatting.cpu import harmonics
from tests.splatting.test_gsplat_api import HEIGHT, WIDTH, leaves_of, make
from tests.splatting.test_rasterize import random_gaussians

REFUSED = r"modified (by an )?inplace"


def draw(leaves, **options):
    options = {"width": WIDTH, "height": HEIGHT, **options}
    return (rasterization(**leaves, **options)[0] ** 2).sum()


@pytest.mark.parametrize("with_covars", [False, True])
@pytest.mark.parametrize("packed", [False, True])
def test_no_input_that_is_changed_in_place_has_a_wrong_gradient(with_covars, packed):
    values = make(cameras=1, degree=2)
    names = ["means", "quats", "scales", "opacities", "colors", "viewmats", "Ks"]
    if with_covars:
        values["covars"] = covariances(values["quats"], values["scales"])
        values |= {"quats": None, "scales": None}
        names = [name for name in names if name not in ("quats", "scales")] + ["covars"]

    def make_leaves():
        some = {name: value for name, value in values.items() if value is not None}
        return {**dict.fromkeys(values), **leaves_of(some, torch.float32)}

    expected = make_leaves()
    draw(expected, sh_degree=2, packed=packed).backward()
    refused = set()
    for changed in names:
        leaves = make_leaves()
        loss = draw(leaves, sh_degree=2, packed=packed)
        with torch.no_grad():
            leaves[changed].add_(0.1)
        problem = ""
        try:
            loss.backward()
        except RuntimeError as error:
            problem = str(error)
        if problem:
            assert re.search(REFUSED, problem)
            refused.add(changed)
            continue
        for name in names:
            assert torch.equal(leaves[name].grad, expected[name].grad), (changed, name)
    assert refused >= {"means", "viewmats", "Ks", *(() if with_covars else ("quats", "scales"))}  # of covars a triangle is copied


@pytest.mark.parametrize("name", ["means2d", "conics"])
def test_what_was_projected_and_is_changed_in_place_is_refused(name):
    leaves = leaves_of(make(cameras=1), torch.float32)
    image, _, meta = rasterization(**leaves, width=WIDTH, height=HEIGHT, packed=False)
    with torch.no_grad():
        meta[name].mul_(1.5)
    if name == "conics":
        with pytest.raises(RuntimeError, match=REFUSED):
            image.sum().backward()
    else:  # blending keeps what it was given
        expected = leaves_of(make(cameras=1), torch.float32)
        rasterization(**expected, width=WIDTH, height=HEIGHT, packed=False)[0].sum().backward()
        image.sum().backward()
        assert torch.equal(leaves["means"].grad, expected["means"].grad)


@pytest.mark.parametrize("changed", ["sh", "directions", "colors"])
def test_harmonics_and_their_colors(changed):
    g = torch.Generator().manual_seed(0)
    sh, directions = torch.randn(20, 9, 3, generator=g).requires_grad_(), torch.randn(20, 3, generator=g).requires_grad_()
    colors = harmonics.colors(sh, directions, 2)
    with torch.no_grad():
        {"sh": sh, "directions": directions, "colors": colors}[changed].mul_(-1)
    with pytest.raises(RuntimeError, match=REFUSED):
        (colors**2).sum().backward()


@pytest.mark.parametrize("mode", ["RGB", "RGB+D", "RGB+ED", "D"])
@pytest.mark.parametrize("cameras", [1, 2])
def test_a_mask_may_be_written_into_the_image(cameras, mode):
    values = make(cameras=cameras)
    found, expected = leaves_of(values, torch.float32), leaves_of(values, torch.float32)
    images = rasterization(**found, width=WIDTH, height=HEIGHT, render_mode=mode)[0]
    images[:, :10] = 0
    (images**2).sum().backward()
    images = rasterization(**expected, width=WIDTH, height=HEIGHT, render_mode=mode)[0]
    (images[:, 10:] ** 2).sum().backward()
    for name in ("means", "scales", "opacities", "viewmats"):
        torch.testing.assert_close(found[name].grad, expected[name].grad, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("background", [None, torch.ones(3)])
def test_a_mask_may_be_written_into_the_image_of_rasterize(background):
    leaves = leaves_of(random_gaussians(30, 3), torch.float32)
    image, _, _ = rasterize(**leaves, width=50, height=37, background=background)
    image[:10] = 0
    (image**2).sum().backward()
    assert float(leaves["means"].grad.abs().max()) > 0


def test_an_image_is_copied_only_where_it_has_a_gradient(monkeypatch):
    copied, clone = [], torch.Tensor.clone
    monkeypatch.setattr(torch.Tensor, "clone", lambda tensor, **options: copied.append(tensor.shape) or clone(tensor, **options))
    alone = random_gaussians(30, 3)
    for make_them in (
        lambda some: {name: value.float() for name, value in some.items()},
        lambda some: leaves_of(some, torch.float32),
    ):
        copied.clear()
        image = rasterization(**make_them(make(cameras=1)), width=WIDTH, height=HEIGHT)[0]
        assert copied.count((HEIGHT, WIDTH, 3)) == image.requires_grad
        copied.clear()
        image = rasterize(**make_them(alone), width=50, height=37)[0]
        assert copied.count((37, 50, 3)) == image.requires_grad

"""The GPU backend against the oracle and the CPU backend: on a GPU where there is one, in Triton's interpreter elsewhere."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch

from flowsplat.geometry.rotations import covariances
from flowsplat.splatting import blend, project, rasterization
from tests.marks import slow
from tests.splatting.test_hostile import BROKEN, FINITE, scene
from tests.splatting.test_rasterize import in_float32, random_gaussians, relative

pytest.importorskip("triton", reason="Triton is not installed")

from flowsplat.splatting.triton import tiles

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
WIDTH, HEIGHT = 30, 20


@dataclass
class Result:
    """Images, what was projected, and the gradients of a fixed random functional of all of them; on the CPU."""

    image: torch.Tensor
    alphas: torch.Tensor
    radii: torch.Tensor
    gradients: dict[str, torch.Tensor]


def geometry(values: dict[str, torch.Tensor]) -> list[torch.Tensor]:
    """What ``project`` takes, in its order."""
    return [values[name] for name in ("means", "quats", "scales", "opacities", "viewmat", "K")]


def with_camera(values: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """A camera that sees some Gaussians of ``scene`` beyond the border, where the Jacobian is clamped."""
    viewmat, K = torch.eye(4), torch.tensor([[33.0, 0, 21], [0, 35, 13], [0, 0, 1]])
    viewmat[:3, 3] = torch.tensor([0.1, -0.05, 0.2])
    return {**values, "viewmat": viewmat, "K": K}


def draw(values, backend, *, size=(WIDTH, HEIGHT), covars=False, keep=None) -> Result:
    """Differentiate in every input, the camera too; ``keep`` [H, W] says which pixels count."""
    device = DEVICE if backend == "triton" else torch.device("cpu")
    dtype = torch.float64 if backend == "reference" else torch.float32
    leaves = {name: value.detach().to(device, dtype).requires_grad_() for name, value in values.items()}
    if covars:
        quats, scales = leaves.pop("quats"), leaves.pop("scales")
        leaves["covars"] = covariances(quats, scales).detach().requires_grad_()
    projected = project(
        leaves["means"], leaves.get("quats"), leaves.get("scales"), leaves["opacities"], leaves["viewmat"], leaves["K"],
        *size, covars=leaves.get("covars"), backend=backend,
    )  # fmt: skip
    assert projected.backend == backend
    projected.means2d.retain_grad()
    projected.conics.retain_grad()
    image, alphas = blend(projected, leaves["opacities"], leaves["features"], *size, absgrad=True)
    g = torch.Generator().manual_seed(9)

    def weights(like: torch.Tensor) -> torch.Tensor:
        return torch.randn(like.shape, generator=g, dtype=torch.float64).to(like)

    counts = torch.ones_like(alphas) if keep is None else keep.to(alphas)
    total = (image * weights(image) * counts[..., None]).sum() + (alphas * weights(alphas) * counts).sum()
    total = total + (projected.depths * weights(projected.depths))[projected.visible].sum()
    total.backward()
    gradients = {name: leaf.grad for name, leaf in leaves.items()}
    gradients |= {"means2d": projected.means2d.grad, "conics": projected.conics.grad, "absgrad": projected.means2d.absgrad}
    return Result(
        image.detach().cpu(), alphas.detach().cpu(), projected.radii.cpu(),
        {name: torch.zeros(0) if value is None else value.cpu() for name, value in gradients.items()},
    )  # fmt: skip


def at_a_cut(values, size=(WIDTH, HEIGHT)) -> torch.Tensor:
    """[H, W] where a change in the seventh digit makes a jump: an alpha at 1/255, a pixel about to stop, two depths alike."""

    def image(moved):
        parts = blend(project(*geometry(moved), *size), moved["opacities"], moved["features"], *size)
        return torch.cat([part.reshape(size[1], size[0], -1) for part in parts], -1)

    exact = {name: value.double() for name, value in values.items()}
    expected, jumps = image(exact), torch.zeros(size[1], size[0], dtype=torch.bool)
    for seed in range(4):
        g = torch.Generator().manual_seed(seed)
        moved = {
            name: value * (1 + 2e-6 * torch.randn(value.shape, generator=g, dtype=torch.float64)) for name, value in exact.items()
        }
        jumps |= (image(moved) - expected).abs().amax(-1) > 5e-5
    return jumps


@pytest.mark.parametrize(
    ("channels", "covars", "size"),
    [(3, False, (33, 17)), slow(1, False, (40, 28)), slow(3, True, (40, 28)), slow(6, False, (16, 32)), (10, True, (37, 19))],
)
def test_values_and_gradients_are_those_of_the_oracle(channels, covars, size):
    values = in_float32(random_gaussians(60, channels, seed=channels))
    keep = ~at_a_cut(values, size)
    assert float(keep.float().mean()) > 0.9
    expected = draw(values, "reference", size=size, covars=covars, keep=keep)
    found = draw(values, "triton", size=size, covars=covars, keep=keep)
    assert float((found.image.double() - expected.image)[keep].abs().max()) < 1e-5 * float(expected.image.abs().max())
    assert float((found.alphas.double() - expected.alphas)[keep].abs().max()) < 1e-5
    assert (found.radii - expected.radii).abs().max() <= 1
    assert set(found.gradients) == set(expected.gradients)
    for name, gradient in expected.gradients.items():
        assert relative(found.gradients[name], gradient) < 1e-4, name


@pytest.mark.parametrize("covars", [False, slow(True)])
def test_values_and_gradients_are_those_of_the_cpu(covars):
    values = {name: value.float() for name, value in random_gaussians(60, 6, seed=21).items()}
    keep = ~at_a_cut(values)
    expected, found = draw(values, "cpu", covars=covars, keep=keep), draw(values, "triton", covars=covars, keep=keep)
    # A GPU's logarithm and root are others than the interpreter's.
    assert (found.radii - expected.radii).abs().max() <= (0 if DEVICE.type == "cpu" else 1)
    assert relative(found.image[keep], expected.image[keep]) < 2e-6
    assert relative(found.alphas[keep], expected.alphas[keep]) < 2e-6
    for name, gradient in expected.gradients.items():
        assert relative(found.gradients[name], gradient) < 1e-5, name


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # NumPy's, of the interpreter, about what is NaN on purpose
@pytest.mark.parametrize("seed", [0, slow(1)])
@pytest.mark.parametrize("size", [(31, 17), slow((1, 40)), slow((70, 1))])
def test_hostile_gaussians_do_no_harm(seed, size):
    kinds = sorted({**FINITE, **BROKEN}) * 2 + ["plain"] * 10
    values = with_camera(scene(seed, kinds))
    found = draw(values, "triton", size=size)
    expected = draw(values, "cpu", size=size)
    assert torch.equal(found.radii > 0, expected.radii > 0)
    assert torch.isfinite(found.image).all()
    assert float(found.alphas.min()) >= 0
    assert float(found.alphas.max()) <= 1
    culled = found.radii[:, 0] == 0
    for name, gradient in found.gradients.items():
        assert torch.isfinite(gradient).all(), name
        if len(gradient) == len(culled):
            assert not gradient[culled].any(), f"{name} of culled Gaussians"
    # Thin and huge ones have exponents of which float32 keeps few digits: alike, but not everywhere.
    alike = (found.image - expected.image).abs().amax(-1) < 1e-3
    assert float(alike.float().mean()) > 0.95


def test_what_a_culled_gaussian_holds_does_not_matter():
    values = with_camera(scene(3, ["behind"] + ["plain"] * 5))
    expected = draw(values, "triton")
    for name in ("features", "quats", "scales"):
        values[name][0] = float("nan")
    found = draw(values, "triton")
    assert torch.isfinite(expected.image).all()
    assert torch.equal(found.image, expected.image)
    for name, gradient in expected.gradients.items():
        assert torch.equal(found.gradients[name], gradient), name


@pytest.mark.parametrize("kind", ["behind", "opacity 0", "far away", "NaN mean"])
def test_nothing_visible_gives_an_empty_image(kind):
    found = draw(with_camera(scene(1, [kind] * 5)), "triton")
    assert not found.image.any()
    assert not found.alphas.any()
    assert not any(gradient.any() for gradient in found.gradients.values())


def test_no_gaussian_at_all():
    found = draw(with_camera(scene(0, [])), "triton")
    assert found.image.shape == (HEIGHT, WIDTH, 3)
    assert not found.image.any()
    assert not found.alphas.any()


def test_equal_depths_are_ordered_by_index():
    values = random_gaussians(40, 3, seed=5)
    values["means"][:, 2] = 3.0
    values = {name: value.float() for name, value in values.items()}
    expected, found = draw(values, "cpu"), draw(values, "triton")
    assert relative(found.image, expected.image) < 1e-5
    flipped = {name: value if name in ("viewmat", "K") else value.flip(0) for name, value in values.items()}
    assert float((draw(flipped, "triton").image - found.image).abs().max()) > 1e-3


def test_alpha_is_clamped_and_a_full_pixel_stops():
    count = 6
    means = torch.zeros(count, 3)
    means[:, 2] = torch.arange(count) + 2.0
    values = {
        "means": means, "quats": torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1), "scales": torch.full((count, 3), 5.0),
        "opacities": torch.ones(count), "features": torch.eye(count), "viewmat": torch.eye(4),
        "K": torch.tensor([[10.0, 0, 4.5], [0, 10, 4.5], [0, 0, 1]]),
    }  # fmt: skip
    found = draw(values, "triton", size=(9, 9))
    # 0.999, then 0.001 * 0.999 would leave 1e-6 <= 1e-4: the second is not drawn, nor anything behind it.
    assert float(found.image[4, 4, 0]) == pytest.approx(0.999, abs=1e-6)
    assert float(found.image[4, 4, 1:].abs().max()) == 0
    assert float(found.alphas[4, 4]) == pytest.approx(0.999, abs=1e-6)


def test_many_layers_stop_where_the_oracle_stops():
    values = in_float32(random_gaussians(70, 2, seed=8, spread=0.25, size=-1.0))
    values["opacities"] = values["opacities"] * 0.5 + 0.5
    keep = ~at_a_cut(values)
    expected = draw(values, "reference", keep=keep)
    found = draw(values, "triton", keep=keep)
    assert float((expected.alphas > 0.999).double().mean()) > 0.2
    assert float((found.image.double() - expected.image)[keep].abs().max()) < 2e-5
    for name in ("means", "scales", "opacities", "features"):
        assert relative(found.gradients[name], expected.gradients[name]) < 1e-4, name


def test_same_bits_again_and_without_gradients():
    values = {name: value.float() for name, value in random_gaussians(40, 3, seed=2).items()}
    first, second = draw(values, "triton"), draw(values, "triton")
    assert torch.equal(first.image, second.image)
    for name, gradient in first.gradients.items():
        assert torch.equal(gradient, second.gradients[name]), name
    with torch.no_grad():
        given = {name: value.to(DEVICE) for name, value in values.items()}
        projected = project(*geometry(given), WIDTH, HEIGHT, backend="triton")
        image, alphas = blend(projected, given["opacities"], given["features"], WIDTH, HEIGHT)
    assert torch.equal(image.cpu(), first.image)
    assert torch.equal(alphas.cpu(), first.alphas)


def test_the_camera_may_be_on_the_cpu():
    values = {name: value.float() for name, value in random_gaussians(20, 3, seed=2).items()}
    expected = draw(values, "triton")
    leaves = {name: value.to("cpu" if name in ("viewmat", "K") else DEVICE).requires_grad_() for name, value in values.items()}
    projected = project(*geometry(leaves), WIDTH, HEIGHT, backend="triton")
    image, _ = blend(projected, leaves["opacities"], leaves["features"], WIDTH, HEIGHT)
    assert torch.equal(image.detach().cpu(), expected.image)
    image.sum().backward()
    assert leaves["viewmat"].grad.abs().sum() > 0
    assert leaves["K"].grad.abs().sum() > 0


def drawn_with(values, capacity, differentiate=True):
    """Image and gradients, drawn with this capacity."""
    leaves = {name: value.float().to(DEVICE).requires_grad_(differentiate) for name, value in values.items()}
    with capacity.fix():
        projected = project(*geometry(leaves), WIDTH, HEIGHT, backend="triton")
        image, _ = blend(projected, leaves["opacities"], leaves["features"], WIDTH, HEIGHT)
        if differentiate:
            image.square().sum().backward()
    return image.detach().cpu(), [leaf.grad for leaf in leaves.values()]


def test_what_exceeds_a_fixed_capacity_is_noticed_and_fits_when_it_has_grown(monkeypatch):
    monkeypatch.setattr(tiles, "_GRANULE", 16)
    values = random_gaussians(40, 3, seed=4)
    expected, gradients = drawn_with(values, ample := tiles.PairCapacity(DEVICE, 4096))
    assert not ample.has_overflowed()
    capacity = tiles.PairCapacity(DEVICE, 32)
    assert not capacity.has_overflowed()
    lacking, lacking_gradients = drawn_with(values, capacity)
    assert capacity.has_overflowed()
    assert float((lacking - expected).abs().max()) > 0.01
    assert torch.isfinite(lacking).all()
    assert all(torch.isfinite(gradient).all() for gradient in lacking_gradients)
    capacity.grow()
    assert not capacity.has_overflowed()
    assert capacity.pairs < 4096
    image, again = drawn_with(values, capacity)
    assert torch.equal(image, expected)
    assert all(map(torch.equal, again, gradients))


def test_the_shared_capacity_of_an_image_grows_by_itself(monkeypatch):
    monkeypatch.setattr(tiles, "_GRANULE", 16)
    monkeypatch.setattr(tiles, "_shared", {})
    values = {name: value.float() for name, value in random_gaussians(40, 3, seed=4).items()}
    expected = draw(values, "triton")
    small = tiles.get_shared_capacity(torch.empty(0, device=DEVICE).device, WIDTH, HEIGHT)
    small.pairs = 32
    found = draw(values, "triton")
    assert small.pairs > 32
    assert torch.equal(found.image, expected.image)
    for name, gradient in expected.gradients.items():
        assert torch.equal(found.gradients[name], gradient), name


def test_more_pairs_than_can_be_numbered_are_refused():
    with pytest.raises(ValueError, match="too many"):
        tiles.PairCapacity("cpu").grow(2**31)


@pytest.mark.parametrize("packed", [True, slow(False)])
def test_the_interface_of_gsplat_draws_with_it(packed):
    values = {name: value.float() for name, value in random_gaussians(30, 3, seed=6).items()}

    def drawn(backend, device):
        given = {name: value.to(device).requires_grad_() for name, value in values.items()}
        arguments = [given[name] for name in ("means", "quats", "scales", "opacities", "features")]
        cameras = given["viewmat"].expand(2, 4, 4), given["K"].expand(2, 3, 3)
        image, alphas, meta = rasterization(
            *arguments, *cameras, WIDTH, HEIGHT, packed=packed, absgrad=True, render_mode="RGB+ED", rasterize_mode="antialiased",
            backend=backend,
        )  # fmt: skip
        (image.sum() + alphas.sum()).backward()
        return [image.detach(), alphas.detach(), meta["means2d"].absgrad, *(leaf.grad for leaf in given.values())]

    for ours, theirs in zip(drawn("triton", DEVICE), drawn("cpu", torch.device("cpu")), strict=True):
        assert relative(ours.cpu(), theirs) < 1e-4


@pytest.mark.parametrize("changed", ["means", "quats", "scales", "viewmat", "K", "opacities", "features"])
def test_what_was_changed_in_place_has_no_wrong_gradient(changed):
    gradients, refused = [], False
    for change in (False, True):
        leaves = {name: value.float().to(DEVICE).requires_grad_() for name, value in with_camera(random_gaussians(12, 3)).items()}
        image, _ = blend(project(*geometry(leaves), 12, 8, backend="triton"), leaves["opacities"], leaves["features"], 12, 8)
        if change:
            with torch.no_grad():
                leaves[changed].mul_(1.5)
        try:
            (image**2).sum().backward()
        except RuntimeError as error:
            refused = "inplace" in str(error)
        gradients.append([leaf.grad for leaf in leaves.values()])
    assert refused or all(torch.equal(a, b) for a, b in zip(*gradients, strict=True))
    assert refused or changed not in ("means", "quats", "scales", "viewmat", "K", "opacities")

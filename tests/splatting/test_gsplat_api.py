"""``rasterization`` against the oracle put together by hand, and against gsplat's own torch functions."""

from __future__ import annotations

import inspect
import subprocess
import sys

import numpy as np
import pytest
import torch

import flowsplat
from flowsplat.geometry.rotations import covariances
from flowsplat.splatting import blend, project, rasterization, rasterize
from flowsplat.splatting.cpu import functions
from flowsplat.splatting.harmonics import colors_from_harmonics

WIDTH, HEIGHT = 40, 27
MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
GRADIENTS = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks")


def make(cameras: int = 2, channels: int = 3, count: int = 60, seed: int = 0, degree: int | None = None) -> dict[str, torch.Tensor]:
    """Arguments in float64: Gaussians around z = 3, a few of them behind or beside the cameras."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    means = normal(count, 3)
    means[:, 2] += 3
    viewmats = torch.eye(4, dtype=torch.float64).repeat(cameras, 1, 1)
    viewmats[:, :3, 3] = 0.2 * normal(cameras, 3)
    for c in range(cameras):
        turn = torch.tensor(0.15 * c, dtype=torch.float64)
        viewmats[c, 0, 0] = viewmats[c, 2, 2] = turn.cos()
        viewmats[c, 0, 2], viewmats[c, 2, 0] = turn.sin(), -turn.sin()
    return {
        "means": means,
        "quats": normal(count, 4),
        "scales": torch.exp(0.5 * normal(count, 3) - 2),
        "opacities": torch.rand(count, generator=g, dtype=torch.float64),
        "colors": normal(count, channels) if degree is None else 0.5 * normal(count, (degree + 1) ** 2, 3),
        "viewmats": viewmats,
        "Ks": torch.tensor([[30.0, 0, 20], [0, 32, 13], [0, 0, 1]], dtype=torch.float64).repeat(cameras, 1, 1),
    }


def leaves_of(values: dict[str, torch.Tensor], dtype: torch.dtype) -> dict[str, torch.Tensor]:
    return {name: value.detach().to(dtype).requires_grad_() for name, value in values.items()}


def functional(*outputs: torch.Tensor) -> torch.Tensor:
    """A fixed random functional, the same for every dtype."""
    g = torch.Generator().manual_seed(9)
    terms = [(x * torch.randn(x.shape, generator=g, dtype=torch.float64).to(x.dtype)).sum() for x in outputs]
    return torch.stack(terms).sum()


def relative(a: torch.Tensor, b: torch.Tensor) -> float:
    a, b = a.detach().double(), b.detach().double()
    assert a.shape == b.shape
    return float((a - b).norm() / b.norm().clamp(min=1e-9))


def by_hand(values, mode="RGB", degree=None, backgrounds=None):
    """One oracle image a camera, float64."""
    images, alphas = [], []
    for c, (viewmat, K) in enumerate(zip(values["viewmats"], values["Ks"], strict=True)):
        means = values["means"]
        depths = (means @ viewmat[:3, :3].T + viewmat[:3, 3])[:, 2]
        colors = values["colors"]
        if degree is not None:
            colors = colors_from_harmonics(colors, means - torch.linalg.inv(viewmat)[:3, 3], degree)
        image, alpha, _ = rasterize(
            means, values["quats"], values["scales"], values["opacities"], torch.cat([colors, depths[:, None]], 1),
            viewmat, K, WIDTH, HEIGHT, backend="reference",
        )  # fmt: skip
        color, depth = image[..., :-1], image[..., -1:]
        if backgrounds is not None:
            color = color + (1 - alpha)[..., None] * backgrounds[c]
        if "ED" in mode:
            depth = depth / alpha[..., None].clamp(min=1e-10)
        images.append({"RGB": color, "D": depth, "ED": depth}.get(mode, torch.cat([color, depth], -1)))
        alphas.append(alpha[..., None])
    return torch.stack(images), torch.stack(alphas)


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("mode", MODES)
def test_every_mode_matches_the_oracle(mode, packed):
    values, backgrounds = make(cameras=3), torch.rand(3, 3, generator=torch.Generator().manual_seed(1))
    expected_leaves, found_leaves = leaves_of(values, torch.float64), leaves_of(values, torch.float32)
    expected = by_hand(expected_leaves, mode, backgrounds=backgrounds.double())
    images, alphas, meta = rasterization(
        **found_leaves, width=WIDTH, height=HEIGHT, render_mode=mode, packed=packed, backgrounds=backgrounds
    )
    assert images.shape == (3, HEIGHT, WIDTH, {"RGB": 3, "D": 1, "ED": 1}.get(mode, 4))
    assert alphas.shape == (3, HEIGHT, WIDTH, 1)
    assert relative(images, expected[0]) < 5e-6
    assert relative(alphas, expected[1]) < 5e-6
    functional(*expected).backward()
    functional(images, alphas).backward()
    for name in GRADIENTS:
        if name == "colors" and mode in ("D", "ED"):
            assert found_leaves[name].grad is None
        else:
            assert relative(found_leaves[name].grad, expected_leaves[name].grad) < 5e-5, name
    assert (meta["width"], meta["height"], meta["n_cameras"], meta["n_batches"]) == (WIDTH, HEIGHT, 3, 1)


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_harmonics_are_seen_from_each_camera(degree):
    values = make(degree=max(degree, 3))
    expected_leaves, found_leaves = leaves_of(values, torch.float64), leaves_of(values, torch.float32)
    expected = by_hand(expected_leaves, degree=degree)
    images, alphas, _ = rasterization(**found_leaves, width=WIDTH, height=HEIGHT, sh_degree=degree)
    assert relative(images, expected[0]) < 5e-6
    functional(*expected).backward()
    functional(images, alphas).backward()
    for name in GRADIENTS:
        assert relative(found_leaves[name].grad, expected_leaves[name].grad) < 5e-5, name


def test_many_channels_and_colors_of_each_camera():
    values = make(channels=40)
    values["colors"] = torch.stack([values["colors"], values["colors"].flip(0)])
    single = {name: value.float() for name, value in values.items()}
    for packed in (True, False):
        images, _, _ = rasterization(**single, width=WIDTH, height=HEIGHT, packed=packed)
        for c in range(2):
            expected, _ = by_hand({**values, "colors": values["colors"][c]})
            assert relative(images[c], expected[c]) < 5e-6
    harmonics = make(degree=1)
    colors = torch.stack([harmonics["colors"], harmonics["colors"].flip(0)])
    images, _, _ = rasterization(**{**harmonics, "colors": colors}, width=WIDTH, height=HEIGHT, sh_degree=1)
    expected, _ = by_hand({**harmonics, "colors": colors[1]}, degree=1)
    assert relative(images[1], expected[1]) < 1e-12


def test_covars_replace_quats_and_scales():
    values = leaves_of(make(), torch.float32)
    expected, _, _ = rasterization(**values, width=WIDTH, height=HEIGHT)
    functional(expected).backward()
    by_scales = values["scales"].grad
    values["scales"].grad = None
    covars = covariances(values["quats"], values["scales"])
    others = {**values, "quats": None, "scales": None}
    found, _, _ = rasterization(**others, covars=covars, width=WIDTH, height=HEIGHT)
    assert relative(found, expected) < 1e-6
    functional(found).backward()
    assert relative(values["scales"].grad, by_scales) < 1e-4


@pytest.mark.parametrize("absgrad", [False, True])
def test_packed_holds_what_is_visible_of_unpacked(absgrad):
    values = make(cameras=3)
    results = []
    for packed in (False, True):
        leaves = leaves_of(values, torch.float32)
        images, alphas, meta = rasterization(**leaves, width=WIDTH, height=HEIGHT, packed=packed, absgrad=absgrad)
        meta["means2d"].retain_grad()
        functional(images, alphas).backward()
        results.append((images, alphas, meta, leaves))
    (images, alphas, full, leaves), (packed_images, packed_alphas, some, packed_leaves) = results
    assert torch.equal(images, packed_images)
    assert torch.equal(alphas, packed_alphas)
    for name in GRADIENTS:
        assert relative(packed_leaves[name].grad, leaves[name].grad) < 1e-6, name
    visible = (full["radii"] > 0).all(-1)
    assert 0 < int(visible.sum()) < visible.numel()
    cameras, gaussians = torch.nonzero(visible).unbind(1)
    assert torch.equal(some["camera_ids"], cameras)
    assert torch.equal(some["gaussian_ids"], gaussians)
    assert torch.equal(some["batch_ids"], torch.zeros_like(cameras))
    assert full["gaussian_ids"] is None
    for name in ("means2d", "conics", "depths", "radii", "opacities"):
        assert full[name].shape[:2] == (3, 60), name
        assert torch.equal(some[name], full[name][visible]), name
    assert torch.equal(some["means2d"].grad, full["means2d"].grad[visible])
    assert float(full["means2d"].grad[~visible].abs().max()) == 0
    if absgrad:
        assert torch.equal(some["means2d"].absgrad, full["means2d"].absgrad[visible])
        assert (some["means2d"].absgrad >= some["means2d"].grad.abs() - 1e-5).all()


@pytest.mark.parametrize("packed", [True, False])
def test_batches_are_calls_of_their_own(packed):
    entries = [make(cameras=2, seed=seed) for seed in range(4)]
    single = [{name: value.float() for name, value in entry.items()} for entry in entries]
    batched = {name: torch.stack([entry[name] for entry in single]).unflatten(0, (2, 2)) for name in single[0]}
    backgrounds = torch.rand(2, 2, 2, 3)
    options = {"width": WIDTH, "height": HEIGHT, "packed": packed, "render_mode": "RGB+D"}
    images, alphas, meta = rasterization(**batched, backgrounds=backgrounds, **options)
    assert images.shape == (2, 2, 2, HEIGHT, WIDTH, 4)
    assert (meta["n_batches"], meta["n_cameras"]) == (4, 2)
    means2d = []
    for entry in range(4):
        i, j = divmod(entry, 2)
        expected, expected_alphas, expected_meta = rasterization(**single[entry], backgrounds=backgrounds[i, j], **options)
        assert torch.equal(images[i, j], expected)
        assert torch.equal(alphas[i, j], expected_alphas)
        means2d.append(expected_meta["means2d"])
    if packed:
        assert torch.equal(meta["means2d"], torch.cat(means2d))
        assert torch.equal(meta["batch_ids"], torch.arange(4).repeat_interleave(torch.tensor([len(m) for m in means2d])))
    else:
        assert torch.equal(meta["means2d"], torch.stack(means2d).unflatten(0, (2, 2)))


def test_antialiasing_fades_what_the_blur_made_larger():
    """Against the formula in terms of the 2D covariance, and the oracle."""
    values = make(cameras=1)
    values["scales"][:20] *= 0.05  # far below a pixel
    eps2d = 0.5
    options = {"width": WIDTH, "height": HEIGHT, "rasterize_mode": "antialiased", "eps2d": eps2d, "packed": False}
    expected_leaves, found_leaves = leaves_of(values, torch.float64), leaves_of(values, torch.float32)
    expected, expected_alphas, expected_meta = rasterization(**expected_leaves, **options)
    found, found_alphas, meta = rasterization(**found_leaves, **options)
    visible = (expected_meta["radii"] > 0).all(-1)[0]
    a, b, c = expected_meta["conics"][0].detach().unbind(-1)
    blurred = torch.linalg.inv(torch.stack([a, b, b, c], -1).unflatten(-1, (2, 2)))
    ratio = torch.linalg.det(blurred - eps2d * torch.eye(2)) / torch.linalg.det(blurred)
    rho = expected_meta["opacities"][0] / values["opacities"]
    torch.testing.assert_close(rho[visible], ratio[visible].sqrt(), rtol=1e-6, atol=0)
    faint = values["opacities"] * rho < 1 / 255
    assert bool(faint[:20].any())
    assert not bool(visible[faint].any())
    assert relative(found, expected) < 5e-5
    assert relative(meta["opacities"][0][visible], expected_meta["opacities"][0][visible]) < 5e-5
    functional(expected, expected_alphas).backward()
    functional(found, found_alphas).backward()
    for name in GRADIENTS:
        assert torch.isfinite(found_leaves[name].grad).all(), name
        assert relative(found_leaves[name].grad, expected_leaves[name].grad) < 2e-3, name


@pytest.mark.parametrize("packed", [True, False])
def test_small_gaussians_are_clipped(packed):
    values = {name: value.float() for name, value in make(cameras=1).items()}
    _, _, everything = rasterization(**values, width=WIDTH, height=HEIGHT, packed=False)
    radii = everything["radii"][0]
    clip = float(radii[(radii > 0).all(1)].amax(1).float().median())
    kept = (radii > clip).any(1)
    found, _, meta = rasterization(**values, width=WIDTH, height=HEIGHT, radius_clip=clip, packed=packed)
    some = {name: value if name in ("viewmats", "Ks") else value[kept] for name, value in values.items()}
    expected, _, _ = rasterization(**some, width=WIDTH, height=HEIGHT)
    assert torch.equal(found, expected)
    assert int((meta["radii"] > 0).all(-1).sum()) == int(kept.sum()) < int((radii > 0).all(1).sum())


def test_planes_cull():
    values = {name: value.float() for name, value in make(cameras=1).items()}
    _, _, meta = rasterization(**values, width=WIDTH, height=HEIGHT, near_plane=2.5, far_plane=3.5)
    assert len(meta["depths"]) > 5
    assert float(meta["depths"].min()) > 2.5
    assert float(meta["depths"].max()) < 3.5


@pytest.mark.parametrize(("channels", "piece"), [(1, 64), (3, 64), (10, 64), (7, 3)])
def test_absolute_gradients_are_summed_over_pixels(channels, piece, monkeypatch):
    """Each pixel differentiated on its own, in float64; then the oracle's way and the kernels' way."""
    monkeypatch.setattr(functions, "MAX_CHANNELS", piece)
    values = make(cameras=1, channels=channels, count=12)
    values["opacities"][0] = 1.0  # clamped somewhere
    width, height = 9, 7
    values["Ks"][0, :2, 2] = torch.tensor([4.5, 3.5])
    weights = torch.randn(height, width, channels, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    expected = None
    for dtype, backend in ((torch.float64, "reference"), (torch.float32, "cpu")):
        v = {name: value.to(dtype) for name, value in values.items()}
        projected = project(
            v["means"].requires_grad_(), v["quats"], v["scales"], v["opacities"], v["viewmats"][0], v["Ks"][0], width, height,
            backend=backend,
        )  # fmt: skip
        if expected is None:
            image, _ = blend(projected, v["opacities"], v["colors"], width, height)
            pixels = (image * weights).sum(-1).flatten()
            gradients = [torch.autograd.grad(pixel, projected.means2d, retain_graph=True)[0] for pixel in pixels]
            expected, total = torch.stack(gradients).abs().sum(0), torch.stack(gradients).sum(0)
            assert float(expected.max()) > 0.1
        image, _ = blend(projected, v["opacities"], v["colors"], width, height, absgrad=True)
        projected.means2d.retain_grad()
        (image * weights.to(dtype)).sum().backward()
        tolerance = 1e-9 if dtype == torch.float64 else 2e-5
        assert relative(projected.means2d.absgrad, expected) < tolerance
        assert relative(projected.means2d.grad, total) < tolerance


def test_absolute_gradients_leave_the_others_alone():
    results = []
    for absgrad in (False, True):
        leaves = leaves_of(make(channels=9), torch.float32)
        images, alphas, meta = rasterization(**leaves, width=WIDTH, height=HEIGHT, absgrad=absgrad)
        assert hasattr(meta["means2d"], "absgrad") == absgrad
        functional(images, alphas).backward()
        results.append(leaves)
    for name in GRADIENTS:
        assert relative(results[1][name].grad, results[0][name].grad) < 1e-6, name


@pytest.mark.parametrize("packed", [True, False])
def test_nothing_to_see(packed):
    values = make(cameras=2)
    values["means"][:, 2] = -5
    for some in (values, {name: v if name in ("viewmats", "Ks") else v[:0] for name, v in values.items()}):
        leaves = leaves_of(some, torch.float32)
        backgrounds = torch.tensor([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
        images, alphas, meta = rasterization(
            **leaves, width=WIDTH, height=HEIGHT, packed=packed, backgrounds=backgrounds, render_mode="RGB+ED", absgrad=True
        )
        meta["means2d"].retain_grad()
        images.sum().backward()
        assert torch.equal(images[..., :3], backgrounds[:, None, None].expand(2, HEIGHT, WIDTH, 3))
        assert float(images[..., 3].detach().abs().max()) == 0
        assert float(alphas.detach().abs().max()) == 0
        assert float(meta["means2d"].grad.abs().sum()) == 0
        assert float(meta["means2d"].absgrad.abs().sum()) == 0
        assert len(meta["gaussian_ids"]) == 0 if packed else meta["means2d"].shape[:2] == (2, len(leaves["means"]))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("sparse_grad", True),
        ("distributed", True),
        ("camera_model", "ftheta"),
        ("with_ut", True),
        ("with_eval3d", True),
        ("radial_coeffs", torch.zeros(2, 6)),
        ("tangential_coeffs", torch.zeros(2, 2)),
        ("thin_prism_coeffs", torch.zeros(2, 4)),
        ("ftheta_coeffs", object()),
        ("rolling_shutter", 1),
        ("viewmats_rs", torch.eye(4).expand(2, 4, 4)),
        ("render_mode", "Depth"),
        ("rasterize_mode", "sharp"),
        ("sh_degree", 5),
        ("sh_degree", 1.5),
        ("sh_degree", 1),  # colors are no coefficients
        ("means", torch.zeros(60, 2)),
        ("means", torch.zeros(3)),
        ("quats", torch.zeros(60, 3)),
        ("quats", None),
        ("scales", torch.zeros(59, 3)),
        ("opacities", torch.zeros(60, 1)),
        ("colors", torch.zeros(59, 3)),
        ("colors", torch.zeros(3, 60, 3)),
        ("viewmats", torch.eye(4)),
        ("viewmats", torch.zeros(0, 4, 4)),
        ("Ks", torch.eye(3).expand(3, 3, 3)),
        ("covars", torch.zeros(60, 6)),
        ("backgrounds", torch.zeros(2, 4)),
        ("backgrounds", torch.zeros(3)),
        ("colors", None),
        ("tile_size", 0),
        ("width", torch.tensor([4, 4])),
        ("macro_tile", True),
        ("return_normals", True),
        ("global_z_order", False),
        ("rays", torch.zeros(1)),
        ("lidar_coeffs", object()),
        ("external_distortion_coeffs", object()),
        ("ut_params", object()),
        ("extra_signals", torch.zeros(60, 2)),
        ("extra_signals_sh_degree", 3),
        ("renderer_config", object()),
        ("backend", "cuda"),
    ],
)
def test_bad_arguments_are_named(name, value):
    values = {key: tensor.float() for key, tensor in make().items()}
    named = "colors" if name == "sh_degree" and value == 1 else name
    with pytest.raises(ValueError, match=named):
        rasterization(**{**values, "width": WIDTH, "height": HEIGHT, name: value})


def test_arguments_of_the_next_version_are_taken_at_their_defaults():
    values = {key: tensor.float() for key, tensor in make().items()}
    expected = rasterization(**values, width=WIDTH, height=HEIGHT)[0]
    defaults = {
        "macro_tile": False, "return_normals": False, "global_z_order": True, "rays": None, "lidar_coeffs": None,
        "external_distortion_coeffs": None, "ut_params": None, "extra_signals": None, "extra_signals_sh_degree": None,
        "renderer_config": None, "tile_size": None,
    }  # fmt: skip
    assert torch.equal(rasterization(**values, width=WIDTH, height=HEIGHT, **defaults)[0], expected)


@pytest.mark.parametrize("mode", ["D", "ED"])
def test_depth_alone_needs_no_colors_and_no_background_that_fits(mode):
    values = {key: tensor.float() for key, tensor in make().items()}
    expected = rasterization(**values, width=WIDTH, height=HEIGHT, render_mode=mode)[0]
    for change in ({"colors": None}, {"colors": None, "sh_degree": 2}, {"backgrounds": torch.ones(5)}):
        found = rasterization(**{**values, "width": WIDTH, "height": HEIGHT, "render_mode": mode, **change})[0]
        assert torch.equal(found, expected)
    with pytest.raises(ValueError, match=r"backgrounds must be \[2, 3\]"):
        rasterization(**values, width=WIDTH, height=HEIGHT, render_mode="RGB+D", backgrounds=torch.ones(5))


@pytest.mark.parametrize("number", [torch.tensor, np.int64, np.array])
def test_sizes_are_any_whole_numbers(number):
    values = {key: tensor.float() for key, tensor in make(degree=1).items()}
    expected = rasterization(**values, width=WIDTH, height=HEIGHT, sh_degree=1)[0]
    found, _, meta = rasterization(**values, width=number(WIDTH), height=number(HEIGHT), sh_degree=number(1), tile_size=number(16))
    assert torch.equal(found, expected)
    assert [type(meta[name]) for name in ("width", "height", "tile_size")] == [int] * 3


def test_meta_tells_how_many_tiles_there_are():
    values = {key: tensor.float() for key, tensor in make().items()}
    for tile_size, columns, rows in ((None, 3, 2), (8, 5, 4), (40, 1, 1)):
        meta = rasterization(**values, width=WIDTH, height=HEIGHT, tile_size=tile_size)[2]
        assert (meta["tile_size"], meta["tile_width"], meta["tile_height"]) == (tile_size or 16, columns, rows)


def test_the_upper_triangle_of_covariances_is_read():
    values = leaves_of(make(), torch.float32)
    covars = covariances(values.pop("quats"), values.pop("scales")).detach()
    others = {**values, "quats": None, "scales": None, "width": WIDTH, "height": HEIGHT}
    expected = rasterization(**others, covars=covars)[0]
    lower = torch.ones(3, 3).tril(-1).bool()
    spoiled = torch.where(lower, torch.rand(60, 3, 3), covars).requires_grad_()
    found = rasterization(**others, covars=spoiled)[0]
    assert torch.equal(found, expected)
    functional(found).backward()
    assert float(spoiled.grad[:, lower].abs().max()) == 0
    assert float(spoiled.grad[:, 0, 1].abs().max()) > 0


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_whole_pixels_of_a_radius_decide_what_is_culled(backend):
    """An opaque dot has half widths of 1.82 pixels, which count as 2: gsplat's rule."""
    dtype = torch.float64 if backend == "reference" else torch.float32
    places = [(-1.9, 10), (-2.1, 10), (41.9, 10), (42.1, 10), (20, -1.9), (20, -2.1), (20, 28.9), (20, 29.1)]
    pixels = torch.tensor(places, dtype=dtype)
    means = torch.cat([(pixels - torch.tensor([20, 13.5], dtype=dtype)) / 10, torch.ones(8, 1, dtype=dtype)], 1).requires_grad_()
    images, _, meta = rasterization(
        means, torch.tensor([[1.0, 0, 0, 0]], dtype=dtype).expand(8, 4), torch.full((8, 3), 1e-6, dtype=dtype),
        torch.ones(8, dtype=dtype), torch.ones(8, 3, dtype=dtype), torch.eye(4, dtype=dtype)[None],
        torch.tensor([[[10.0, 0, 20], [0, 10, 13.5], [0, 0, 1]]], dtype=dtype), WIDTH, HEIGHT, packed=False, backend=backend,
    )  # fmt: skip
    assert meta["radii"][0].tolist() == [[2, 2], [0, 0]] * 4
    assert float(images.detach().abs().max()) == 0
    images.sum().backward()
    assert float(means.grad.abs().max()) == 0


def test_coefficients_must_suffice():
    values = {key: tensor.float() for key, tensor in make(degree=1).items()}
    with pytest.raises(ValueError, match=r"colors.*9 or more"):
        rasterization(**values, width=WIDTH, height=HEIGHT, sh_degree=2)


def test_it_comes_without_the_rest_of_the_package():
    code = "import sys, flowsplat; flowsplat.rasterization; print(' '.join(sys.modules))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = {name.split(".")[0] for name in result.stdout.split()}
    assert "torch" in loaded
    assert not loaded & {"av", "cv2", "tyro", "rich", "jinja2", "tensorboard", "gsplat", "scipy"}
    packages = {name.split(".")[1] for name in result.stdout.split() if name.startswith("flowsplat.")}
    assert packages <= {"common", "images", "geometry", "splatting"}
    assert flowsplat.rasterization is rasterization


# --- against gsplat itself -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def gsplat():
    return pytest.importorskip("gsplat")


def test_names_order_and_defaults_are_those_of_gsplat(gsplat):
    theirs = inspect.signature(gsplat.rasterization).parameters
    ours = inspect.signature(rasterization).parameters
    later = list(ours)[len(theirs) :]  # of gsplat's next version, and ours
    assert list(ours) == [*theirs, *later]
    assert all(ours[name].kind == inspect.Parameter.KEYWORD_ONLY for name in later)
    assert later[-1] == "backend"
    for name, parameter in theirs.items():
        assert ours[name].kind == parameter.kind
        if name != "rolling_shutter":
            assert ours[name].default == parameter.default, name
    values = {key: tensor.float() for key, tensor in make().items()}
    default = theirs["rolling_shutter"].default
    rasterization(**values, width=WIDTH, height=HEIGHT, rolling_shutter=default)
    with pytest.raises(ValueError, match="rolling_shutter"):
        rasterization(**values, width=WIDTH, height=HEIGHT, rolling_shutter=type(default).ROLLING_TOP_TO_BOTTOM)


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_projection_is_that_of_gsplat(gsplat, mode):
    from gsplat.cuda._torch_impl import _fully_fused_projection

    values = make(cameras=2, count=200)
    theirs, ours = leaves_of(values, torch.float64), leaves_of(values, torch.float32)
    covars = covariances(theirs["quats"], theirs["scales"])
    radii, means2d, depths, conics, compensations = _fully_fused_projection(
        theirs["means"], covars, theirs["viewmats"], theirs["Ks"], WIDTH, HEIGHT, calc_compensations=True
    )
    assert compensations is not None
    _, _, meta = rasterization(**ours, width=WIDTH, height=HEIGHT, packed=False, rasterize_mode=mode)
    visible = (meta["radii"] > 0).all(-1)
    assert bool((radii[visible] > 0).all())
    assert bool((meta["radii"] <= radii)[visible].all())
    opacities = theirs["opacities"] * (compensations if mode == "antialiased" else torch.ones_like(compensations))
    expected = [x[visible] for x in (means2d, depths, conics, opacities)]
    found = [meta[name][visible] for name in ("means2d", "depths", "conics", "opacities")]
    for a, b in zip(found, expected, strict=True):
        assert relative(a, b) < 1e-5
    functional(*expected).backward()
    functional(*found).backward()
    for name in ("means", "quats", "scales", "opacities", "viewmats"):
        assert relative(ours[name].grad, theirs[name].grad) < 2e-4, name


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_harmonics_are_those_of_gsplat(gsplat, degree):
    from gsplat.cuda._torch_impl import _spherical_harmonics

    g = torch.Generator().manual_seed(4)
    sh, directions = torch.randn(50, 25, 3, generator=g).double(), torch.randn(50, 3, generator=g).double()
    results = []
    for function in (
        lambda s, d: torch.clamp_min(_spherical_harmonics(degree, d, s) + 0.5, 0.0),
        lambda s, d: colors_from_harmonics(s, d, degree),
    ):
        leaves = sh.clone().requires_grad_(), directions.clone().requires_grad_()
        colors = function(*leaves)
        functional(colors).backward()
        slope = leaves[1].grad
        results.append((colors, leaves[0].grad, torch.zeros(50, 3) if slope is None else slope))
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a.double(), b.double(), rtol=1e-6, atol=1e-7)


def test_radii_and_what_is_culled_are_those_of_gsplat(gsplat):
    """Of opaque ones. Its reference reaches to 3.33 sigmas, where alpha is 1/255 at 3.329: some round up differently."""
    from gsplat.cuda._torch_impl import _fully_fused_projection

    values = make(cameras=3, count=3000)
    values["opacities"][:] = 1
    covars = covariances(values["quats"], values["scales"])
    radii, _, _, conics, _ = _fully_fused_projection(values["means"], covars, values["viewmats"], values["Ks"], WIDTH, HEIGHT)
    meta = rasterization(**values, width=WIDTH, height=HEIGHT, packed=False, backend="reference")[2]
    a, b, c = conics.unbind(-1)
    half = 3.33 * torch.sqrt(torch.stack([c, a], -1) / (a * c - b * b)[..., None])
    unclear = (half - 0.001 * half).ceil() != half.ceil()
    clear = ~unclear.any(-1)
    assert float(clear.double().mean()) > 0.9
    assert 0.1 < float((radii[clear] > 0).double().mean()) < 0.9
    assert torch.equal(meta["radii"][clear], radii[clear])

"""What gsplat documents of ``rasterization``, case by case: images, gradients, radii, meta, arguments and what is refused."""

from __future__ import annotations

import inspect
import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from flowsplat.geometry.rotations import covariances
from flowsplat.splatting import rasterization
from flowsplat_benchmarks.scripts.gsplat_parts.reference import Rasterize, rasterize_as_gsplat

WIDTH, HEIGHT = 96, 64
"""Pixels of every image."""
COUNT, CAMERAS = 400, 3
"""Gaussians and cameras."""
IMAGE_TOLERANCE, GRADIENT_TOLERANCE = 1e-5, 5e-4
"""Norm of the difference over the norm, float32 beside the reference in float64. Round numbers, chosen by eye: a rule that differs
(a tile more, another clamp) changes images and gradients by 1e-3 and more, rounding by 1e-6."""
INPUTS = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "covars", "backgrounds")
CAMERA_MODELS, RENDER_MODES = ("pinhole", "ortho", "fisheye"), ("RGB", "D", "ED", "RGB+D", "RGB+ED")
META = (
    "batch_ids", "camera_ids", "gaussian_ids", "radii", "means2d", "depths", "conics", "opacities", "tile_width", "tile_height",
    "tiles_per_gauss", "isect_ids", "flatten_ids", "isect_offsets", "width", "height", "tile_size", "n_batches", "n_cameras",
)  # fmt: skip
"""What gsplat 1.5.3 has in meta."""


# -- inputs and outcomes


def make_inputs(camera_model: str = "pinhole", degree: int | None = None) -> dict[str, Tensor]:
    """Random Gaussians in front of cameras that stand beside each other, in float64 that float32 holds."""
    g = torch.Generator().manual_seed(0)
    means = torch.randn(COUNT, 3, generator=g) * torch.tensor([1.5, 1, 0.5]) + torch.tensor([0, 0, 3.0])
    viewmats = torch.eye(4).repeat(CAMERAS, 1, 1)
    viewmats[:, :3, 3] = 0.3 * torch.randn(CAMERAS, 3, generator=g)
    focal = 25.0 if camera_model == "ortho" else 70.0
    values = {
        "means": means,
        "quats": torch.randn(COUNT, 4, generator=g),
        "scales": torch.exp(0.5 * torch.randn(COUNT, 3, generator=g) - 2.5),
        "opacities": torch.rand(COUNT, generator=g),
        "colors": torch.rand(COUNT, 3, generator=g) if degree is None else torch.randn(COUNT, (degree + 1) ** 2, 3, generator=g),
        "viewmats": viewmats,
        "Ks": torch.tensor([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]]).repeat(CAMERAS, 1, 1),
    }
    return {name: value.double() for name, value in values.items()}


@dataclass(frozen=True)
class Outcome:
    """Of one rendering: images and alphas, and the gradients of a fixed random function of them, by the input."""

    values: Tensor
    gradients: dict[str, Tensor]


def render(draw: Rasterize, values: dict[str, Tensor], dtype: torch.dtype, **options: Any) -> Outcome:
    """Render and differentiate."""
    leaves = {name: value.detach().clone().to(dtype).requires_grad_() for name, value in values.items()}
    given = dict.fromkeys(("quats", "scales")) | leaves
    images, alphas, _ = draw(**given, width=WIDTH, height=HEIGHT, **options)
    result = torch.cat([images, alphas], -1)
    weights = torch.randn(result.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(dtype)
    (result * weights).sum().backward()
    gradients = {name: leaf.grad.double() for name, leaf in leaves.items() if leaf.grad is not None}
    gradients["Ks"] *= torch.tensor([[1.0, 0, 1], [0, 1, 1], [0, 0, 0]])  # its pinhole has a skew, too
    if "covars" in gradients:
        gradients["covars"] = gradients["covars"] + gradients["covars"].mT  # of a symmetric matrix, either half may have it
    return Outcome(result.detach().double(), gradients)


def relative(found: Tensor, expected: Tensor) -> float:
    """Return the norm of the difference over the norm."""
    return float((found - expected).norm() / expected.norm().clamp(min=1e-30))


@dataclass(frozen=True)
class Distance:
    """From the reference in float64: of images and alphas, and of the gradient that is farthest off."""

    image: float
    gradient: float

    @classmethod
    def of(cls, found: Outcome, exact: Outcome) -> Distance:
        """Compare what both have."""
        worst = max(
            relative(found.gradients.get(name, torch.zeros_like(expected)), expected)
            for name, expected in exact.gradients.items()
            if expected.any()
        )
        return cls(relative(found.values, exact.values), worst)


# -- the cases


def _variants() -> Iterator[tuple[str, dict[str, Tensor], dict[str, Any]]]:
    """What is drawn: a name of the kind, inputs, and options that both take."""
    for camera_model, mode in itertools.product(CAMERA_MODELS, RENDER_MODES):
        yield "camera models and render modes", make_inputs(camera_model), {"camera_model": camera_model, "render_mode": mode}
    for degree, mode in itertools.product(range(5), ("RGB", "RGB+ED")):
        yield "spherical harmonics of degree 0 to 4", make_inputs(degree=degree), {"sh_degree": degree, "render_mode": mode}
    values, g = make_inputs(), torch.Generator().manual_seed(2)
    for channels in (1, 2, 5, 33):
        colors = torch.rand(COUNT, channels, generator=g).double()
        yield "channels: 1, 2, 5, 33", values | {"colors": colors}, {}
    yield "colors of each camera", values | {"colors": torch.rand(CAMERAS, COUNT, 3, generator=g).double()}, {}
    for mode in RENDER_MODES[:1] + RENDER_MODES[3:]:
        yield "backgrounds", values | {"backgrounds": torch.rand(CAMERAS, 3, generator=g).double()}, {"render_mode": mode}
    without = {name: value for name, value in values.items() if name not in ("quats", "scales")}
    matrices = covariances(values["quats"], values["scales"]).float().double()
    for camera_model in CAMERA_MODELS[:2]:
        focal = {"Ks": make_inputs(camera_model)["Ks"]}
        yield "covars", without | focal | {"covars": matrices}, {"camera_model": camera_model}
    for camera_model in CAMERA_MODELS:
        yield "antialiased", make_inputs(camera_model), {"rasterize_mode": "antialiased", "camera_model": camera_model}
    yield "near_plane, far_plane, eps2d", values, {"near_plane": 2.5}
    yield "near_plane, far_plane, eps2d", values, {"far_plane": 3.0}
    yield "near_plane, far_plane, eps2d", values, {"eps2d": 1.0}


def check_drawing() -> Iterator[tuple[str, bool]]:
    """Images and gradients of every variant, packed and not."""
    for name, values, options in _variants():
        exact = render(rasterize_as_gsplat, values, torch.float64, **options)
        for packed in (True, False):
            far = Distance.of(render(rasterization, values, torch.float32, packed=packed, **options), exact)
            yield f"images and gradients: {name}", far.image <= IMAGE_TOLERANCE
            yield f"images and gradients: {name}", far.gradient <= GRADIENT_TOLERANCE


def check_absolute_gradients() -> Iterator[tuple[str, bool]]:
    """``absgrad``: the sums over pixels of the absolute gradients of ``means2d``, packed and not."""
    found = []
    values = make_inputs()
    runs: list[tuple[Rasterize, torch.dtype, dict[str, Any]]] = [
        (rasterize_as_gsplat, torch.float64, {}), (rasterization, torch.float32, {"packed": False}),
        (rasterization, torch.float32, {"packed": True}),
    ]  # fmt: skip
    for draw, dtype, options in runs:
        leaves = {name: value.to(dtype).requires_grad_() for name, value in values.items()}
        images, _, meta = draw(**leaves, width=WIDTH, height=HEIGHT, absgrad=True, **options)
        images.square().sum().backward()
        sums = meta["means2d"].absgrad.double()
        if options.get("packed"):
            full = torch.zeros(CAMERAS, COUNT, 2, dtype=torch.float64)
            full[meta["camera_ids"], meta["gaussian_ids"]] = sums
            sums = full
        found.append(sums)
    for sums in found[1:]:
        yield "absgrad", relative(sums, found[0]) <= GRADIENT_TOLERANCE


def _project(values: dict[str, Tensor], camera_model: str) -> tuple[Tensor, ...]:
    """Radii by the rule of gsplat's kernels, and its own torch functions' means2d, depths and conics.

    Those torch functions know no opacities and reach to 3.33 sigmas; the kernels no farther than to where alpha is 1/255.
    """
    from gsplat.cuda._torch_impl import _fully_fused_projection

    matrices = covariances(values["quats"], values["scales"])
    _, means2d, depths, conics, _ = _fully_fused_projection(
        values["means"], matrices, values["viewmats"], values["Ks"], WIDTH, HEIGHT, camera_model=camera_model
    )
    a, b, c = conics.unbind(-1)
    sigmas = (2 * torch.log(255 * values["opacities"]).clamp(min=0)).sqrt().clamp(max=3.33)
    radii = (sigmas[:, None] * (torch.stack([c, a], -1) / (a * c - b * b)[..., None]).sqrt()).ceil()
    inside = (means2d + radii > 0) & (means2d - radii < torch.tensor([WIDTH, HEIGHT]))
    seen = inside.all(-1) & (depths > 0.01) & (values["opacities"] >= 1 / 255)
    return torch.where(seen[..., None], radii, 0).int(), means2d, depths, conics


def _draw(values: dict[str, Tensor], **options: Any) -> Any:
    single: dict[str, Any] = {name: value.float() for name, value in values.items()}
    return rasterization(**single, width=WIDTH, height=HEIGHT, **options)


def check_projection() -> Iterator[tuple[str, bool]]:
    """Radii and what is culled, Gaussian by Gaussian; ``radius_clip``; what meta has of them."""
    for camera_model in CAMERA_MODELS:
        values = make_inputs(camera_model)
        radii, means2d, depths, conics = _project(values, camera_model)
        meta = _draw(values, packed=False, camera_model=camera_model)[2]
        yield from (
            ("which Gaussians are culled", each) for each in ((meta["radii"] > 0) == (radii > 0)).all(-1).flatten().tolist()
        )
        yield from (("radii, to the pixel", each) for each in (meta["radii"] == radii).all(-1).flatten().tolist())
        seen = (radii > 0).all(-1)
        for name, expected in (("means2d", means2d), ("depths", depths), ("conics", conics)):
            yield "means2d, depths and conics in meta", relative(meta[name][seen].double(), expected[seen]) <= IMAGE_TOLERANCE
        clipped = _draw(values, packed=False, camera_model=camera_model, radius_clip=6.0)[2]["radii"]
        yield "radius_clip", bool(((clipped > 0).all(-1) == (seen & (radii > 6).any(-1))).all())


def check_names_and_shapes() -> Iterator[tuple[str, bool]]:
    """Names and shapes: meta, batches, arguments and their defaults, and that what is not covered is refused by its name."""
    import gsplat

    values = make_inputs()
    meta = _draw(values)[2]
    for name in META:
        yield "names in meta", name in meta
    for batch, packed in itertools.product(((), (2,), (2, 2)), (True, False)):
        many = {name: value.expand(*batch, *value.shape) for name, value in values.items()}
        colors, alphas, meta = _draw(many, packed=packed)
        shape = (*batch, CAMERAS, HEIGHT, WIDTH)
        rows = meta["gaussian_ids"].shape if packed else (*batch, CAMERAS, COUNT)
        yield (
            "shapes of results and meta, with batches and without",
            colors.shape == (*shape, 3) and alphas.shape == (*shape, 1) and meta["means2d"].shape == (*rows, 2),
        )
    theirs, ours = (inspect.signature(each).parameters for each in (gsplat.rasterization, rasterization))
    for name, parameter in theirs.items():
        yield "arguments by name", name in ours
        same = name == "rolling_shutter" or (name in ours and ours[name].default == parameter.default)
        yield "defaults of arguments", same
    asked: dict[str, Any] = {
        "sparse_grad": True, "distributed": True, "camera_model": "ftheta", "with_ut": True, "with_eval3d": True,
        "tangential_coeffs": torch.zeros(CAMERAS, 2), "thin_prism_coeffs": torch.zeros(CAMERAS, 4), "ftheta_coeffs": object(),
        "rolling_shutter": object(), "viewmats_rs": values["viewmats"].float(), "radial_coeffs": torch.zeros(CAMERAS, 6),
    }  # fmt: skip
    for name, value in asked.items():
        yield "what is not covered is refused by its name", _refuses(values, name, value)


def _refuses(values: dict[str, Tensor], name: str, value: Any) -> bool:
    """Return whether this argument raises a ValueError that names it."""
    try:
        _draw(values, **{name: value})
    except ValueError as error:
        return name in str(error)
    return False


def compare_rounding() -> Iterator[tuple[str, Distance, Distance]]:
    """How far the kernels (float32) are from the reference in float64, and the reference in float32."""
    cases: list[tuple[str, dict[str, Any]]] = [
        ("pinhole", {}), ("orthographic", {"camera_model": "ortho"}), ("fisheye", {"camera_model": "fisheye"}),
        *((f"harmonics of degree {degree}", {"sh_degree": degree}) for degree in range(5)),
    ]  # fmt: skip
    for name, options in cases:
        values = make_inputs(options.get("camera_model", "pinhole"), options.get("sh_degree"))
        exact = render(rasterize_as_gsplat, values, torch.float64, **options)
        single = (render(draw, values, torch.float32, **options) for draw in (rasterization, rasterize_as_gsplat))
        kernels, reference = (Distance.of(found, exact) for found in single)
        yield name, kernels, reference

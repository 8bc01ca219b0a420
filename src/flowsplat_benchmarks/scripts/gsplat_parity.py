"""What of gsplat's public behavior ``flowsplat.rasterization`` has, against gsplat's own torch reference, on the CPU.

    python -m flowsplat_benchmarks.scripts.gsplat_parity                          # prints two tables; gsplat must be installed
    python -m flowsplat_benchmarks.scripts.gsplat_parity --docs docs/gsplat.md    # also puts them there, between its two marks

The first table is of values and gradients: random Gaussians in front of several cameras, and how far off the kernels (float32) are
from the reference in float64, beside how far the reference itself is in float32. Images are blended by the sum over all Gaussians
at every pixel, written here, since gsplat's own needs nerfacc. The second is of trainings: gsplat's strategies, unchanged, on an
image, with the kernels and with the reference.
"""

from __future__ import annotations

import argparse
import inspect
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from flowsplat import gsplat_ops
from flowsplat.common.errors import InputError
from flowsplat.common.files import read_text, write_text
from flowsplat.geometry.rotations import covariances
from flowsplat.splatting import rasterization
from flowsplat.splatting.rules import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from flowsplat_benchmarks.tables import format_table

WIDTH, HEIGHT = 96, 64
"""Pixels of every image."""
COUNT, CAMERAS = 400, 3
"""Gaussians and cameras of the first table."""
STEPS, START = 300, 300
"""Of a training: steps, and Gaussians at its beginning."""
MARKS = "<!-- measured: begin -->", "<!-- measured: end -->"
"""What stands around the tables in the docs."""
RATES = {"means": 2e-3, "scales": 1e-2, "quats": 1e-2, "opacities": 5e-2, "colors": 2.5e-2}
"""Learning rates of the trainings."""
INPUTS = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks")
Rasterize = Callable[..., tuple[Tensor, Tensor, dict[str, Any]]]
StrategyName = Literal["DefaultStrategy", "DefaultStrategy, absgrad", "MCMCStrategy"]


# -- the reference


def rasterize_as_gsplat(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, viewmats: Tensor, Ks: Tensor, width: int,
    height: int, *, absgrad: bool = False, camera_model: str = "pinhole", sh_degree: int | None = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:  # fmt: skip
    """As gsplat's ``rasterization`` of RGB, from its torch functions for what belongs to Gaussians, in any float type."""
    from gsplat.cuda import _torch_impl

    radii, means2d, depths, conics, _ = _torch_impl._fully_fused_projection(
        means, covariances(quats, scales), viewmats, Ks, width, height, camera_model=camera_model
    )
    info = {"means2d": means2d, "radii": radii, "width": width, "height": height, "n_cameras": len(viewmats), "gaussian_ids": None}
    if absgrad:
        means2d.absgrad = torch.zeros_like(means2d)
    images, alphas = [], []
    for c, viewmat in enumerate(viewmats):
        color = colors
        if sh_degree is not None:
            directions = means - torch.linalg.inv(viewmat)[:3, 3]
            color = (_torch_impl._spherical_harmonics(sh_degree, directions, colors) + 0.5).clamp(min=0)
        absolute = means2d.absgrad[c] if absgrad else None
        image, alpha = _blend(means2d[c], conics[c], depths[c], radii[c], opacities, color, width, height, absolute)
        images.append(image)
        alphas.append(alpha)
    return torch.stack(images), torch.stack(alphas), info


def _blend(
    means2d: Tensor, conics: Tensor, depths: Tensor, radii: Tensor, opacities: Tensor, colors: Tensor, width: int, height: int,
    absolute: Tensor | None,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Alpha compositing of 3D Gaussian Splatting, all pixels and Gaussians at once: [H, W, 3] and [H, W, 1]."""
    order = torch.nonzero((radii > 0).all(-1)).squeeze(1)
    order = order[depths[order].argsort(stable=True)]
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack([x, y], -1).reshape(-1, 1, 2).to(means2d)
    centers = means2d[order].expand(len(pixels), -1, -1)
    if absolute is not None and centers.requires_grad:

        def add_absolute(gradient: Tensor) -> None:
            absolute.index_add_(0, order, gradient.abs().sum(0))

        centers.register_hook(add_absolute)
    dx, dy = (pixels - centers).unbind(-1)
    a, b, c = conics[order].unbind(-1)
    alpha = (opacities[order] * torch.exp(-(0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy))).clamp(max=ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, torch.zeros_like(alpha))
    alpha = torch.where((1 - alpha).cumprod(1) > TRANSMITTANCE_MIN, alpha, torch.zeros_like(alpha))
    after = (1 - alpha).cumprod(1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], 1)
    image = (alpha * before) @ colors[order]
    return image.reshape(height, width, 3), (1 - after[:, -1:]).reshape(height, width, 1)


# -- values and gradients


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
    images, alphas, _ = draw(**leaves, width=WIDTH, height=HEIGHT, **options)
    result = torch.cat([images, alphas], -1)
    weights = torch.randn(result.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(dtype)
    (result * weights).sum().backward()
    gradients = {name: leaf.grad.double() for name, leaf in leaves.items() if leaf.grad is not None}
    gradients["Ks"] *= torch.tensor([[1.0, 0, 1], [0, 1, 1], [0, 0, 0]])  # its pinhole has a skew, too
    return Outcome(result.detach().double(), gradients)


def _relative(found: Tensor, expected: Tensor) -> float:
    return float((found - expected).norm() / expected.norm())


def compare_values() -> list[tuple[str, ...]]:
    """Return rows: what, the distance of the kernels' image and gradients from float64, and that of the reference in float32."""
    rows = []
    cases: Sequence[tuple[str, dict[str, Any]]] = (
        ("pinhole", {}), ("orthographic", {"camera_model": "ortho"}), ("fisheye", {"camera_model": "fisheye"}),
        *((f"harmonics of degree {degree}", {"sh_degree": degree}) for degree in range(5)),
    )  # fmt: skip
    for name, options in cases:
        values = make_inputs(options.get("camera_model", "pinhole"), options.get("sh_degree"))
        exact = render(rasterize_as_gsplat, values, torch.float64, **options)
        off = []
        for draw in (rasterization, rasterize_as_gsplat):
            found = render(draw, values, torch.float32, **options)
            worst = max(_relative(found.gradients[each], exact.gradients[each]) for each in INPUTS if each in exact.gradients)
            off += [f"{_relative(found.values, exact.values):.1e}", f"{worst:.1e}"]
        rows.append((name, *off))
    return rows


def compare_culling() -> str:
    """Return how many of the opaque Gaussians have the radii of gsplat's reference, and are culled as there, in a sentence."""
    from gsplat.cuda._torch_impl import _fully_fused_projection

    values = make_inputs()
    values["opacities"][:] = 1
    expected = _fully_fused_projection(
        values["means"], covariances(values["quats"], values["scales"]), values["viewmats"], values["Ks"], WIDTH, HEIGHT
    )[0]
    single: dict[str, Any] = {name: value.float() for name, value in values.items()}
    found = rasterization(**single, width=WIDTH, height=HEIGHT, packed=False)[2]["radii"]
    same, culled = (found == expected).all(-1), ((found > 0) == (expected > 0)).all(-1)
    return (
        f"Of {same.numel():,} opaque Gaussians {int(same.sum()):,} have its radii, and {int(culled.sum()):,} are culled as there."
    )


def compare_arguments() -> str:
    """Return how many of the arguments of the installed gsplat's ``rasterization`` are there, with its defaults, in a sentence."""
    import gsplat

    theirs, ours = (inspect.signature(each).parameters for each in (gsplat.rasterization, rasterization))
    there = [name for name in theirs if name in ours]
    same = [name for name in there if name == "rolling_shutter" or ours[name].default == theirs[name].default]
    return f"Of the {len(theirs)} arguments of gsplat {gsplat.__version__} {len(there)} are there, {len(same)} with its defaults."


# -- trainings


def draw_target() -> Tensor:
    """[H, W, 3]: rings that get finer outwards, a weave, wavy stripes."""
    y, x = torch.meshgrid((torch.arange(HEIGHT) + 0.5) / HEIGHT, (torch.arange(WIDTH) + 0.5) / HEIGHT, indexing="ij")
    u, v = 0.8 * x + 0.6 * y, 0.8 * y - 0.6 * x
    rings, weave = torch.sin(60 * ((x - 0.6) ** 2 + (y - 0.4) ** 2)), torch.sin(20 * u) * torch.sin(27 * v)
    return 0.5 + 0.4 * torch.stack([rings, weave, torch.sin(45 * v + 4 * torch.sin(7 * u))], -1)


def train(draw: Rasterize, strategy_name: StrategyName, steps: int = STEPS) -> tuple[float, int, float]:
    """Fit the image with one of gsplat's strategies. Returns PSNR in dB, Gaussians at the end, and seconds."""
    from gsplat.strategy import DefaultStrategy, MCMCStrategy

    torch.manual_seed(0)
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
    when = {"refine_start_iter": steps // 4, "refine_every": steps // 10}
    strategy: Any = (
        MCMCStrategy(cap_max=2 * START, noise_lr=1e3, **when)
        if is_mcmc
        else DefaultStrategy(absgrad=absgrad, grow_grad2d=5e-3 if absgrad else 1e-3, **when)
    )
    strategy.check_sanity(params, optimizers)
    state, options = strategy.initialize_state(), {"packed": False} if draw is rasterization else {}
    began = time.perf_counter()
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
    return -10 * error, len(params["means"]), time.perf_counter() - began


def compare_trainings(steps: int = STEPS) -> list[tuple[str, ...]]:
    """Return rows: a strategy, PSNR, Gaussians and seconds with the kernels, and with the reference."""
    rows = []
    names: Sequence[StrategyName] = ("DefaultStrategy", "DefaultStrategy, absgrad", "MCMCStrategy")
    train(rasterization, names[0], min(steps, 20))  # compiles
    train(rasterization, names[1], min(steps, 20))
    for name in names:
        cells = []
        for draw in (rasterization, rasterize_as_gsplat):
            psnr, count, seconds = train(draw, name, steps)
            cells += [f"{psnr:.2f}", str(count), f"{seconds:.1f}"]
        rows.append((name, *cells))
    return rows


def format_results(steps: int = STEPS) -> str:
    """Return both tables as Markdown."""
    values = format_table(
        ["from float64, relative", "kernels: image", "kernels: worst gradient", "reference: image", "reference: worst gradient"],
        compare_values(),
    )
    trainings = format_table(
        [f"{steps} steps, {START} Gaussians at first", "kernels: dB", "Gaussians", "s", "reference: dB", "Gaussians", "s"],
        compare_trainings(steps),
    )
    return "\n".join([compare_arguments(), compare_culling(), "", *values, "", *trainings])


def put_between_marks(page: str, found: str) -> str:
    """Return a page with other tables.

    Raises:
        InputError: the page has not both marks, once each and in their order.
    """
    before, begin, rest = page.partition(MARKS[0])
    _, end, after = rest.partition(MARKS[1])
    if not begin or not end:
        raise InputError(f"The page has no place for the tables: it needs {MARKS[0]} and, further down, {MARKS[1]}.")
    return f"{before}{begin}\n{found}\n{end}{after}"


def main() -> None:
    """Measure, print, and write where that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--docs", type=Path, help="page to put the tables into")
    options = parser.parse_args()
    try:
        gsplat_ops.install()
    except ImportError as error:
        raise InputError("gsplat is not installed: pip install gsplat (it needs no GPU for this).") from error
    found = format_results()
    print(found)
    if options.docs:
        write_text(options.docs, put_between_marks(read_text(options.docs), found))


if __name__ == "__main__":
    main()

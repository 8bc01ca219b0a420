"""Train a static scene from COLMAP on the CPU: our rasterizer, gsplat's strategy, plain torch.

    python examples/06_train_static.py MODEL IMAGES [--masks MASKS] [--steps 3000] [--size 480] [--strategy mcmc] [-o OUT]

MODEL is a COLMAP text model with pinhole cameras (``colmap model_converter --output_type TXT``, or ``flowsplat export RUN --to
colmap``), IMAGES the folder that the names in it begin in. Images in a folder ``heldout`` (where the export has those of a
clip) are held out, or every eighth where there is none. MASKS has files with the names of the images, in the same folders or in
none: where one is not black, something moves, and the pixel counts neither in training nor in PSNR.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from scipy.spatial import KDTree

from flowsplat import gsplat_ops, rasterization
from flowsplat.geometry.rotations import quats_to_rotations
from flowsplat.output.export.formats.ply import write_ply
from flowsplat.output.export.still import Still

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("model", type=Path)
parser.add_argument("images", type=Path)
parser.add_argument("--masks", type=Path)
parser.add_argument("--steps", type=int, default=3000)
parser.add_argument("--size", type=int, default=480, help="pixels of the longer side of the images")
parser.add_argument("--strategy", choices=["default", "mcmc", "none"], default="default")
parser.add_argument("-o", "--out", type=Path, default=Path("out/examples"))
options = parser.parse_args()
torch.manual_seed(0)


def rows_of(name: str, words: int = 0) -> list[list[str]]:
    """Words of every line that is no comment; of so many the last may have spaces."""
    lines = (options.model / name).read_text(encoding="utf-8").splitlines()
    return [line.strip().split(maxsplit=words - 1) for line in lines if not line.startswith("#")]


# Cameras: width, height, fx, fy, cx, cy. Images: every second line holds points, which nobody needs here.
lenses = {}
for number, kind, *values in filter(None, rows_of("cameras.txt")):
    numbers = [float(value) for value in values]
    if kind not in ("PINHOLE", "SIMPLE_PINHOLE"):
        raise SystemExit(f"Cameras must be pinholes, not {kind}: undistort the images (colmap image_undistorter).")
    lenses[number] = numbers if kind == "PINHOLE" else [*numbers[:3], *numbers[2:]]
View = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]  # image, which pixels count, viewmat, K
views: list[View] = []
apart: list[bool] = []
for _, *pose, lens, name in sorted((row for row in rows_of("images.txt", 10)[::2] if row), key=lambda row: row[-1]):
    width, height, fx, fy, cx, cy = lenses[lens]
    image = cv2.imread(str(options.images / name))
    if image is None:
        raise SystemExit(f"{options.images / name} cannot be read.")
    factor = min(options.size / max(width, height), 1)
    size = round(factor * width), round(factor * height)
    image = cv2.resize(image[..., ::-1], size, interpolation=cv2.INTER_AREA)
    counts = torch.ones(size[1], size[0], 1)
    if options.masks:
        mask = options.masks / name
        mask = mask if mask.exists() else options.masks / mask.name
        if mask.exists() and (moving := cv2.imread(str(mask), cv2.IMREAD_GRAYSCALE)) is not None:
            counts[torch.from_numpy(cv2.resize(moving, size, interpolation=cv2.INTER_NEAREST) > 0)] = 0
    viewmat = torch.eye(4)
    viewmat[:3, :3] = quats_to_rotations(torch.tensor([float(value) for value in pose[:4]]))
    viewmat[:3, 3] = torch.tensor([float(value) for value in pose[4:7]])
    across, down = size[0] / width, size[1] / height  # not factor: the size is rounded
    K = torch.tensor([[across * fx, 0, across * cx], [0, down * fy, down * cy], [0, 0, 1]])
    views.append((torch.from_numpy(image / np.float32(255)), counts, viewmat, K))
    apart.append("heldout" in Path(name).parts)
if not any(apart):
    apart = [k % 8 == 7 for k in range(len(views))]
heldout, training = ([view for view, is_apart in zip(views, apart, strict=True) if is_apart is kind] for kind in (True, False))

# One Gaussian a point, as large as the mean distance to its three nearest neighbors.
points = np.array([row[1:7] for row in rows_of("points3D.txt") if row], np.float32)
means, colors = torch.from_numpy(points[:, :3]), torch.from_numpy(points[:, 3:] / 255)
spacing = torch.from_numpy(KDTree(points[:, :3]).query(points[:, :3], 4)[0][:, 1:].mean(1)).float().clamp(min=1e-6)
centers = torch.stack([-viewmat[:3, :3].T @ viewmat[:3, 3] for _, _, viewmat, _ in training])
extent = float((centers - centers.mean(0)).norm(dim=1).max().clamp(min=0.01))
params = torch.nn.ParameterDict(
    {
        "means": means,
        "scales": spacing.log()[:, None].repeat(1, 3),
        "quats": torch.randn(len(means), 4),
        "opacities": torch.full((len(means),), 0.1).logit(),
        "sh0": ((colors - 0.5) / 0.28209479)[:, None],
        "shN": torch.zeros(len(means), 3, 3),
    }
)
distance = float((means - centers[0]).norm(dim=1).median())
rates = {"means": 1.6e-4 * distance, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 1.25e-4}
optimizers = {name: torch.optim.Adam([params[name]], lr=rate, eps=1e-15) for name, rate in rates.items()}
slowing = torch.optim.lr_scheduler.ExponentialLR(optimizers["means"], 0.01 ** (1 / options.steps))

strategy: Any = None
steps = options.steps
if options.strategy != "none":
    try:
        gsplat_ops.install()  # gsplat's own need a GPU
        from gsplat.strategy import DefaultStrategy, MCMCStrategy

        when = {"refine_start_iter": steps // 10, "refine_stop_iter": steps // 2, "refine_every": max(steps // 60, 1)}
        if options.strategy == "mcmc":
            strategy = MCMCStrategy(cap_max=2 * len(means), **when)
        else:
            strategy = DefaultStrategy(reset_every=steps, **when)
        state = strategy.initialize_state(**({} if options.strategy == "mcmc" else {"scene_scale": extent}))
        strategy.check_sanity(params, optimizers)
    except ImportError:
        print("gsplat is not installed: the number of Gaussians stays as it is")


def render(view: View) -> tuple[torch.Tensor, dict[str, Any]]:
    """The image that a view sees, and what rasterization knows of it."""
    image, _, viewmat, K = view
    images, _, info = rasterization(
        params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid(),
        torch.cat([params["sh0"], params["shN"]], 1), viewmat[None], K[None], image.shape[1], image.shape[0], sh_degree=1,
    )  # fmt: skip
    return images[0], info


@torch.no_grad()
def measure(some: list[View]) -> float:
    """PSNR in dB over all pixels that count."""
    errors = torch.stack([((render(view)[0].clamp(0, 1) - view[0]) ** 2 * view[1]).sum() for view in some])
    counts = torch.stack([3 * view[1].sum() for view in some])
    return float(-10 * torch.log10(errors.sum() / counts.sum()))


began = time.perf_counter()
for step in range(steps):
    if not step % len(training):
        order = torch.randperm(len(training))
    view = training[order[step % len(training)]]
    image, info = render(view)
    if strategy and options.strategy == "default":
        strategy.step_pre_backward(params, optimizers, state, step, info)
    ((image - view[0]).abs() * view[1]).mean().backward()
    for optimizer in optimizers.values():
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
    if strategy:
        last = {"lr": slowing.get_last_lr()[0]} if options.strategy == "mcmc" else {"packed": True}
        strategy.step_post_backward(params, optimizers, state, step, info, **last)
    slowing.step()
    if (step + 1) % max(steps // 5, 1) == 0:
        psnr = f"PSNR {measure(training[:8]):.2f} dB" + (f", held out {measure(heldout):.2f} dB" if heldout else "")
        print(f"step {step + 1}: {len(params['means'])} Gaussians, {psnr}, {time.perf_counter() - began:.0f} s")

p = {name: value.detach() for name, value in params.items()}
still = Still(
    p["means"], torch.nn.functional.normalize(p["quats"], dim=-1), p["scales"], p["opacities"].sigmoid(),
    torch.cat([p["sh0"], p["shN"]], 1), torch.zeros(len(p["means"]), dtype=torch.uint8), None,
)  # fmt: skip
write_ply(options.out / "06_static.ply", still, has_objects=False)
print(f"flowsplat view {options.out / '06_static.ply'} shows it")

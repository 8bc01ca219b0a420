"""By how much the images of a clip change with what is stored of each Gaussian: what matters little may be rounded coarsely."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from flowsplat.common.progress import spinner
from flowsplat.common.spread import spread
from flowsplat.gaussians.flow import blend_features
from flowsplat.gaussians.gaussians4d import NEAR_PLANE, Gaussians4D
from flowsplat.gaussians.slicing import slice_gaussians
from flowsplat.gaussians.slicing.reference import time_gains
from flowsplat.gaussians.slopes import image_slopes
from flowsplat.geometry import Camera
from flowsplat.splatting import blend, project
from flowsplat.splatting.harmonics import harmonics_basis, harmonics_count

MAX_VIEWS = 12
"""Images that are looked at. Chosen by eye."""


@dataclass(frozen=True)
class Sensitivity:
    """What images change by.

    Attributes:
        sums: [N, components] by the name of a parameter: sums of the squares of the derivatives of all numbers of the images. Of
            motion it is that of a shift, and of a turn, that does not change in time.
        numbers: how many numbers (three a pixel) the images have.
    """

    sums: dict[str, Tensor]
    numbers: int


def measure_sensitivity(gaussians: Gaussians4D, views: Sequence[tuple[Camera, float]]) -> Sensitivity:
    """Estimate it for at most ``MAX_VIEWS`` of the images, evenly chosen.

    The sum of squared derivatives dI/dx over the numbers I of an image is the mean of (d(s . I)/dx)^2 over images s of random signs
    (Hutchinson's estimate of a trace, https://doi.org/10.1080/03610919008812866), of which one is taken for every view. A
    Gaussian alone has it with an error of its own size; neighbors, which share their steps, have a mean.

    Args:
        gaussians: the model.
        views: (camera in normalized coordinates, clip time).
    """
    count, coefficients = len(gaussians), harmonics_count(gaussians.sh_degree)
    widths = {
        "means": 3, "quats": 4, "logScales": 3, "opacities": 1, "colors": 3, "harmonics": 3 * (coefficients - 1),
        "slopes": 2, "gains": gaussians.config.gains, "times": 1, "logLambdas": 1,
    }  # fmt: skip
    sums = {name: torch.zeros(count, width) for name, width in widths.items()}
    generator, numbers = torch.Generator().manual_seed(0), 0
    with spinner("Looking what matters"):
        for k in spread(len(views), MAX_VIEWS):
            for name, (rows, values) in _measure_view(gaussians, *views[k], generator).items():
                sums[name].index_add_(0, rows, values)
            numbers += 3 * views[k][0].width * views[k][0].height
    return Sensitivity(sums, numbers)


def _measure_view(gaussians: Gaussians4D, camera: Camera, t: float, generator: torch.Generator) -> dict[str, tuple[Tensor, Tensor]]:
    """Return of one image, by name, rows [A] and what is to be added there [A, components]."""
    active = gaussians.active(t, camera)
    center = torch.as_tensor(camera.center, dtype=torch.float32)
    with torch.no_grad():
        sliced = slice_gaussians(gaussians, active, center)
    quats, log_scales = sliced.decompose()
    given = [sliced.means, quats, log_scales, sliced.opacities, sliced.colors]
    leaves = [value.detach().clone().requires_grad_() for value in given]
    means, quats, log_scales, opacities, colors = leaves
    slopes = None if sliced.slopes is None else sliced.slopes.detach().clone().requires_grad_()
    size = camera.width, camera.height
    changed = replace(
        sliced,
        means=means,
        quats=quats,
        scales=torch.exp(log_scales),
        covars=None,
        opacities=opacities,
        colors=colors,
        slopes=slopes,
    )
    projected = project(means, quats, changed.scales, opacities, *camera.tensors(), *size, near_plane=NEAR_PLANE)
    features = blend_features(changed, projected, camera, None)
    image = blend(projected, opacities, features, *size, slopes=image_slopes(changed, projected, camera))[0][..., :3]
    signs = 2 * torch.randint(0, 2, image.shape, generator=generator, dtype=torch.int8) - 1
    image.backward(signs.to(image))

    def of(leaf: Tensor) -> Tensor:
        return torch.zeros_like(leaf) if leaf.grad is None else leaf.grad

    rows, n, params = active.rows, active.num_static, gaussians.params
    with torch.no_grad():
        by_opacity, by_color = of(opacities), of(colors)
        stored = torch.sigmoid(params["logit_opacities"][rows]).clamp(min=1e-6)
        # Colors are what harmonics say times the brightness at the time.
        cosines = [math.cos(math.pi * k * t) for k in range(1, gaussians.config.gains + 1)]
        gain = torch.ones(len(rows))
        if cosines:
            gain[:n] = time_gains(params["log_gains"][rows[:n]], t)
        degree = gaussians.sh_degree
        basis = harmonics_basis(torch.nn.functional.normalize(sliced.means - center, dim=-1), degree)
        by_sh = (gain[:, None] * by_color)[:, None] * basis[..., None]  # [A, K, 3]
        found = {
            "means": (rows, of(means)), "quats": (rows, of(quats)), "logScales": (rows, of(log_scales)),
            "opacities": (rows, (by_opacity * sliced.opacities / stored)[:, None]), "colors": (rows, by_sh[:, 0]),
            "harmonics": (rows, by_sh[:, 1:].flatten(1)),
        }  # fmt: skip
        if slopes is not None:
            found["slopes"] = (rows, of(slopes))
        if cosines:
            by_gain = (by_color * sliced.colors).sum(1)[:n]
            found["gains"] = (rows[:n], by_gain[:, None] * torch.tensor(cosines))
        moving = rows[n:]
        chosen = {name: value[moving] for name, value in params.items()}
        precision, since = torch.exp(gaussians.motion.log_precision(chosen)), t - chosen["times"]
        by_presence = (by_opacity * sliced.opacities)[n:]
        found["times"] = (moving, (by_presence * precision * since)[:, None])
        found["logLambdas"] = (moving, (by_presence * precision * since**2 / 2)[:, None])
    return {name: (index, values**2) for name, (index, values) in found.items()}

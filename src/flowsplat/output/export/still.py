"""The scene at one time as plain 3D Gaussians, in the coordinates of its cameras: what the formats of others can hold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.slicing import slice_gaussians
from flowsplat.gaussians.slicing.reference import time_gains
from flowsplat.geometry.rotations import multiply_quats, rotations_to_quats
from flowsplat.splatting.harmonics import harmonics_basis, harmonics_count
from flowsplat.splatting.rules import C0

FLIP_AXES = torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
"""Half a turn about x: y down and z forward become y up and z backward."""
_OPACITY_MARGIN = 1e-6
"""Opacities are kept this far from 0 and 1, where their logit ends."""


@dataclass(frozen=True)
class Still:
    """A Gaussians.

    Attributes:
        means: [A, 3] in the units of the scene's cameras.
        quats: [A, 4] unit, wxyz.
        log_scales: [A, 3]
        opacities: [A] presence at the time included.
        sh: [A, K, 3] harmonics, brightness at the time included.
        object_ids: [A] uint8 number of the object that each belongs to; 0 = of none.
        seen: [A, 2] what the clip has seen of each (``Gaussians4D.seen``); None = not known.
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    opacities: Tensor
    sh: Tensor
    object_ids: Tensor
    seen: Tensor | None

    @property
    def logit_opacities(self) -> Tensor:
        """[A] opacities before the sigmoid."""
        return torch.logit(self.opacities.clamp(_OPACITY_MARGIN, 1 - _OPACITY_MARGIN))

    @property
    def colors(self) -> Tensor:
        """[A, 3] of degree 0, between 0 and 1."""
        return (C0 * self.sh[:, 0] + 0.5).clamp(0, 1)


@torch.no_grad()
def still_at(model: SceneModel, seconds: float, *, flip_axes: bool = False) -> Still:
    """Return what is there at a time of the clip.

    Args:
        model: the scene.
        seconds: of the clip.
        flip_axes: turn y up and z backward, for viewers that show scenes with y down upside down.
    """
    gaussians = model.gaussians
    active = gaussians.active(model.clip_time(seconds))
    sliced = slice_gaussians(gaussians, active, torch.zeros(3))
    quats, log_scales = sliced.decompose()
    sh = gaussians.params["sh"][active.rows][:, : harmonics_count(gaussians.sh_degree)].clone()
    if gaussians.config.gains and active.num_static:
        gains = time_gains(gaussians.params["log_gains"][active.rows[: active.num_static]], active.t)
        # gain * (basis . sh + 0.5) as harmonics again
        sh[: active.num_static] *= gains[:, None, None]
        sh[: active.num_static, 0] += (0.5 * (gains - 1) / C0)[:, None]
    undo = model.similarity.inverse()
    means = torch.from_numpy(undo.points(sliced.means.double().numpy()))
    rotation = torch.from_numpy(undo.rotation)
    if flip_axes:
        rotation, means = FLIP_AXES.double() @ rotation, means @ FLIP_AXES.double().T
    turn = rotations_to_quats(rotation)
    return Still(
        means.float(),
        multiply_quats(turn.float().expand_as(quats), quats),
        log_scales + float(np.log(undo.scale)),
        sliced.opacities,
        rotate_harmonics(sh, rotation),
        gaussians.object_ids[active.rows],
        None if gaussians.seen is None else gaussians.seen[active.rows],
    )


def middle_or(model: SceneModel, seconds: float | None) -> float:
    """Return these seconds of the clip, its middle where there are none."""
    return (model.first + model.last) / 2 if seconds is None else seconds


def rotate_harmonics(sh: Tensor, rotation: Tensor) -> Tensor:
    """Return harmonics [A, K, 3] of Gaussians that are turned by ``rotation`` [3, 3]: seen along R d they look as before along
    d."""
    degree = int(sh.shape[1] ** 0.5) - 1
    if degree == 0 or torch.equal(rotation, torch.eye(3).to(rotation)):
        return sh
    directions = torch.randn(64, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    directions = directions / directions.norm(dim=1, keepdim=True)
    before, after = harmonics_basis(directions, degree), harmonics_basis(directions @ rotation.double().T, degree)
    change = torch.linalg.lstsq(after, before).solution  # exact: a turn mixes harmonics of one degree among themselves
    return torch.einsum("kj,njc->nkc", change.to(sh), sh)

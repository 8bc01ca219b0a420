"""Frames to look at, one after the other: forward only, in buffers of a fixed size, on a GPU as one CUDA graph.

Launching the few dozen kernels of a frame takes the host longer than a GPU takes to run them; a graph is one launch. In it nothing
may depend on numbers that only the device knows, so there are more rows than active Gaussians, and those that are padding
are Gaussians of opacity 0. What is needed is counted: where the buffers are too small they grow, and the frame is drawn again.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from flowsplat.common.devices import upload
from flowsplat.common.triton import device_of
from flowsplat.gaussians.camera_buffer import CAMERA, camera_numbers, camera_tensors, count_moment_numbers, pack_moment
from flowsplat.gaussians.culling import RowCapacity, border
from flowsplat.gaussians.culling.triton import Marked
from flowsplat.gaussians.flow.triton.displacement import compute_displacement_features
from flowsplat.gaussians.gaussians4d import NEAR_PLANE, Gaussians4D
from flowsplat.gaussians.slicing.triton import slice_rows
from flowsplat.gaussians.slopes.reference import project_slopes
from flowsplat.geometry import Camera
from flowsplat.splatting import Projected, blend, project
from flowsplat.splatting.rules import EPS2D
from flowsplat.splatting.triton.tiles import PairCapacity


class FixedRenderer:
    """Draws Gaussians with a series motion in images of one size; flow is the displacement's.

    Attributes:
        captures: how often its graph was made, or would have been: once, and once more whenever a buffer grew.
    """

    def __init__(self, gaussians: Gaussians4D, width: int, height: int, with_flow: bool, eps2d: float = EPS2D):
        self._gaussians, self._eps2d, self._size, self._with_flow = gaussians, eps2d, (width, height), with_flow
        device = gaussians.device
        self._border = border(eps2d)
        self._inside = torch.tensor([[0.0, 0, self._border], [0, 0, self._border], [0, 0, 0]], device=device)
        sizes = [CAMERA.value, count_moment_numbers(gaussians.config.gains), CAMERA.value]
        self._numbers = torch.zeros(sum(sizes), device=device)
        self._widened, self._moment, self._other = self._numbers.split(sizes)
        self._rows, self._pairs = RowCapacity(), PairCapacity(device)
        self._graph: torch.cuda.CUDAGraph | None = None
        self._shown: tuple[Tensor, Tensor, Tensor] | None = None
        self.captures = 0

    @torch.no_grad()
    def render(self, camera: Camera, t: float, flow_to: tuple[Camera, float] | None = None) -> tuple[Tensor, Tensor]:
        """Image [H, W, 4] of color and depth, or [H, W, 7] with flow and what the other camera does not see; alpha [H, W].

        Premultiplied; both are drawn over by the next frame.

        Args:
            camera: of the size of the images, in normalized coordinates.
            t: clip time.
            flow_to: the other camera and clip time, if there is to be flow.
        """
        if (camera.width, camera.height) != self._size or (flow_to is not None) != self._with_flow:
            raise ValueError(f"this renders images of {self._size}, {'with' if self._with_flow else 'without'} flow")
        other, later = flow_to or (camera, None)
        moment = pack_moment(self._gaussians.config.gains, t, camera.center, later)
        widened, seen_from = camera_numbers(camera.widen(self._border), other)
        numbers = np.concatenate([widened, moment, seen_from])
        self._numbers.copy_(upload(numbers.astype(np.float32), self._numbers.device))
        while True:
            with device_of(self._numbers):
                image, alpha, needed = self._replay()
            found = needed.tolist()
            if self._rows.fits(found) and not self._pairs.has_overflowed():
                return image, alpha
            self._rows.grow(found)
            if self._pairs.has_overflowed():
                self._pairs.grow()
            self._graph = self._shown = None

    def _replay(self) -> tuple[Tensor, Tensor, Tensor]:
        """Draw; on a GPU by the graph, which is made where there is none."""
        if self._graph is not None and self._shown is not None:
            self._graph.replay()
            return self._shown
        drawn = self._draw()
        if self._shown is None:
            self.captures += 1
        if not self._numbers.is_cuda:
            self._shown = drawn
            return drawn
        # Drawn once outside, so that every kernel is compiled; capturing runs nothing.
        torch.cuda.synchronize(self._numbers.device)
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph, capture_error_mode="thread_local"):
            self._shown = self._draw()
        self._graph.replay()
        return self._shown

    def _draw(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return everything that the device does for a frame; and how many Gaussians at rest and moving there were [2]."""
        g, (width, height) = self._gaussians, self._size
        p = g.params
        given = (g.at_rest, p["means"], p["log_scales"], p["times"], p["log_lambdas"], self._widened, self._moment)
        widened = width + 2 * self._border, height + 2 * self._border
        marked = Marked(*given, g.config.p_min, widened, NEAR_PLANE)
        rows, resting = marked.pad(self._rows), self._rows.at_rest
        means, quats, scales, opacities, colors, _, next_means, _ = slice_rows(g, rows, resting, self._moment, self._with_flow)
        viewmat, K = camera_tensors(self._widened)
        projected: Projected = project(
            means,
            quats,
            scales,
            opacities,
            viewmat,
            K - self._inside,
            width,
            height,
            near_plane=NEAR_PLANE,
            eps2d=self._eps2d,
            backend="triton",
        )
        if self._with_flow:
            features = compute_displacement_features(colors, projected.depths, projected.means2d, next_means, self._other)
        else:
            features = torch.cat([colors, projected.depths[:, None]], 1)
        slopes = None
        if g.has_slopes:
            slopes = project_slopes(p["slopes"][rows], projected, means, quats, scales, viewmat, K - self._inside, width, height)
        with self._pairs.fix():
            image, alpha = blend(projected, opacities, features, width, height, slopes=slopes)
        return image, alpha, marked.ends[:, -1]

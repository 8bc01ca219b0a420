"""Frames of the 4D scene on a GPU: every stage forward, the gradient, and gsplat on the same Gaussians."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from flowsplat.gaussians.cuda_graph import FixedRenderer
from flowsplat.gaussians.flow import FlowView, blend_features
from flowsplat.gaussians.gaussians4d import NEAR_PLANE, Gaussians4D
from flowsplat.gaussians.render import render_active
from flowsplat.gaussians.slicing import slice_gaussians
from flowsplat.splatting import Projected, blend, project
from flowsplat.training.config import PRESETS
from flowsplat_benchmarks.scripts.cpu_parts import scene
from flowsplat_benchmarks.scripts.cpu_parts.floor import backward_flops, count_pairs, forward_flops
from flowsplat_benchmarks.scripts.cpu_parts.timing import replace_attribute, significant
from flowsplat_benchmarks.scripts.cpu_parts.work_load import work_load
from flowsplat_benchmarks.scripts.gpu_parts.machine import device, forget_peak, milliseconds, peak_gib

GAUSSIANS = 196_000
"""As many as the paper's scenes have on NVIDIA's rig (docs/method/evaluation.md)."""
REST_SHARE = 0.3571
"""Of the Gaussians; with it 91,000 of 196,000 are active in a frame."""
SIZES = {"480x270": (480, 270), "854x480": (854, 480), "1920x1080": (1920, 1080)}
WAYS = {3: None, 6: "displacement", 10: "affine"}
"""By channels: colors alone, with depth and displacement flow, with depth and affine flow."""


def gaussians(count: int, width: int, height: int) -> Gaussians4D:
    """Return the scene on the GPU."""
    with replace_attribute(scene, "BACKGROUND_SHARE", REST_SHARE):
        return scene.gaussians(PRESETS["default"].model, count, width, height).to(device())


class Frames:
    """One image of the scene, over and over."""

    def __init__(self, model: Gaussians4D, width: int, height: int, channels: int):
        self.model, self.channels, self.size = model, channels, (width, height)
        self.camera, self.other = scene.cameras(work_load(1, width, height))[:2]
        self.active = model.active(0.0, self.camera)
        self.center = torch.as_tensor(self.camera.center, dtype=torch.float32)
        self.view = self.camera.tensors(device=device())
        flow = WAYS[channels]
        self.flow = None if flow is None else FlowView(flow, self.other, 1 / (scene.FRAMES - 1))  # type: ignore[arg-type]
        self.sliced = self._slice()
        self.projected = self._project()
        self.features = self._features()

    def _slice(self) -> Any:
        return slice_gaussians(self.model, self.active, self.center, None if self.flow is None else self.flow.dt)

    def _project(self) -> Projected:
        g = self.sliced
        return project(g.means, g.quats, g.scales, g.opacities, *self.view, *self.size, near_plane=NEAR_PLANE)

    def _features(self) -> Tensor:
        if self.flow is None:
            return self.sliced.colors
        return blend_features(self.sliced, self.projected, self.camera, self.flow)

    def _blend(self) -> tuple[Tensor, Tensor]:
        return blend(self.projected, self.sliced.opacities, self.features, *self.size)

    @torch.no_grad()
    def forward(self) -> None:
        """A whole frame without gradients."""
        self.active = self.model.active(0.0, self.camera)
        self.sliced = self._slice()
        self.projected = self._project()
        self.features = self._features()
        self._blend()

    def forward_and_backward(self) -> None:
        """A whole frame with the gradients of all parameters."""
        frame = render_active(
            self.model, self.model.active(0.0, self.camera), self.camera,
            flow_to=None if self.flow is None else (self.other, self.flow.dt), flow_model=self.flow.model if self.flow else "mean",
            gradients={},
        )  # fmt: skip
        torch.autograd.backward([frame.image, frame.alpha], [torch.ones_like(frame.image), torch.ones_like(frame.alpha)])

    def measure(self, limits: dict[str, float], repeat: int) -> dict[str, Any]:
        """Milliseconds by stage, of whole frames, and their distance from what the card could do at least."""
        with torch.no_grad():
            jobs: dict[str, Callable[[], object]] = {
                "cull": lambda: self.model.active(0.0, self.camera), "slice": self._slice, "project": self._project,
                "features": self._features, "blend": self._blend,
            }  # fmt: skip
            stages = {name: milliseconds(job, repeat) for name, job in jobs.items()}
        forget_peak()
        forward = milliseconds(self.forward, repeat)
        both = milliseconds(self.forward_and_backward, repeat)
        p = self.projected
        on_host = replace(p, means2d=p.means2d.cpu(), conics=p.conics.cpu(), radii=p.radii.cpu())
        pairs = count_pairs(on_host, self.sliced.opacities.cpu().numpy(), *self.size).pairs
        moved = self._bytes()
        floors = {
            way: 1e3 * max(pairs * flops / limits["flops_per_second"], moved / limits["copy_bytes_per_second"])
            for way, flops in (("forward", forward_flops(self.channels)), ("backward", backward_flops(self.channels)))
        }
        return {
            "active": len(self.active.rows), "total": len(self.model), "stages": stages, "forward": forward,
            "frames_per_second": significant(1e3 / forward["median_ms"]), "forward_and_backward": both,
            "graph": self._by_graph(repeat),
            "pairs": pairs, "bytes": moved, "floor_ms": {way: significant(value) for way, value in floors.items()},
            "forward_ratio": significant(forward["min_ms"] / floors["forward"]),
            "peak_memory_gib": peak_gib(),
        }  # fmt: skip

    def _by_graph(self, repeat: int) -> dict[str, float] | None:
        """Return a frame by a CUDA graph, until the host knows that its buffers sufficed; depth is always drawn. Not for affine
        flow."""
        if self.flow is not None and self.flow.model != "displacement":
            return None
        renderer = FixedRenderer(self.model, *self.size, self.flow is not None)
        flow_to = None if self.flow is None else (self.other, self.flow.dt)
        return milliseconds(lambda: renderer.render(self.camera, 0.0, flow_to), repeat)

    def _bytes(self) -> int:
        """Return what must at least be read and written once: active parameters, what the rasterizer gets of them, the image."""
        params = sum(len(self.model.rows_of(name, self.active)) * value[0].nbytes for name, value in self.model.params.items())
        g = self.sliced
        between = sum(value.nbytes for value in (g.means, g.quats, g.scales, g.opacities, self.features))
        return params + 2 * between + 4 * self.size[0] * self.size[1] * (self.channels + 1)

    def compare_with_gsplat(self, repeat: int) -> dict[str, Any] | str:
        """Splatting the same Gaussians by gsplat; or why that cannot be."""
        try:
            from gsplat import rasterization
        except Exception as error:  # a missing package, or one that was built for something else
            return f"gsplat cannot be imported: {error}"
        g = self.sliced
        leaves = [value.detach().clone().requires_grad_() for value in (g.means, g.quats, g.scales, g.opacities, self.features)]
        width, height = self.size

        def ours() -> Tensor:
            means, quats, scales, opacities, features = leaves
            projected = project(means, quats, scales, opacities, *self.view, width, height, near_plane=NEAR_PLANE)
            return blend(projected, opacities, features, width, height)[0]

        def theirs() -> Tensor:
            means, quats, scales, opacities, features = leaves
            return rasterization(
                means, quats, scales, opacities, features, self.view[0][None], self.view[1][None], width, height,
                near_plane=NEAR_PLANE, packed=False,
            )[0][0]  # fmt: skip

        def differentiated(draw: Callable[[], Tensor]) -> None:
            image = draw()
            image.backward(torch.ones_like(image))

        result: dict[str, Any] = {}
        try:
            for name, draw in (("flowsplat", ours), ("gsplat", theirs)):
                with torch.no_grad():
                    forward = milliseconds(draw, repeat)
                result[name] = {"forward": forward, "both": milliseconds(lambda draw=draw: differentiated(draw), repeat)}  # type: ignore[misc]
        except Exception as error:  # gsplat compiles its extension at first use
            return f"gsplat does not work here: {str(error).splitlines()[0]}"
        ratios = {way: result["gsplat"][way]["min_ms"] / result["flowsplat"][way]["min_ms"] for way in ("forward", "both")}
        return {**result, "ratio": {way: significant(value) for way, value in ratios.items()}}


def growth(counts: tuple[int, ...], repeat: int, size: tuple[int, int] = (854, 480)) -> dict[str, Any]:
    """Return frames with six channels, of ever more Gaussians, ever smaller in the image's area."""
    result = {}
    for count in counts:
        forget_peak()
        frames = Frames(gaussians(count, *size), *size, 6)
        both = milliseconds(frames.forward_and_backward, repeat)
        result[f"{count:,}"] = {
            "active": len(frames.active.rows), "forward": milliseconds(frames.forward, repeat), "forward_and_backward": both,
            "peak_memory_gib": peak_gib(),
        }  # fmt: skip
    return result

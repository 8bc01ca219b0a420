"""A trained 4D scene as a person uses it: cameras of the prepared scene, seconds, plain arrays."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, SupportsFloat

import numpy as np
import torch
from torch import Tensor

from flowsplat.common.errors import InputError
from flowsplat.common.threads import thread_count
from flowsplat.gaussians.arguments import check_camera, check_target, check_time
from flowsplat.gaussians.confidence_fade import apply_confidence_fade
from flowsplat.gaussians.distances import Distances, check_factors
from flowsplat.gaussians.flow import FlowModel
from flowsplat.gaussians.gaussians4d import Gaussians4D
from flowsplat.gaussians.render import fill_uncovered, render
from flowsplat.gaussians.renderer import Part, Renderer, Rendering, numbers_of
from flowsplat.gaussians.shadow_free import without_shadows
from flowsplat.geometry import Camera, Similarity
from flowsplat.geometry.paths import CameraPath
from flowsplat.images.html import THUMBNAIL_WIDTH, format_facts
from flowsplat.splatting.api import BackendName
from flowsplat.splatting.rules import EPS2D

_BLUR_STEPS = 16
"""Steps of the blur's width between pixels as in training and twice as fine."""
MAX_CONCURRENT_RENDERS = 4
"""Images that are rendered at the same time at most: each holds memory of its own. Chosen by eye."""
_MAX_GRAPHS = 4
"""Sizes of images whose graphs are kept; each has buffers of its own. Chosen by eye."""


@dataclass
class SceneModel:
    """Gaussians together with where and when they are: the internal normalization of space and time is hidden.

    Attributes:
        gaussians: in normalized coordinates.
        similarity: scene to normalized coordinates.
        first: seconds of the first frame.
        last: seconds of the last frame.
        flow_model: how flow is splatted.
        fill: whether uncovered pixels are filled from their neighbors.
        focal: focal length in pixels of the images that it was trained on; 0 = not known. Where pixels are finer than those
            were, the rasterizer's blur grows with the image (``blur``).
        backend: of the rasterizer.
        graphs: whether a GPU draws by CUDA graphs, one for every size of image: for many frames one after the other.
        distances: of objects that are shown elsewhere than they were trained (``at_distances``). Rendering knows them, nothing
            else.
        confidence_fade: the clip's cameras by clip time, in normalized coordinates, where what they tell too little of fades
            (``fade_by_confidence``); None = nothing does.
        viewpoint: a (camera, seconds) that notebooks show it from: those of the middle of the clip, where ``load`` finds them.
    """

    gaussians: Gaussians4D
    similarity: Similarity
    first: float
    last: float
    flow_model: FlowModel = "displacement"
    fill: bool = True
    focal: float = 0.0
    backend: BackendName = "auto"
    graphs: bool = False
    distances: Distances | None = None
    confidence_fade: CameraPath | None = None
    viewpoint: tuple[Camera, float] | None = None
    _drawn_by: dict[tuple[int, int, bool, float], Any] = field(init=False, default_factory=dict, repr=False, compare=False)

    def __repr__(self) -> str:
        g, moving = self.gaussians, int(self.gaussians.dynamic.sum())
        seconds = f"{self.first:.3g} to {self.last:.3g} s"
        return f"SceneModel({len(g):,} Gaussians, {moving:,} of them moving, {seconds}, on {g.device})"

    def _repr_html_(self) -> str:
        """For notebooks: an image from the middle of the clip where its camera is known (``viewpoint``), and a few numbers."""
        facts = {
            "Gaussians": f"{len(self.gaussians):,}",
            "moving": f"{int(self.gaussians.dynamic.sum()):,}",
            "objects": str(len(self.gaussians.object_counts)),
            "time": f"{self.first:.3g} to {self.last:.3g} s",
            "device": str(self.gaussians.device),
        }
        return format_facts("SceneModel", facts, self.thumbnail())

    def thumbnail(self) -> np.ndarray | None:
        """Return [H, W, 3] what ``viewpoint`` sees, at most as wide as notebooks show it; None where that is not known."""
        if self.viewpoint is None:
            return None
        camera, t = self.viewpoint
        factor = min(1.0, THUMBNAIL_WIDTH / camera.width)
        size = [max(round(side * factor), 1) for side in (camera.width, camera.height)]
        return self.render(camera.resize(*size), t).color

    def to(self, device: torch.device | str) -> SceneModel:
        """Return the same scene on a device, where it is rendered from then on; images are arrays as before."""
        return replace(self, gaussians=self.gaussians.to(device))

    def clip_time(self, t: float) -> float:
        """Return seconds to clip units."""
        return (t - self.first) / (self.last - self.first)

    def blur(self, camera: Camera) -> float:
        """Variance in px^2 that the rasterizer adds to every Gaussian (``eps2d``).

        Training knows Gaussians only together with its blur, so it belongs to what they look like: with pixels a third as wide
        the same blur is three pixels wide, or the gaps between the Gaussians would show (as in Mip-Splatting,
        https://arxiv.org/abs/2311.16493). Only the focal length counts: from farther off with a longer lens (a dolly zoom) that is
        more blur than needed, and from nearer less. In steps, because a CUDA graph holds one.
        """
        finer = round(_BLUR_STEPS * camera.K[0, 0] / self.focal) / _BLUR_STEPS if self.focal > 0 else 1.0
        return EPS2D * max(finer, 1.0) ** 2

    def render(
        self, camera: Camera, t: SupportsFloat, flow_to: tuple[Camera, SupportsFloat] | None = None
    ) -> Rendering:  # fmt: skip
        """Render the scene from a camera at a time.

        Args:
            camera: in the coordinates of the prepared scene's cameras (``Scene.cameras``); its size is the image's size.
            t: seconds of the clip, between ``first`` and ``last``; any number of Python, NumPy or torch.
            flow_to: the other (camera, seconds) that optical flow goes to; None = none is rendered.

        Returns:
            NumPy float32 arrays: color [H, W, 3], alpha [H, W], depth [H, W] and, with ``flow_to``, flow [H, W, 2].

        Raises:
            InputError: an argument is not what it has to be, or a time is outside the clip.

        Examples:
            >>> run = flowsplat.Run("out/clip")
            >>> camera = run.scene.cameras[5]
            >>> rendering = run.model.render(camera, t=0.8, flow_to=(camera, 0.9))
            >>> rendering
            Rendering(64x48, with flow)
            >>> rendering.color.shape, rendering.flow.shape, rendering.depth.dtype
            ((48, 64, 3), (48, 64, 2), dtype('float32'))
            >>> run.model.render(camera, t=9)
            Traceback (most recent call last):
            flowsplat.common.errors.InputError: t is 9 s, outside the clip (0 to 1.83333 s).
        """
        camera, t = check_camera(camera), check_time(t, self.first, self.last)
        target = check_target(flow_to, self.first, self.last)
        other = None if target is None else (self.similarity.camera(target[0]), self.clip_time(target[1]))
        image, alpha, flow = (
            None if plane is None else plane.float().cpu().numpy() for plane in self._draw(self.similarity.camera(camera), t, other)
        )
        assert image is not None
        assert alpha is not None
        color = np.ascontiguousarray(image[..., :3])
        if self.fill:
            color = fill_uncovered(color, alpha)
        divisor = np.maximum(alpha, 1e-6)
        return Rendering(
            color=np.clip(color, 0, 1),
            alpha=alpha,
            depth=image[..., 3] / divisor / np.float32(self.similarity.scale),
            flow=None if flow is None else flow / divisor[..., None],
        )

    def _draw(self, camera: Camera, t: float, other: tuple[Camera, float] | None) -> tuple[Tensor, Tensor, Tensor | None]:
        """Image with color and depth, alpha and flow, premultiplied; cameras in normalized coordinates, ``t`` in seconds."""
        g = self.gaussians_for(camera, self.clip_time(t))
        if (
            self.graphs and g is self.gaussians and g.sliced_by == "triton" and self.distances is None
            and (other is None or self.flow_model == "displacement")
        ):  # fmt: skip
            from flowsplat.gaussians.cuda_graph import FixedRenderer

            key = (camera.width, camera.height, other is not None, self.blur(camera))
            if key not in self._drawn_by:
                while len(self._drawn_by) >= _MAX_GRAPHS:
                    del self._drawn_by[next(iter(self._drawn_by))]
                self._drawn_by[key] = FixedRenderer(g, *key)
            image, alpha = self._drawn_by[key].render(camera, self.clip_time(t), other)
            return image, alpha, None if other is None else image[..., 4:6]
        frame = render(
            g, camera, self.clip_time(t), flow_to=other, flow_model=self.flow_model, eps2d=self.blur(camera), backend=self.backend,
            distances=self.distances,
        )  # fmt: skip
        return frame.image, frame.alpha, frame.flow

    def gaussians_for(self, camera: Camera, t: float) -> Gaussians4D:
        """Return the Gaussians as ``camera`` is shown them at clip time ``t``: all of them, unless guesses fade."""
        if self.confidence_fade is None:
            return self.gaussians
        return apply_confidence_fade(self.gaussians, camera.center, self.confidence_fade.at(t).center)

    def part(self, part: Part) -> SceneModel:
        """Return the same scene with one part of it only; uncovered pixels of objects alone are not filled but stay black.

        ``objects`` is what moves; ``background`` is as bright as it is without the shadows that these throw. An object that is
        named by its number has all that belongs to it, what of it rests as well.

        Args:
            part: ``all``, ``background``, ``objects``, or some of these by their numbers, as in ``objects:2`` or ``objects:1,3``.

        Raises:
            InputError: there is no such part.

        Examples:
            >>> model = flowsplat.load("out/clip")
            >>> len(model.part("objects").gaussians) + len(model.part("background").gaussians) == len(model.gaussians)
            True
        """
        if part == "all":
            return self
        numbers, dynamic = numbers_of(part), self.gaussians.dynamic
        if numbers is not None:
            self.require_objects(numbers)
            chosen = torch.isin(self.gaussians.object_ids, self.gaussians.object_ids.new_tensor(numbers))
        else:
            chosen = dynamic if part == "objects" else ~dynamic
        rows = torch.nonzero(chosen).squeeze(1)
        gaussians = self.gaussians.select(rows)
        if part == "background":
            gaussians = without_shadows(gaussians)
        return replace(self, gaussians=gaussians, fill=self.fill and part == "background")

    def at_distances(self, factors: Mapping[int, float], times: Sequence[float], cameras: Sequence[Camera]) -> SceneModel:
        """Return the same scene with some objects farther away, or nearer; in the clip's own views they look the same.

        Args:
            factors: by the number of the object, how many times as far away from the clip's camera as it was trained.
            times: [T] seconds of the clip's frames (``Scene.timestamps``).
            cameras: [T] its cameras (``Scene.cameras``).

        Raises:
            InputError: there is no such object, or a factor is none.
        """
        self.require_objects(factors)
        check_factors(factors)
        changed = {number: float(factor) for number, factor in factors.items() if factor != 1}
        return replace(self, distances=Distances(changed, self.clip_path(times, cameras)) if changed else None)

    def fade_by_confidence(self, times: Sequence[float], cameras: Sequence[Camera]) -> SceneModel:
        """Return the same scene in which what the clip tells too little of fades, the further a view is from the clip's own.

        Uncovered pixels stay black.

        Args:
            times: [T] seconds of the clip's frames (``Scene.timestamps``).
            cameras: [T] its cameras (``Scene.cameras``).

        Raises:
            InputError: it is not known what the clip has seen.
        """
        if self.gaussians.seen is None:
            raise InputError("It is not known what the clip has seen of this scene: it was trained by an earlier flowsplat.")
        return replace(self, confidence_fade=self.clip_path(times, cameras), fill=False)

    def clip_path(self, times: Sequence[float], cameras: Sequence[Camera]) -> CameraPath:
        """Return the clip's cameras [T] at seconds [T] as a path in clip time and normalized coordinates."""
        return CameraPath([self.clip_time(t) for t in times], [self.similarity.camera(camera) for camera in cameras])

    def require_objects(self, numbers: Iterable[int]) -> None:
        """Refuse numbers that no object has.

        Raises:
            InputError: names the first of them, and those that there are.
        """
        known = self.gaussians.object_counts
        for number in numbers:
            if number not in known:
                there_are = f"there are {', '.join(map(str, known))}" if known else "none of its Gaussians belongs to an object"
                raise InputError(f"The trained scene has no object {number}: {there_are}.")

    def active_count(self, t: float) -> int:
        """Return how many Gaussians are there at ``t`` seconds, whether a camera sees them or not."""
        return len(self.gaussians.active(self.clip_time(t)).rows)


def at_once(renderer: Renderer) -> int:
    """Return how many images of a scene may be rendered at the same time, by as many Python threads (``common.threads``)."""
    on_cpu = isinstance(renderer, SceneModel) and renderer.gaussians.device.type == "cpu"
    return min(thread_count(), MAX_CONCURRENT_RENDERS) if on_cpu else 1

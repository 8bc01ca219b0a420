"""gsplat's ``rasterization`` on the CPU, so that its users change one import: ``from flowsplat import rasterization``.

A thin layer over ``project`` and ``blend``, one camera after the other. Names, shapes, defaults and return values are those of
gsplat 1.5 (https://docs.gsplat.studio/main/apis/rasterization.html), and by name those that its next version adds; what is not
covered raises a ValueError that names the argument.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import torch
from torch import Tensor

from flowsplat.splatting.api import BackendName, Projected, blend, check_finite, project
from flowsplat.splatting.arguments import Array, check_numbers, to_pixels, to_tensors
from flowsplat.splatting.camera_models import CAMERA_MODELS, FISHEYE_COEFFICIENTS, CameraModel
from flowsplat.splatting.harmonics import MAX_DEGREE, colors_from_harmonics, harmonics_count
from flowsplat.splatting.rules import EPS2D, FAR_PLANE, NEAR_PLANE

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]
_TILE_SIZE = 16
"""Pixels. gsplat's default."""
_GEOMETRY = ("means2d", "conics", "depths", "radii")
"""Of a projection, what is in meta."""
# Below this the compensated opacity is under 1/255 whatever it was: nothing is drawn, and a root has no slope at 0.
_MIN_RATIO = 1e-8
"""Ratio of determinants, at least, so that its root has a gradient. Chosen by eye."""


def rasterization(
    means: Array,
    quats: Array | None,
    scales: Array | None,
    opacities: Array,
    colors: Array | None,
    viewmats: Array,
    Ks: Array,
    width: int,
    height: int,
    near_plane: float = NEAR_PLANE,
    far_plane: float = FAR_PLANE,
    radius_clip: float = 0.0,
    eps2d: float = EPS2D,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int | None = _TILE_SIZE,
    backgrounds: Array | None = None,
    render_mode: RenderMode = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: Array | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: Array | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: Any = None,
    rolling_shutter: Any = None,
    viewmats_rs: Tensor | None = None,
    *,
    macro_tile: bool = False,
    return_normals: bool = False,
    global_z_order: bool = True,
    rays: Tensor | None = None,
    lidar_coeffs: Any = None,
    external_distortion_coeffs: Any = None,
    ut_params: Any = None,
    extra_signals: Tensor | None = None,
    extra_signals_sh_degree: int | None = None,
    renderer_config: Any = None,
    backend: BackendName = "auto",
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render N Gaussians into C cameras, differentiable in everything (``Ks`` too). Leading ``...`` are batch dimensions.

    Tensors are of one float type and on one device. NumPy arrays are taken in their place, as float32 where all are arrays.

    Args:
        means: [..., N, 3] world.
        quats: [..., N, 4] wxyz, any length; ignored with ``covars``.
        scales: [..., N, 3] standard deviations; ignored with ``covars``.
        opacities: [..., N] between 0 and 1.
        colors: [..., (C,) N, D] colors or any features; with ``sh_degree`` [..., (C,) N, K, 3] harmonics coefficients. None where
            ``render_mode`` asks for depth alone.
        viewmats: [..., C, 4, 4] world to camera, OpenCV axes.
        Ks: [..., C, 3, 3] pixels; the center of the top-left pixel is (0.5, 0.5). Of ``ortho``, pixels for one unit of length.
        width: pixels.
        height: pixels.
        near_plane: Gaussians nearer are culled.
        far_plane: Gaussians farther are culled.
        radius_clip: Gaussians whose half width and half height in pixels are both at most this are culled.
        eps2d: px^2 added to every 2D covariance.
        sh_degree: 0 to 4: how many bands of ``colors`` count. None: ``colors`` are colors.
        packed: meta holds what is visible, as [nnz, ...], and not [..., C, N, ...].
        tile_size: pixels; ``meta`` tells how many such tiles there are, and nothing else depends on it. None = 16.
        backgrounds: [..., C, D] seen where alpha < 1; depth has none. None = zeros.
        render_mode: ``RGB`` gives ``colors``, ``D`` depth as it accumulates, ``ED`` depth divided by alpha; or both.
        sparse_grad: refused: gradients are dense.
        absgrad: backward also fills ``meta["means2d"].absgrad`` (AbsGS, https://arxiv.org/abs/2404.10484).
        rasterize_mode: ``antialiased`` multiplies the opacities by sqrt(det(cov) / det(cov + eps2d I)), cov being the 2D
            covariance (Mip-Splatting, https://arxiv.org/abs/2311.16493).
        channel_chunk: accepted, without effect.
        distributed: refused.
        camera_model: ``pinhole``, ``ortho`` or ``fisheye``, the last two computed by torch; others are refused.
        segmented: accepted, without effect.
        covars: [..., N, 3, 3] covariances in place of quats and scales; of each the upper triangle is read, as gsplat does.
        with_ut: refused.
        with_eval3d: refused.
        radial_coeffs: [..., C, 4] of a fisheye (OpenCV's k1 to k4); refused with other cameras. gsplat has them with ``with_ut``.
        tangential_coeffs: refused, as is every other lens distortion.
        thin_prism_coeffs: refused.
        ftheta_coeffs: refused.
        rolling_shutter: None or gsplat's GLOBAL; others are refused.
        viewmats_rs: refused.
        macro_tile: refused, as are all arguments after it but ``backend``, unless they are at their defaults: gsplat's next
            version has them.
        return_normals: refused.
        global_z_order: refused unless True: Gaussians are sorted by planar depth.
        rays: refused.
        lidar_coeffs: refused.
        external_distortion_coeffs: refused.
        ut_params: refused.
        extra_signals: refused: give them as more channels of ``colors``.
        extra_signals_sh_degree: refused.
        renderer_config: refused.
        backend: ``cpu``, ``triton`` (a GPU; float32 both), ``reference`` (the oracle: any float type, slow) or ``auto``. Not in
            gsplat.

    Returns:
        colors [..., C, H, W, D, D + 1 or 1]; alphas [..., C, H, W, 1]; and meta, a dict with ``means2d`` (call
        ``retain_grad()`` on it before backward), ``conics``, ``depths``, ``radii`` (0 where culled), ``opacities`` (as drawn),
        ``batch_ids``, ``camera_ids`` and ``gaussian_ids`` [nnz] int64 (None unless packed), ``width``, ``height``,
        ``tile_size``, ``tile_width`` and ``tile_height`` (numbers of tiles), ``n_cameras`` and ``n_batches``. gsplat's lists of
        tiles are not there.

    Raises:
        ValueError: a shape does not fit, a value is not finite, or an argument asks for what is not covered.

    Examples:
        Two Gaussians seen by one camera:

        >>> colors, alphas, meta = flowsplat.rasterization(
        ...     means=np.array([[0, 0, 2.0], [0.5, 0, 3]]), quats=np.array([[1.0, 0, 0, 0]] * 2), scales=np.full((2, 3), 0.1),
        ...     opacities=np.array([0.9, 0.5]), colors=np.array([[1.0, 0, 0], [0, 0, 1]]), viewmats=np.eye(4)[None],
        ...     Ks=np.array([[[20, 0, 8], [0, 20, 6], [0, 0, 1.0]]]), width=16, height=12, render_mode="RGB+ED",
        ... )
        >>> colors.shape, alphas.shape, meta["gaussian_ids"].tolist()
        (torch.Size([1, 12, 16, 4]), torch.Size([1, 12, 16, 1]), [0, 1])
    """
    _refuse_uncovered(
        sparse_grad=sparse_grad,
        distributed=distributed,
        camera_model=camera_model not in CAMERA_MODELS,
        with_ut=with_ut,
        with_eval3d=with_eval3d,
        radial_coeffs=radial_coeffs is not None and camera_model != "fisheye",
        tangential_coeffs=tangential_coeffs is not None,
        thin_prism_coeffs=thin_prism_coeffs is not None,
        ftheta_coeffs=ftheta_coeffs is not None,
        rolling_shutter=rolling_shutter is not None and getattr(rolling_shutter, "name", "") != "GLOBAL",
        viewmats_rs=viewmats_rs is not None,
        macro_tile=macro_tile,
        return_normals=return_normals,
        global_z_order=not global_z_order,
        rays=rays is not None,
        lidar_coeffs=lidar_coeffs is not None,
        external_distortion_coeffs=external_distortion_coeffs is not None,
        ut_params=ut_params is not None,
        extra_signals=extra_signals is not None,
        extra_signals_sh_degree=extra_signals_sh_degree is not None,
        renderer_config=renderer_config is not None,
    )
    if render_mode not in ("RGB", "D", "ED", "RGB+D", "RGB+ED"):
        raise ValueError(f"render_mode must be RGB, D, ED, RGB+D or RGB+ED, not {render_mode!r}")
    if rasterize_mode not in ("classic", "antialiased"):
        raise ValueError(f"rasterize_mode must be classic or antialiased, not {rasterize_mode!r}")
    width, height = to_pixels("width", width), to_pixels("height", height)
    tile_size = to_pixels("tile_size", _TILE_SIZE if tile_size is None else tile_size)
    check_numbers(near_plane=near_plane, far_plane=far_plane, radius_clip=radius_clip, eps2d=eps2d)
    sh_degree = None if sh_degree is None else _to_degree(sh_degree)
    has_color = "RGB" in render_mode
    if covars is not None:
        quats = scales = None
    if not has_color:
        backgrounds = None  # nothing is behind depth, whatever their shape
    given = to_tensors(
        means=means, quats=quats, scales=scales, opacities=opacities, colors=colors, viewmats=viewmats, Ks=Ks, covars=covars,
        backgrounds=backgrounds, radial_coeffs=radial_coeffs,
    )  # fmt: skip
    if colors is None and has_color:
        raise ValueError(f"colors must be given for render_mode {render_mode}: without them there is depth alone, D or ED")
    batch, count, cameras, tail = _shapes(**given, sh_degree=sh_degree)
    check_finite(**given)
    if not has_color:
        given["colors"] = None
    if covars is not None:
        given["covars"] = given["covars"].triu() + given["covars"].triu(1).mT
    settings = _Settings(
        width, height, near_plane, far_plane, eps2d, radius_clip, rasterize_mode == "antialiased", backend, sh_degree, render_mode,
        absgrad, camera_model,  # type: ignore[arg-type]
    )  # fmt: skip
    images = _images(batch, count, cameras, tail, **given, sh_degree=sh_degree)
    projections, drawn = zip(*[_project_image(image, settings) for image in images], strict=True)
    rows = _Rows.of(projections, count, (*batch, cameras), packed)
    meta: dict[str, Any] = {name: rows.join([getattr(p, name) for p in projections]) for name in _GEOMETRY}
    meta["opacities"] = rows.join(drawn)
    # What is drawn comes from the tensors in meta, so that their gradients can be read there.
    parts = {
        name: value.reshape(sum(rows.sizes), *value.shape[meta["depths"].ndim :]).split(rows.sizes) for name, value in meta.items()
    }
    if absgrad:
        absolute = meta["means2d"].absgrad = torch.zeros_like(meta["means2d"])
        for part, target in zip(parts["means2d"], absolute.reshape(-1, 2).split(rows.sizes), strict=True):
            part.absgrad = target
    rendered, alphas = [], []
    for i, image in enumerate(images):
        extents = projections[i].extents
        projected = replace(
            projections[i],
            extents=None if extents is None else rows.pick(extents, i),
            **{name: parts[name][i] for name in _GEOMETRY},
        )
        blended, alpha = _blend_image(image, projected, parts["opacities"][i], partial(rows.pick, i=i), settings, len(images) == 1)
        rendered.append(blended)
        alphas.append(alpha)
    meta |= rows.ids() | {
        "width": width, "height": height, "tile_size": tile_size, "tile_width": -(-width // tile_size),
        "tile_height": -(-height // tile_size), "n_batches": math.prod(batch), "n_cameras": cameras,
    }  # fmt: skip
    shape = (*batch, cameras, height, width)
    return _stack(rendered).reshape(*shape, -1), _stack(alphas).reshape(*shape, 1), meta


def _to_degree(value: Any) -> int:
    """Return a degree of harmonics as Python's own number, or raise a ValueError."""
    try:
        degree = operator.index(value)
    except (TypeError, ValueError):
        degree = -1
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"sh_degree must be None or 0 to {MAX_DEGREE}, not {value!r:.40}")
    return degree


def _refuse_uncovered(**asked_for: bool) -> None:
    """Raise a ValueError that names the first argument that asks for what is not covered."""
    for name, asked in asked_for.items():
        if asked:
            raise ValueError(f"{name} is not covered by flowsplat's rasterization: leave it at its default")


@dataclass(frozen=True)
class _Settings:
    """What is the same for all images, named as the arguments of ``rasterization``."""

    width: int
    height: int
    near_plane: float
    far_plane: float
    eps2d: float
    radius_clip: float
    antialiased: bool
    backend: BackendName
    sh_degree: int | None
    render_mode: RenderMode
    absgrad: bool
    camera_model: CameraModel


@dataclass(frozen=True)
class _Image:
    """What one camera of one batch entry sees."""

    means: Tensor  # [N, 3]
    quats: Tensor | None  # [N, 4]
    scales: Tensor | None  # [N, 3]
    covars: Tensor | None  # [N, 3, 3]
    opacities: Tensor  # [N]
    colors: Tensor | None  # [N, D] or [N, K, 3]; None where nobody asks for them
    viewmat: Tensor  # [4, 4]
    K: Tensor  # [3, 3]
    center: Tensor | None  # [3] of the camera in the world; only harmonics beyond degree 0 need it
    background: Tensor | None  # [D]
    radial_coeffs: Tensor | None  # [4]


def _images(
    batch: tuple[int, ...],
    count: int,
    cameras: int,
    tail: tuple[int, ...],
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    covars: Tensor | None,
    opacities: Tensor,
    colors: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    backgrounds: Tensor | None,
    radial_coeffs: Tensor | None,
    sh_degree: int | None,
) -> list[_Image]:
    """Return the tensors of every camera of every batch entry, one camera after the other. Shapes are as ``_shapes`` gives them."""
    batches = math.prod(batch)

    def of_entry(value: Tensor | None, *shape: int) -> list[Any]:
        entries: Any = [None] * batches if value is None else value.reshape(batches, *shape).unbind(0)
        return [entry for entry in entries for _ in range(cameras)]

    def of_image(value: Tensor | None, *shape: int) -> Any:
        return [None] * (batches * cameras) if value is None else value.reshape(batches * cameras, *shape).unbind(0)

    per_camera = colors is not None and colors.ndim > len(batch) + 1 + len(tail)
    columns = {
        "means": of_entry(means, count, 3),
        "opacities": of_entry(opacities, count),
        "quats": of_entry(quats, count, 4),
        "scales": of_entry(scales, count, 3),
        "covars": of_entry(covars, count, 3, 3),
        "viewmat": of_image(viewmats, 4, 4),
        "K": of_image(Ks, 3, 3),
        "colors": (of_image if per_camera else of_entry)(colors, count, *tail),
        "center": of_image(torch.linalg.inv(viewmats)[..., :3, 3] if sh_degree and colors is not None else None, 3),
        "background": of_image(backgrounds, *tail[-1:]),
        "radial_coeffs": of_image(radial_coeffs, FISHEYE_COEFFICIENTS),
    }
    return [_Image(**{name: values[i] for name, values in columns.items()}) for i in range(batches * cameras)]


@dataclass(frozen=True)
class _Rows:
    """Which Gaussians of each image have a row in meta: those that are visible (``packed``), or all N."""

    chosen: list[Tensor]  # int64 [nnz of the image] each: what is visible
    sizes: list[int]  # rows of each image
    count: int  # N
    shape: tuple[int, ...]  # (..., C)
    packed: bool

    @classmethod
    def of(cls, projections: Sequence[Projected], count: int, shape: tuple[int, ...], packed: bool) -> _Rows:
        """Return those of what was projected."""
        chosen = [torch.nonzero(each.visible).squeeze(1) for each in projections]
        return cls(chosen, [len(ids) if packed else count for ids in chosen], count, shape, packed)

    def pick(self, value: Tensor, i: int) -> Tensor:
        """Return the rows [n_i, ...] of image i, of a value [N, ...]."""
        return value.index_select(0, self.chosen[i]) if self.packed and self.sizes[i] < self.count else value

    def join(self, values: Sequence[Tensor]) -> Tensor:
        """Return [nnz, ...] if packed, else [..., C, N, ...], of a value [N, ...] of every image."""
        picked = [self.pick(value, i) for i, value in enumerate(values)]
        if self.packed:
            return picked[0] if len(picked) == 1 else torch.cat(picked)
        return _stack(picked).reshape(*self.shape, *picked[0].shape)

    def ids(self) -> dict[str, Tensor | None]:
        """``batch_ids``, ``camera_ids`` and ``gaussian_ids`` [nnz] int64; None unless packed."""
        if not self.packed:
            return dict.fromkeys(("batch_ids", "camera_ids", "gaussian_ids"))
        if len(self.chosen) == 1:  # numbering each would take 1 % of the time
            batch_ids, camera_ids = (self.chosen[0].new_zeros(self.sizes[0]) for _ in range(2))
            return {"batch_ids": batch_ids, "camera_ids": camera_ids, "gaussian_ids": self.chosen[0]}
        device, cameras = self.chosen[0].device, self.shape[-1]
        number, counts = torch.arange(len(self.chosen), device=device), torch.tensor(self.sizes, device=device)
        batch_ids, camera_ids = (
            torch.repeat_interleave(each, counts, output_size=sum(self.sizes)) for each in (number // cameras, number % cameras)
        )
        return {"batch_ids": batch_ids, "camera_ids": camera_ids, "gaussian_ids": torch.cat(self.chosen)}


def _stack(values: list[Tensor]) -> Tensor:
    """``torch.stack``, without a copy where there is but one."""
    return values[0][None] if len(values) == 1 else torch.stack(values)


def _shapes(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    colors: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    covars: Tensor | None,
    backgrounds: Tensor | None,
    radial_coeffs: Tensor | None,
    sh_degree: int | None,
) -> tuple[tuple[int, ...], int, int, tuple[int, ...]]:
    """Check all shapes: batch dimensions, N, C and what ``colors`` holds for a Gaussian, (D,) or (K, 3); () without them."""

    def check(name: str, value: Tensor, *shape: int) -> None:
        if value.shape != (*batch, *shape):
            raise ValueError(f"{name} must be {[*batch, *shape]}, not {list(value.shape)}")

    if means.ndim < 2 or viewmats.ndim < 3 or 0 in viewmats.shape:
        raise ValueError("means must be [..., N, 3] and viewmats [..., C, 4, 4] with one camera or more")
    batch, count, cameras = tuple(means.shape[:-2]), means.shape[-2], viewmats.shape[-3]
    check("means", means, count, 3)
    if covars is not None:
        check("covars", covars, count, 3, 3)
    elif quats is None or scales is None:
        raise ValueError("give quats [..., N, 4] and scales [..., N, 3], or covars [..., N, 3, 3]")
    else:
        check("quats", quats, count, 4)
        check("scales", scales, count, 3)
    check("opacities", opacities, count)
    check("viewmats", viewmats, cameras, 4, 4)
    check("Ks", Ks, cameras, 3, 3)
    if radial_coeffs is not None:
        check("radial_coeffs", radial_coeffs, cameras, FISHEYE_COEFFICIENTS)
    if colors is None:
        return batch, count, cameras, ()
    own = 1 if sh_degree is None else 2
    tail = tuple(colors.shape[-own:])
    if colors.shape not in ((*batch, count, *tail), (*batch, cameras, count, *tail)):
        wanted = "[..., (C,) N, D]" if sh_degree is None else "[..., (C,) N, K, 3] with sh_degree"
        raise ValueError(f"colors must be {wanted}, N = {count}, C = {cameras}, not {list(colors.shape)}")
    if sh_degree is not None and (tail[1] != 3 or tail[0] < harmonics_count(sh_degree)):
        raise ValueError(f"colors must hold [{harmonics_count(sh_degree)} or more, 3] a Gaussian for sh_degree {sh_degree}")
    if backgrounds is not None:
        check("backgrounds", backgrounds, cameras, tail[-1])
    return batch, count, cameras, tail


def _project_image(image: _Image, settings: _Settings) -> tuple[Projected, Tensor]:
    """Project into one camera, compensate and clip: what is visible, and the opacities [N] to draw it with."""
    eps2d, opacities = settings.eps2d, image.opacities

    def with_opacities(values: Tensor) -> Projected:
        return project(
            image.means, image.quats, image.scales, values, image.viewmat, image.K, settings.width, settings.height,
            covars=image.covars, near_plane=settings.near_plane, far_plane=settings.far_plane, eps2d=eps2d,
            camera_model=settings.camera_model, radial_coeffs=image.radial_coeffs, backend=settings.backend,
        )  # fmt: skip

    projected = with_opacities(opacities)
    if settings.antialiased:
        a, b, c = torch.where(projected.visible[:, None], projected.conics, torch.zeros_like(projected.conics)).unbind(1)
        # The conic is the inverse of cov + eps2d I, so det(cov) / det(cov + eps2d I) = det(I - eps2d conic).
        ratio = 1 - eps2d * (a + c) + eps2d * eps2d * (a * c - b * b)
        opacities = opacities * torch.sqrt(ratio.clamp(min=_MIN_RATIO))
        with torch.no_grad():
            smaller = with_opacities(opacities)  # fainter Gaussians cover fewer pixels, or none
        projected = replace(projected, radii=smaller.radii, extents=smaller.extents)
    if settings.radius_clip > 0:
        kept = (projected.radii > settings.radius_clip).any(1)
        extents = projected.extents
        projected = replace(projected, radii=projected.radii * kept[:, None], extents=None if extents is None else extents * kept)
    return projected, opacities


def _blend_image(
    image: _Image, projected: Projected, opacities: Tensor, pick: Callable[[Tensor], Tensor], settings: _Settings, is_alone: bool
) -> tuple[Tensor, Tensor]:
    """Draw one image: what ``render_mode`` asks for [H, W, D, D + 1 or 1], and alpha [H, W, 1].

    Args:
        projected: of the n Gaussians that are drawn.
        opacities: [n] of them.
        pick: takes their rows [n, ...] from a value [N, ...].
        is_alone: no other image is drawn, so that this one is given back as it is.
    """
    features = []
    if image.colors is not None:
        color = pick(image.colors)
        if settings.sh_degree is not None:
            directions = None if image.center is None else pick(image.means) - image.center
            color = colors_from_harmonics(color, directions, settings.sh_degree)
        features.append(color)
    if "D" in settings.render_mode:
        features.append(projected.depths[:, None])
    drawn, alpha = blend(projected, opacities, torch.cat(features, 1), settings.width, settings.height, absgrad=settings.absgrad)
    blended, alpha = drawn, alpha[..., None]
    if "ED" in settings.render_mode:
        blended = torch.cat([blended[..., :-1], blended[..., -1:] / alpha.clamp(min=1e-10)], -1)
    if image.background is not None:
        zeros = blended.shape[-1] - len(image.background)  # nothing is behind depth
        blended = blended + (1 - alpha) * torch.nn.functional.pad(image.background, (0, zeros))
    if blended is drawn and is_alone and drawn.requires_grad:
        blended = drawn.clone()  # backward reads what was drawn, and whoever masks an image writes into it
    return blended, alpha

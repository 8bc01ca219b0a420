"""The one signature for rasterizing, and the one place that picks a backend."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Protocol

import torch
from torch import Tensor

from flowsplat.common.devices import Kernels, kernels_on
from flowsplat.common.triton import check_runs
from flowsplat.splatting import reference
from flowsplat.splatting.arguments import Array, check_numbers, to_pixels, to_tensors
from flowsplat.splatting.camera_models import CAMERA_MODELS, FISHEYE_COEFFICIENTS, CameraModel
from flowsplat.splatting.rules import ALPHA_MIN, EPS2D, FAR_PLANE, NEAR_PLANE, OPACITY_FLOOR, SLOPED_FEATURES

BackendName = Literal["auto", "cpu", "triton", "reference"]


@dataclass(frozen=True)
class Projected:
    """Gaussians in the image plane.

    Attributes:
        means2d: [N, 2] pixels. ``retain_grad()`` on it gives density control its gradients.
        conics: [N, 3] upper half of the inverse 2D covariance (xx, xy, yy), 1 / px^2.
        depths: [N] planar depth.
        radii: [N, 2] int32, half width and height in pixels of what is drawn; 0 where culled.
        extents: [N] squared sigmas within which alpha >= 1/255; all backends but the oracle, which gives None, need it.
        backend: who made it.
    """

    means2d: Tensor
    conics: Tensor
    depths: Tensor
    radii: Tensor
    extents: Tensor | None
    backend: str

    @property
    def visible(self) -> Tensor:
        """[N] bool: drawn somewhere in the image."""
        return self.radii[:, 0] > 0


def _pick(backend: str, means: Tensor) -> Kernels:
    if backend == "auto":
        return "reference" if means.dtype == torch.float64 else kernels_on(means.device)
    if backend not in ("cpu", "triton", "reference"):
        raise ValueError(f"unknown backend {backend!r}: use auto, cpu, triton or reference")
    if backend != "reference" and means.dtype != torch.float32:
        raise ValueError(f"the {backend} backend computes in float32; use backend='reference' for {str(means.dtype)[6:]}")
    if backend == "cpu" and means.device.type != "cpu":
        raise ValueError(f"the cpu backend needs tensors on the CPU, not on {means.device}")
    if backend == "triton":
        check_runs(means)
    return backend  # type: ignore[return-value]


class SplattingKernels(Protocol):
    """The differentiable functions of a backend that has kernels."""

    def project(self, *args: Any) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """As ``reference.project``, and the squared sigmas [N] within which each Gaussian is drawn."""

    def blend(
        self, means2d: Tensor, conics: Tensor, opacities: Tensor, features: Tensor, depths: Tensor, extents: Tensor, width: int,
        height: int, absolute: Tensor | None, slopes: Tensor | None,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """As ``reference.blend``, with the extents of ``project`` in place of the radii."""


def _kernels(backend: str) -> SplattingKernels:
    """Return those of a backend, imported only where they are needed."""
    if backend == "cpu":
        from flowsplat.splatting.cpu import functions

        return functions
    from flowsplat.splatting.triton import functions as on_gpu

    return on_gpu


def check_finite(**values: Tensor | None) -> None:
    """Raise a ValueError that names the first value with NaN or infinity in it, and where that is."""
    for name, value in values.items():
        # A sum is finite where all of it is, but for one that overflows, and much sooner known.
        if value is None or bool(torch.isfinite(value.detach().sum())):
            continue
        if not bool(torch.isfinite(value.detach()).all()):
            first = torch.nonzero(~torch.isfinite(value.detach()))[0].tolist()
            raise ValueError(f"{name} must be finite, but {name}{first} is {float(value[tuple(first)])}")


def project(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    covars: Tensor | None = None,
    near_plane: float = NEAR_PLANE,
    far_plane: float = FAR_PLANE,
    eps2d: float = EPS2D,
    camera_model: CameraModel = "pinhole",
    radial_coeffs: Tensor | None = None,
    backend: BackendName = "auto",
) -> Projected:
    """Project 3D Gaussians to 2D ones (the first half of ``rasterize``, same arguments).

    Cameras other than pinholes, too, with the ``radial_coeffs`` [4] of a fisheye (``camera_models``): those have no kernels and are
    computed by torch, in the type of the Gaussians.
    """
    count = len(means)
    if means.shape != (count, 3):
        raise ValueError(f"means must be [N, 3], not {list(means.shape)}")
    if covars is None:
        if quats is None or scales is None or quats.shape != (count, 4) or scales.shape != (count, 3):
            raise ValueError("give quats [N, 4] and scales [N, 3], or covars [N, 3, 3]")
    elif covars.shape != (count, 3, 3):
        raise ValueError(f"covars must be [N, 3, 3], not {list(covars.shape)}")
    if opacities.shape != (count,):
        raise ValueError(f"opacities must be [N], not {list(opacities.shape)}")
    if viewmat.shape != (4, 4) or K.shape != (3, 3):
        raise ValueError("viewmat must be [4, 4] and K [3, 3]")
    if camera_model not in CAMERA_MODELS:
        raise ValueError(f"camera_model must be one of {', '.join(CAMERA_MODELS)}, not {camera_model!r}")
    if radial_coeffs is not None and (camera_model != "fisheye" or radial_coeffs.shape != (FISHEYE_COEFFICIENTS,)):
        raise ValueError(f"radial_coeffs must be the [{FISHEYE_COEFFICIENTS}] of a fisheye, not {list(radial_coeffs.shape)}")
    name = _pick(backend, means)
    if covars is not None:
        quats = scales = None
    arguments: Any = (means, quats, scales, covars, opacities, viewmat, K, width, height, near_plane, far_plane, eps2d)
    if name == "reference" or camera_model != "pinhole":
        more: Any = (*arguments, camera_model, radial_coeffs)
        means2d, conics, depths, radii = reference.project(*more)
        extents = None if name == "reference" else _compute_extents(opacities, radii)
        return Projected(means2d, conics, depths, radii, extents, name)
    means2d, conics, depths, radii, extents = _kernels(name).project(*arguments)
    return Projected(means2d, conics, depths, radii, extents, name)


@torch.no_grad()
def _compute_extents(opacities: Tensor, radii: Tensor) -> Tensor:
    """Return what the kernels of a projection do: the squared sigmas [N] within which a Gaussian is drawn, 0 where it is culled."""
    return torch.where(radii[:, 0] > 0, 2 * torch.log(opacities.clamp(min=OPACITY_FLOOR) / ALPHA_MIN), torch.zeros_like(opacities))


def blend(
    projected: Projected,
    opacities: Tensor,
    features: Tensor,
    width: int,
    height: int,
    *,
    absgrad: bool = False,
    slopes: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Composite features [N, C] front to back (the second half of ``rasterize``).

    Args:
        projected: from ``project``.
        opacities: [N] between 0 and 1.
        features: [N, C].
        width: pixels.
        height: pixels.
        absgrad: give ``projected.means2d`` an attribute ``absgrad`` [N, 2]: zeros, to which backward adds the sum over pixels of
            the absolute gradient of the 2D mean (AbsGS, https://arxiv.org/abs/2404.10484). One that is there already is used.
        slopes: [N, 2] by how much the first three features grow, all alike, a pixel to the right and a pixel down of the
            Gaussian's center. Ours; None = every feature is the same all over a Gaussian. Not with ``absgrad``.

    Returns:
        features [H, W, C] on black, which nothing may be written into before backward, and alphas [H, W].

    Raises:
        ValueError: a shape does not fit, or ``absgrad`` is asked for with slopes.
    """
    if features.ndim != 2 or len(features) != len(opacities):
        raise ValueError(f"features must be [N, C], not {list(features.shape)}")
    if slopes is not None and (slopes.shape != (len(features), 2) or features.shape[1] < SLOPED_FEATURES):
        raise ValueError(f"slopes must be [N, 2] with features [N, 3 or more], not {list(slopes.shape)}")
    if slopes is not None and absgrad:
        raise ValueError("absolute gradients are those of Gaussians without slopes")
    p, absolute = projected, None
    if absgrad:
        absolute = getattr(p.means2d, "absgrad", None)
        if absolute is None:
            absolute = p.means2d.absgrad = torch.zeros_like(p.means2d)  # type: ignore[attr-defined]
    if p.backend == "reference":
        return reference.blend(p.means2d, p.conics, opacities, features, p.depths, p.radii, width, height, absolute, slopes)
    assert p.extents is not None
    return _kernels(p.backend).blend(p.means2d, p.conics, opacities, features, p.depths, p.extents, width, height, absolute, slopes)


def rasterize(
    means: Array,
    quats: Array | None,
    scales: Array | None,
    opacities: Array,
    features: Array,
    viewmat: Array,
    K: Array,
    width: int,
    height: int,
    *,
    covars: Array | None = None,
    background: Array | None = None,
    near_plane: float = NEAR_PLANE,
    far_plane: float = FAR_PLANE,
    eps2d: float = EPS2D,
    backend: BackendName = "auto",
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Splat N Gaussians with C feature channels into an image (docs/method/flow.md, "Compositing"), differentiable in everything.

    Tensors are of one float type and on one device. NumPy arrays are taken in their place, as float32 where all are arrays.

    Args:
        means: [N, 3] world.
        quats: [N, 4] wxyz, any length; ignored with ``covars``.
        scales: [N, 3] standard deviations; ignored with ``covars``.
        opacities: [N] between 0 and 1.
        features: [N, C] colors or anything else.
        viewmat: [4, 4] world to camera, OpenCV axes.
        K: [3, 3] pixels; the center of the top-left pixel is (0.5, 0.5).
        width: pixels.
        height: pixels.
        covars: [N, 3, 3] general covariances in place of quats and scales.
        background: [C] seen where alpha < 1; None = zeros.
        near_plane: Gaussians nearer are culled.
        far_plane: Gaussians farther are culled.
        eps2d: px^2 added to every 2D covariance.
        backend: ``cpu`` (Numba, float32), ``triton`` (GPU, float32), ``reference`` (torch, any float type and device, slow) or
            ``auto``: by device and type. On a GPU where Triton does not work that is the slow one.

    Returns:
        features [H, W, C]; alphas [H, W]; and a dict with ``means2d`` [N, 2], ``conics`` [N, 3], ``depths`` [N] and ``radii``
        [N, 2] int32. Call ``info["means2d"].retain_grad()`` before backward to get the gradients of density control.

    Raises:
        ValueError: a shape, dtype or backend does not fit, or a value is not finite. (``project`` and ``blend`` do not look:
            there a Gaussian with such a mean, quaternion or scale is culled.)

    Examples:
        One red Gaussian, two units in front of a camera:

        >>> image, alphas, info = flowsplat.rasterize(
        ...     means=np.array([[0, 0, 2.0]]), quats=np.array([[1.0, 0, 0, 0]]), scales=np.array([[0.1, 0.1, 0.1]]),
        ...     opacities=np.array([0.9]), features=np.array([[1.0, 0, 0]]), viewmat=np.eye(4),
        ...     K=np.array([[20, 0, 8], [0, 20, 6], [0, 0, 1.0]]), width=16, height=12,
        ... )
        >>> image.shape, image.dtype, info["means2d"].tolist()
        (torch.Size([12, 16, 3]), torch.float32, [[8.0, 6.0]])
        >>> [round(value, 2) for value in image[6, 8].tolist()], bool(image[0, 0].any())
        ([0.74, 0.0, 0.0], False)
    """
    width, height = to_pixels("width", width), to_pixels("height", height)
    check_numbers(near_plane=near_plane, far_plane=far_plane, eps2d=eps2d)
    given = to_tensors(
        means=means, quats=quats, scales=scales, opacities=opacities, features=features, viewmat=viewmat, K=K, covars=covars,
        background=background,
    )  # fmt: skip
    check_finite(**given)
    colors, behind = given.pop("features"), given.pop("background")
    projected = project(
        **given, width=width, height=height, near_plane=near_plane, far_plane=far_plane, eps2d=eps2d, backend=backend
    )
    image, alphas = blend(projected, given["opacities"], colors, width, height)
    if behind is not None:
        image = image + (1 - alphas)[..., None] * behind
    elif image.requires_grad:
        image = image.clone()  # backward reads what ``blend`` returns, and whoever masks an image writes into it
    info = {name: getattr(projected, name) for name in ("means2d", "conics", "depths", "radii")}
    return image, alphas, info

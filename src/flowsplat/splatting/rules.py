"""The numbers that the oracle and every backend share (docs/method.md, "Compositing")."""

from flowsplat.geometry import projection

ALPHA_MIN = 1.0 / 255.0  # a Gaussian is skipped at a pixel below this alpha
ALPHA_MAX = 0.999  # alpha is clamped here, and has no gradient where it is
TRANSMITTANCE_MIN = 1e-4  # a Gaussian that would bring a pixel's transmittance to this or below is not drawn
EPS2D = 0.3  # px^2 added to the diagonal of every 2D covariance
NEAR, FAR = 0.01, 1e10  # planar depths between which Gaussians are drawn where nothing else is asked for, as in gsplat
TANGENT_MARGIN = projection.TANGENT_MARGIN  # image sizes beyond the border where tangents of Jacobians are clamped
OPACITY_FLOOR = 1e-12  # keeps the logarithm of an opacity finite
RADIUS_MAX = 1e6  # pixels
DETERMINANT_MAX = 1e30  # px^4, of a 2D covariance in float32: one beyond is culled

# Real spherical harmonics by degree, with the sign convention of 3D Gaussian Splatting.
C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
C3 = (
    -0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154,
    -0.4570457994644658, 1.445305721320277, -0.5900435899266435,
)  # fmt: skip

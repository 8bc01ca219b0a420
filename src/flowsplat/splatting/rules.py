"""The numbers that the oracle and every backend share (docs/method/flow.md, "Compositing")."""

from flowsplat.geometry import projection

ALPHA_MIN = 1.0 / 255.0
"""A Gaussian is skipped at a pixel below this alpha (docs/method/flow.md, "Flow splatting")."""
ALPHA_MAX = 0.999
"""Alpha is clamped here, and has no gradient where it is (docs/method/flow.md, "Flow splatting")."""
TRANSMITTANCE_MIN = 1e-4
"""A Gaussian that would bring a pixel's transmittance to this or below is not drawn (docs/method/flow.md, "Flow splatting")."""
FOOTPRINT_NEAR_PLANE = 0.05
"""Planar depth (median depth = 1) below which a footprint is taken as it is here. Chosen by eye."""
EPS2D = 0.3
"""px^2 added to the diagonal of every 2D covariance (docs/method/flow.md, "Flow splatting")."""
NEAR_PLANE, FAR_PLANE = 0.01, 1e10
"""Planar depths between which Gaussians are drawn where nothing else is asked for, as in gsplat."""
TANGENT_MARGIN = projection.TANGENT_MARGIN  # image sizes beyond the border where tangents of Jacobians are clamped
OPACITY_FLOOR = 1e-12
"""Keeps the logarithm of an opacity finite. A round number."""
SLOPED_FEATURES = 3
"""Of the features of a Gaussian, the first ones that its slopes change: red, green and blue."""
RADIUS_MAX = 1e6
"""Pixels. A round number."""
DETERMINANT_MAX = 1e30
"""px^4, of a 2D covariance: one beyond is culled, since float32 holds its inverse no longer."""

# Real spherical harmonics by degree, with the sign convention of 3D Gaussian Splatting.
C0 = 0.28209479177387814
"""Factor of the spherical harmonics of degree 0, as in 3D Gaussian splatting."""
C1 = 0.4886025119029199
"""Of degree 1."""
C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
"""Of degree 2."""
C3 = (
    -0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154,
    -0.4570457994644658, 1.445305721320277, -0.5900435899266435,
)  # fmt: skip
"""Of degree 3."""
C4 = (
    2.5033429417967046, -1.7701307697799304, 0.9461746957575601, -0.6690465435572892, 0.10578554691520431,
    -0.6690465435572892, 0.47308734787878004, -1.7701307697799304, 0.6258357354491761,
)  # fmt: skip
"""Of degree 4."""

"""The numbers that the oracle and every backend share (METHOD 3.4)."""

ALPHA_MIN = 1.0 / 255.0  # a Gaussian is skipped at a pixel below this alpha
ALPHA_MAX = 0.999  # alpha is clamped here, and has no gradient where it is
TRANSMITTANCE_MIN = 1e-4  # a Gaussian that would bring a pixel's transmittance to this or below is not drawn
EPS2D = 0.3  # px^2 added to the diagonal of every 2D covariance

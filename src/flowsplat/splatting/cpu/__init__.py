"""The CPU backend: Numba kernels with explicit vectors of 16 lanes, and the autograd functions round them."""

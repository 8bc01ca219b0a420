"""The GPU backend: the steps of the CPU backend as Triton kernels, and the autograd functions round them."""

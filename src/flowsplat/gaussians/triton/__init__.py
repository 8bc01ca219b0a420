"""What several of the Triton kernels of Gaussians call."""

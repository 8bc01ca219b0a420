"""Training: losses, the optimizer, the loop, checkpoints, and every setting of them."""

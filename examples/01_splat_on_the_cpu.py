"""Splat Gaussians on the CPU and fit them to an image: the rasterizer alone, differentiable in everything."""

import sys
from pathlib import Path

import torch

from flowsplat import rasterize
from flowsplat.images.colors import float_to_bytes
from flowsplat.scenes.layers import write_image

out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
steps = int(sys.argv[2]) if len(sys.argv) > 2 else 200
torch.manual_seed(0)
width, height, count = 128, 96, 800

# The target: two soft discs on a gradient.
y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
target = torch.stack([x / width, y / height, torch.full_like(x, 0.3)], -1)
for cx, cy, radius, color in ((45, 40, 22, (1.0, 0.8, 0.1)), (85, 60, 18, (0.1, 0.3, 0.9))):
    inside = torch.sigmoid(radius - torch.hypot(x - cx, y - cy))[..., None]
    target = inside * torch.tensor(color) + (1 - inside) * target

viewmat = torch.eye(4)
K = torch.tensor([[100.0, 0, width / 2], [0, 100, height / 2], [0, 0, 1]])
means = torch.rand(count, 3) * torch.tensor([1.3, 1.0, 0.5]) - torch.tensor([0.65, 0.5, -0.8])
parameters = {
    "means": means,
    "quats": torch.randn(count, 4),
    "log_scales": torch.full((count, 3), -3.5),
    "logits": torch.zeros(count),
    "colors": torch.rand(count, 3),
}
leaves = {name: value.requires_grad_() for name, value in parameters.items()}
optimizer = torch.optim.Adam(leaves.values(), lr=0.02)
for step in range(steps):
    image, alphas, info = rasterize(
        leaves["means"], leaves["quats"], leaves["log_scales"].exp(), leaves["logits"].sigmoid(), leaves["colors"],
        viewmat, K, width, height,
    )  # fmt: skip
    loss = (image - target).abs().mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    if step % 50 == 0 or step == steps - 1:
        print(f"step {step}: mean error {loss.item():.4f}")
sheet = torch.cat([target, image.detach().clamp(0, 1)], 1)
write_image(out / "01_fitted.png", float_to_bytes(sheet.numpy()))
print(f"target | fitted: {out / '01_fitted.png'}")

"""For users of gsplat: one import changes, and the code trains on the CPU, gsplat's own density control included."""

import sys
from pathlib import Path

import torch

from flowsplat import rasterization  # was: from gsplat import rasterization
from flowsplat.images.colors import float_to_bytes
from flowsplat.scenes.layers import write_image

out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
steps = int(sys.argv[2]) if len(sys.argv) > 2 else 2000
torch.manual_seed(0)
width, height, count = 256, 192, 10_000

# The target: rings that get finer outwards, a weave and wavy stripes, each in a channel.
y, x = torch.meshgrid((torch.arange(height) + 0.5) / height, (torch.arange(width) + 0.5) / height, indexing="ij")
u, v = 0.8 * x + 0.6 * y, 0.8 * y - 0.6 * x
rings = torch.sin(120 * ((x - 0.6) ** 2 + (y - 0.4) ** 2))
weave = torch.sign(torch.sin(40 * u) * torch.sin(55 * v))
stripes = torch.sin(90 * v + 4 * torch.sin(7 * u))
target = 0.5 + 0.4 * torch.stack([rings, weave, stripes], -1)

# One camera two units in front of a sheet of Gaussians.
viewmats, Ks = torch.eye(4)[None], torch.tensor([[[height, 0, width / 2], [0, height, height / 2], [0, 0, 1]]])
sheet = torch.tensor([2 * width / height, 2, 0.4])
params = torch.nn.ParameterDict(
    {
        "means": (torch.rand(count, 3) - 0.5) * sheet + torch.tensor([0, 0, 2]),
        "scales": torch.full((count, 3), (width / height / count) ** 0.5).log(),
        "quats": torch.randn(count, 4),
        "opacities": torch.full((count,), 0.1).logit(),
        "colors": torch.rand(count, 3).logit(),
    }
)
rates = {"means": 2e-3, "scales": 1e-2, "quats": 1e-2, "opacities": 5e-2, "colors": 2.5e-2}
optimizers = {name: torch.optim.Adam([params[name]], lr=rate, eps=1e-15) for name, rate in rates.items()}

try:
    from gsplat.strategy import DefaultStrategy

    strategy = DefaultStrategy(refine_start_iter=steps // 4, refine_every=max(steps // 20, 1), grow_grad2d=5e-4, verbose=True)
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state()
except ImportError:
    strategy = None
    print("gsplat is not installed: the number of Gaussians stays as it is")

for step in range(steps):
    images, alphas, info = rasterization(
        params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid(), params["colors"].sigmoid(),
        viewmats, Ks, width, height,
    )  # fmt: skip
    if strategy:
        strategy.step_pre_backward(params, optimizers, state, step, info)
    loss = (images[0] - target).abs().mean() + 0.01 * params["opacities"].sigmoid().mean()
    loss.backward()
    for optimizer in optimizers.values():
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
    if step % max(steps // 8, 1) == 0 or step == steps - 1:
        error = ((images[0] - target) ** 2).mean()
        print(f"step {step}: {len(params['means'])} Gaussians, PSNR {-10 * error.log10().item():.2f}")
    if strategy:
        strategy.step_post_backward(params, optimizers, state, step, info, packed=True)
image = torch.cat([target, images[0].detach().clamp(0, 1)], 1)
write_image(out / "05_gsplat_users.png", float_to_bytes(image.numpy()))
print(f"target | fitted: {out / '05_gsplat_users.png'}")

"""Train a small clip from Python, with any setting changed: here the built-in scene with its true priors, small and short."""

import sys
from pathlib import Path

import flowsplat
from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic

out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
iterations = int(sys.argv[2]) if len(sys.argv) > 2 else 150

scene = out / "02_scene"
if not (scene / "scene.json").exists():
    write_synthetic(scene, SyntheticScene(width=128, height=72, frames=16), holdout=10)
run = flowsplat.run(
    scene, out / "02_run",
    overrides={"priors": "true", "train.iterations": iterations, "train.flow-model": "affine", "render.paths": ["input"]},
)  # fmt: skip
metrics = run.metrics
print(f"held-out views: {metrics['heldout_views']['psnr']:.2f} dB, flow error {metrics['flow_epe']['median']:.3f} px")

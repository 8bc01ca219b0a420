"""Render a trained scene (of example 02) from a place where no camera was, at a time between two frames."""

import sys
from pathlib import Path

import flowsplat
from flowsplat.geometry.paths import orbit
from flowsplat.images.colors import depth_range, depth_to_color, float_to_bytes, flow_to_color
from flowsplat.images.sheets import side_by_side
from flowsplat.scenes.layers import write_image

out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
model = flowsplat.load(out / "02_run")
scene = flowsplat.Scene(out / "02_run" / "scene")

middle = scene.num_frames // 2
time = 0.5 * (scene.timestamps[middle] + scene.timestamps[middle + 1])
distance = 1 / scene.similarity.scale  # the median depth
camera = orbit(scene.cameras[middle], distance, steps=8, angle=5)[1]
rendering = model.render(camera, time, flow_to=(camera, scene.timestamps[middle + 1]))
assert rendering.flow is not None
panels = [
    float_to_bytes(rendering.color),
    flow_to_color(rendering.flow),
    depth_to_color(rendering.depth, *depth_range([rendering.depth])),
]
write_image(out / "03_rendered.png", side_by_side(panels, ["color", "flow", "depth"]))
print(f"color | flow | depth at {time:.3f} s: {out / '03_rendered.png'}")

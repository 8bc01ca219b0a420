"""The built-in clip: a small moving world with exact cameras, depth, flow, masks, tracks and held-out views."""

from flowsplat.scenes.synthetic.synthetic_scene import SyntheticScene, View
from flowsplat.scenes.synthetic.writing import write_synthetic, write_synthetic_video

__all__ = ["SyntheticScene", "View", "write_synthetic", "write_synthetic_video"]

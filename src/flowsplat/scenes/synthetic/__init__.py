"""Drawn clips with exact cameras, depth, flow, masks, tracks and held-out views.

``StreetScene`` is what people film, and what the demo shows. In ``SyntheticScene`` three things float in a room, and no camera
can tell how far away they are: it tests whether that is known.
"""

from flowsplat.scenes.synthetic.drawn_clip import DrawnClip, DrawnView
from flowsplat.scenes.synthetic.street_scene import StreetScene
from flowsplat.scenes.synthetic.synthetic_scene import SyntheticScene
from flowsplat.scenes.synthetic.writing import encode_frames, write_synthetic, write_synthetic_video

__all__ = ["DrawnClip", "DrawnView", "StreetScene", "SyntheticScene", "encode_frames", "write_synthetic", "write_synthetic_video"]

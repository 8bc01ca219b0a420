"""Scenes: a clip with its cameras, depth, flow, masks, tracks and split, on disk and in memory."""

from flowsplat.scenes.layers import Depth, Flow, Layers, StoredFlow, Tracks
from flowsplat.scenes.scene import HeldoutView, Scene

__all__ = ["Depth", "Flow", "HeldoutView", "Layers", "Scene", "StoredFlow", "Tracks"]

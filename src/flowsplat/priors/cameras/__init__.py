"""Cameras without weights: points followed through the clip, structure from motion, and a verdict on the result."""

from flowsplat.priors.cameras.stage import CameraOptions, camera_stage

__all__ = ["CameraOptions", "camera_stage"]

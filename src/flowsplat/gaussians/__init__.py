"""Represent what moves: 4D Gaussians, their slice at a time, the flow they splat, and how they are made from a scene."""

"""Points followed through the clip."""

from flowsplat.priors.tracks.points import TrackTable, corner_strength, new_points, oldest_of_crowds, refine_points
from flowsplat.priors.tracks.stage import complete_tracks, follow_queries, tracks_stage

__all__ = [
    "TrackTable", "complete_tracks", "corner_strength", "follow_queries", "new_points", "oldest_of_crowds", "refine_points",
    "tracks_stage",
]  # fmt: skip

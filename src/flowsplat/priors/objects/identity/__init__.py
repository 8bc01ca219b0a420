"""Which pixels of masks belong to one object: object ids from tracks, which persist where masks touch and break.

Parts of a mask that are connected may be several objects that touch, and an object may be several parts. Which tracks are on one
object is one optimization, a minimum-cost multicut (Keuper, Andres and Brox, ICCV 2015): pairs of tracks attract or repel each
other by a logistic function of how they move, how far apart they are and how they look, whose weights are fitted where the truth is
known, and the number of objects follows from the optimum. What single tracks are too short to tell, whether something stays
attached over the whole clip, is told by fragments of them, between which the same is done again.

No track lasts through an absence: whether what begins is what ended before is told by how it looks (``returning``).
"""

from flowsplat.priors.objects.identity.clusters import identify_tracks
from flowsplat.priors.objects.identity.masked_tracks import MaskedTracks
from flowsplat.priors.objects.identity.painting import paint
from flowsplat.priors.objects.identity.renumber import has_own_numbers, identify_objects

__all__ = ["MaskedTracks", "has_own_numbers", "identify_objects", "identify_tracks", "paint"]

"""Which pixels of masks belong to one object: object numbers from tracks, which persist where masks touch and break.

Parts of a mask that are connected may be several objects that touch, and an object may be several parts. Tracks that were in
different parts for several frames are on different objects, unless they move as one; tracks that are never apart are on one.
So tracks are clustered: strong ties first, between neighbors whose distance hardly changes over all frames that they share
(Brox and Malik, ECCV 2010), and no tie between clusters that were apart, unless most frames speak for it (in the spirit of
Keuper et al., ICCV 2015). Legs and arms belong to a body that they are never apart from, though they move in ways of their own.
"""

from flowsplat.priors.objects.identity.clusters import objects_of_tracks
from flowsplat.priors.objects.identity.masked_tracks import MaskedTracks
from flowsplat.priors.objects.identity.painting import paint
from flowsplat.priors.objects.identity.renumber import identify_objects

__all__ = ["MaskedTracks", "identify_objects", "objects_of_tracks", "paint"]

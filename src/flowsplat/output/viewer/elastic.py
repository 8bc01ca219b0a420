"""How far the input camera is looked past: as it is pulled, with growing resistance beyond a reach, from where it springs back.

The resistance is that of the exported page (``player/assets/elastic_view.js``): the same formula with the same numbers.
"""

from __future__ import annotations

import math

import numpy as np

REST = 0.8
"""Share of the most that a view can be turned by from which on it resists, and to which it springs back. As in the page."""
MAX_PULL = 4.0
"""Times as far as that, beyond which pulling counts no more. As in the page."""
SPRING_SECONDS = 0.12
"""In which the way back gets shorter by a factor of e. As in the page."""
STILL_SECONDS = 0.25
"""Without a change after which an image counts as still, and a view as let go: viser tells where a browser's camera is, not whether
a button is held, so one that is held still springs back, too. Chosen by eye."""
_ARRIVED = 1.001
"""Times the rest, from which on nearer the way back is over. As in the page."""


def resist(pull: float) -> float:
    """Return what is shown of a pull, both over the most there is: the pull itself up to ``REST``, and from there on less and less.

    Examples:
        >>> resist(0.5), round(resist(1.0), 3), round(resist(4.0), 3)
        (0.5, 0.926, 1.0)
    """
    return pull if pull <= REST else REST + (1 - REST) * (1 - math.exp((REST - pull) / (1 - REST)))


class ElasticTurn:
    """The turn of one client's view, in degrees to the left and up; it goes half as far up and down as to the sides."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """To the input camera, at once."""
        self._pull, self._most, self._pulled_at = (0.0, 0.0), 1.0, float("-inf")

    def pull(self, turn: tuple[float, float], reach: float, now: float) -> None:
        """A hand pulls the view.

        Args:
            turn: degrees to the left and up from the input camera, without resistance.
            reach: degrees to either side up to which there is none, and where the view stays; above 0.
            now: seconds of a clock.
        """
        most = reach / REST
        beyond = max(_length(turn) / (MAX_PULL * most), 1.0)
        self._pull, self._most, self._pulled_at = (turn[0] / beyond, turn[1] / beyond), most, now

    def is_held(self, now: float) -> bool:
        """Return whether a hand still pulls, as far as one can tell (``STILL_SECONDS``)."""
        return now - self._pulled_at < STILL_SECONDS

    def is_moving(self, now: float) -> bool:
        """Return whether the view is going to spring back, or does."""
        return self._pull_left(now) > REST

    def turn(self, now: float) -> tuple[float, float]:
        """Return degrees to the left and up by which the view is turned: at the reach, at the latest, once it has come back."""
        pulled = _length(self._pull) / self._most
        if pulled == 0:
            return 0.0, 0.0
        share = resist(self._pull_left(now)) / pulled
        return self._pull[0] * share, self._pull[1] * share

    def _pull_left(self, now: float) -> float:
        """How far it is pulled, over the most that can be shown; less and less once it is let go."""
        pulled = _length(self._pull) / self._most
        if pulled <= REST or self.is_held(now):
            return pulled
        left = REST + (pulled - REST) * math.exp((self._pulled_at + STILL_SECONDS - now) / SPRING_SECONDS)
        return left if left >= _ARRIVED * REST else REST


def _length(turn: tuple[float, float]) -> float:
    return float(np.hypot(turn[0], 2 * turn[1]))

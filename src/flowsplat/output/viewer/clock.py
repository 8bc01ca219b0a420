"""The time that a client sees: where it stands, whether it plays, how fast, and what happens at the end."""

from __future__ import annotations


class PlaybackClock:
    """Time of the clip, played at ``speed`` seconds a second between ``first`` and ``last``.

    What is shown follows the wall clock: a slow machine shows fewer images of a clip, not a slower clip. All calls take
    ``now``, in seconds of any steady clock.
    """

    def __init__(self, first: float, last: float):
        self.first, self.last = first, last
        self.playing, self.loop, self.speed = False, True, 1.0
        self._t, self._since = first, 0.0

    def at(self, now: float) -> float:
        """Return seconds of the clip at that moment; at the end it starts again or stops."""
        if not self.playing:
            return self._t
        t = self._t + (now - self._since) * self.speed
        if t <= self.last:
            return t
        if not self.loop:
            self._t, self.playing = self.last, False
            return self.last
        return self.first + (t - self.first) % (self.last - self.first)

    def set(self, t: float, now: float) -> None:
        """Go to a time, and on from there if it plays."""
        self._t, self._since = min(max(t, self.first), self.last), now

    def play(self, playing: bool, now: float) -> None:
        """Start (from the beginning where it stands at the end) or stop."""
        t = self.at(now)
        self.set(self.first if playing and t >= self.last else t, now)
        self.playing = playing

    def set_speed(self, speed: float, now: float) -> None:
        """Another speed, from here on."""
        self.set(self.at(now), now)
        self.speed = speed

"""Hold what ``scene.json`` says, as a record. ``Scene`` alone changes it, by methods that say what happened, and writes it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from flowsplat.common.files.json_file import Count, Number, Pixels, Positive, SimilarityFile, Text


@dataclass(frozen=True, kw_only=True)
class SceneInfo:
    """Everything that a scene's folder says of itself; the fields are the keys of ``scene.json``, in the order of the file.

    What is read is checked against these types, but kept as the file has it (whole numbers stay whole), so that it can be
    written again to the byte.
    """

    version: Count
    name: Text
    source: Text
    """What the clip was made from, for people."""
    width: Pixels
    height: Pixels
    source_fps: Positive
    """Frames a second of the source."""
    timestamps: Sequence[Number]
    """Seconds, one a frame, rising."""
    train: Sequence[Count]
    """Numbers of the training frames."""
    heldout: Sequence[Count]
    """Numbers of the held-out frames."""
    notes: Sequence[Text]
    """What was done to the input, in sentences for the user."""
    audio: Text | None = None
    """Name of the file in the folder with the sound."""
    audio_start: Number | None = None
    """Second of the sound at which the clip starts."""
    priors: Mapping[str, Mapping[str, Any]]
    """How each prior that is complete was made (at least ``method``)."""
    similarity: SimilarityFile | None
    """World to the normalized coordinates of training; None until it is asked for, or after the depth changed."""
    ingested: bool = False
    """Whether everything of the input is in the folder."""
    lens: Mapping[str, Any] | None = None
    """The lens that was, or is being, taken out of the images."""
    straightening: Mapping[str, Any] | None = None
    """What is known of the cameras while the images are being straightened."""
    images_replaced: bool = False
    """Whether all new images are there and are being moved to their places."""
    input_frames: Count | None = None
    """Frames of the input that those of the clip were thinned out from, where they were."""
    oracle: Mapping[str, Any] | None = None
    """Which oracle of which scene this is (``flowsplat_benchmarks.oracles``)."""
    more: Mapping[str, Any] = field(default_factory=dict)
    """What else a file holds, which stays in it."""

    @staticmethod
    def from_json(values: Mapping[str, Any]) -> SceneInfo:
        """Return the record of a file that was checked against this class."""
        known = {name: value for name, value in values.items() if name in _KEYS}
        return SceneInfo(**known, more={name: value for name, value in values.items() if name not in _KEYS})

    def to_json(self) -> dict[str, Any]:
        """Return what the file holds; marks that are not set are left out."""
        values = {name: getattr(self, name) for name in _KEYS}
        return {name: value for name, value in values.items() if value or name not in _MARKS} | dict(self.more)


_KEYS = tuple(each.name for each in dataclasses.fields(SceneInfo) if each.name != "more")
_MARKS = ("ingested", "lens", "straightening", "images_replaced", "input_frames", "oracle")
"""Keys that are in the file only while they say something."""

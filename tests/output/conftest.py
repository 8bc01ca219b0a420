"""Entries of the registries that tests add, as a package of somebody else would."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest

from flowsplat.common.registry import Entry
from flowsplat.geometry import Camera
from flowsplat.output.videos.paths import PATHS, PathRequest, VideoPath


def climb_over(request: PathRequest) -> Sequence[Camera]:
    """Half a median depth above the clip's camera."""
    viewmats = [camera.viewmat.copy() for camera in request.own]
    for viewmat in viewmats:
        viewmat[1, 3] += request.distance / 2
    return [replace(camera, viewmat=viewmat) for camera, viewmat in zip(request.own, viewmats, strict=True)]


@pytest.fixture
def climb(monkeypatch) -> float:
    """The camera path ``climb``, titled *Up & away*, and how many median depths it is above the clip's."""
    PATHS.names()  # what there is, is looked for once
    monkeypatch.setattr(PATHS, "_found", dict(PATHS._found))
    PATHS.add(Entry("climb", "Up & away", "From half a median depth above.", VideoPath(climb_over, "climbed")))
    return 0.5

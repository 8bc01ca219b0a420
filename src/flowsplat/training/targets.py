"""Hold the target images of training frames on the device that trains."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from flowsplat.common.devices import upload
from flowsplat.gaussians.observations import Observations
from flowsplat.training.photometric_loss import PhotometricTargets

MAX_MEMORY_SHARE = 0.5
"""Of the memory that is free at the start, how much of a GPU's may be taken by targets that stay. Chosen by eye."""


class Targets:
    """The targets of every training frame. On a GPU they stay once they are there, as long as its memory holds them.

    What is asked for next can be brought over while the present step computes.
    """

    def __init__(self, observations: Observations, with_flow: bool, device: torch.device):
        self._observations, self._with_flow, self._device = observations, with_flow, device
        self._there: dict[int, tuple[PhotometricTargets, Any, bool]] = {}
        if device.type == "cuda":
            self._stream = torch.cuda.Stream(device)
            self._room = MAX_MEMORY_SHARE * torch.cuda.mem_get_info(device)[0]

    def __getitem__(self, k: int) -> PhotometricTargets:
        """Return the targets of training frame ``k``."""
        if self._device.type != "cuda":
            return self._on_host(k)
        self.prefetch(k)
        targets, arrived, stays = self._there[k]
        current = torch.cuda.current_stream(self._device)
        current.wait_event(arrived)
        for plane in _planes(targets):
            plane.record_stream(current)
        if not stays:
            del self._there[k]
        return targets

    def prefetch(self, k: int) -> None:
        """Begin to bring frame ``k`` to the device."""
        if self._device.type != "cuda" or k in self._there:
            return
        host = self._on_host(k)
        with torch.cuda.stream(self._stream):
            pinned: dict[str, Any] = {
                name: upload(plane, torch.device("cpu")).pin_memory() for name, plane in vars(host).items() if plane is not None
            }
            targets = PhotometricTargets(**pinned).to(self._device)
            size = sum(plane.nbytes for plane in _planes(targets))
            stays = size <= self._room
            self._there[k] = targets, self._stream.record_event(), stays
        self._room -= size if stays else 0

    def _on_host(self, k: int) -> PhotometricTargets:
        frame = self._observations[k]
        if frame.forward is None or not self._with_flow:
            return PhotometricTargets(frame.image, frame.depth, frame.depth_trusted)
        return PhotometricTargets(frame.image, frame.depth, frame.depth_trusted, frame.forward.flow, frame.forward.trusted)


def _planes(targets: PhotometricTargets) -> list[Tensor]:
    return [plane for plane in vars(targets).values() if isinstance(plane, Tensor)]

"""Check the messages of a browser to the viewer: whatever arrives passes ``Gate`` before viser sees it.

viser trusts what it is told: it would set any property of a control, share the viewer through a server of its makers, and keep as
much of an upload as is sent. Here only what this viewer's own page says gets through: the camera, a click, the value of a control,
an upload that fits. What values a control may have, it knows itself (``controls``).
"""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable
from typing import Any

import msgspec

MAX_UPLOAD_BYTES = 16 * 2**20
"""Bytes of a file that is uploaded: as much as the reader of JSON takes."""
_MAX_CHARACTERS = 1000
"""Characters of a text. Chosen by eye."""
_MAX_COORDINATE = 1e9
"""Of a camera, in the browser's coordinates. Chosen by eye."""
_MAX_WINDOW_SIDE = 16_384
"""Pixels of a browser's window. A round number beyond any screen."""
_MAX_UPLOAD_PARTS = 1024
"""Parts of one upload, at most. A round number."""
_MAX_UPLOADS = 4
"""Uploads at once. Chosen by eye."""

Receive = Callable[[], Awaitable[Any]]


class Gate:
    """The messages of one connection."""

    def __init__(self) -> None:
        self._uploads: dict[str, int] = {}
        """Bytes that are still to come, by transfer."""

    def wrap_receive(self, receive: Receive) -> Receive:
        """``receive`` without the messages that are not let through."""

        async def checked() -> Any:
            while True:
                admitted = self.admit(await receive())
                if admitted is not None:
                    return admitted

        return checked

    def admit(self, raw: Any) -> bytes | None:
        """Return a message as it is passed on; None where it is not."""
        if not isinstance(raw, bytes):
            return None
        try:
            message = msgspec.msgpack.decode(raw)
            check = {
                "ViewerCameraMessage": self._camera, "GuiUpdateMessage": self._update,
                "ScenePointerMessage": self._click, "FileTransferStartUpload": self._start, "FileTransferPart": self._part,
            }.get(message.get("type"))  # fmt: skip
            return check(raw, message) if check is not None else None
        except (msgspec.MsgspecError, RecursionError, AttributeError, KeyError, TypeError, ValueError, OverflowError):
            return None

    def _camera(self, raw: bytes, message: dict[str, Any]) -> bytes | None:
        lengths = {"wxyz": 4, "position": 3, "look_at": 3, "up_direction": 3}
        for name, length in lengths.items():
            if len(message[name]) != length or not all(
                _is_number(value, -_MAX_COORDINATE, _MAX_COORDINATE) for value in message[name]
            ):
                return None
        is_turned = abs(math.hypot(*message["wxyz"]) - 1) < 0.01
        sizes = (message["image_width"], message["image_height"])
        has_window = all(_is_number(size, 0, _MAX_WINDOW_SIDE) for size in sizes)
        return raw if is_turned and has_window and _is_number(message["fov"], 1e-3, math.pi - 1e-3) else None

    def _click(self, raw: bytes, message: dict[str, Any]) -> bytes | None:
        (place,) = message["screen_pos"]
        ends = (message["ray_origin"], message["ray_direction"])
        has_ray = all(len(end) == 3 and all(_is_number(each, -_MAX_COORDINATE, _MAX_COORDINATE) for each in end) for end in ends)
        is_inside = len(place) == 2 and all(_is_number(share, 0, 1) for share in place)
        return raw if message["event_type"] == "click" and message["modifier"] is None and has_ray and is_inside else None

    def _update(self, raw: bytes, message: dict[str, Any]) -> bytes | None:
        if not _is_text(message["uuid"]) or set(message["updates"]) != {"value"}:
            return None
        value = message["updates"]["value"]
        return raw if _is_number(value, -_MAX_COORDINATE, _MAX_COORDINATE) or _is_text(value) else None

    def _start(self, raw: bytes, message: dict[str, Any]) -> bytes | None:
        size, parts, transfer = message["size_bytes"], message["part_count"], message["transfer_uuid"]
        texts = ("source_component_uuid", "transfer_uuid", "filename", "mime_type")
        if not all(isinstance(message[name], str) for name in texts) or not _is_text(transfer):
            return None
        if len(self._uploads) >= _MAX_UPLOADS or transfer in self._uploads:
            return None
        if not (_is_whole(size, 1, MAX_UPLOAD_BYTES) and _is_whole(parts, 1, _MAX_UPLOAD_PARTS)):
            # Passed on as an empty file, of which the page is told that it cannot be used.
            return msgspec.msgpack.encode({**message, "part_count": 0, "size_bytes": 0})
        self._uploads[transfer] = size
        return raw

    def _part(self, raw: bytes, message: dict[str, Any]) -> bytes | None:
        transfer, content = message["transfer_uuid"], message["content"]
        if (
            not isinstance(content, bytes)
            or transfer not in self._uploads
            or not _is_whole(message["part_index"], 0, _MAX_UPLOAD_PARTS)
        ):
            return None
        self._uploads[transfer] -= len(content)
        left = self._uploads[transfer]
        if left <= 0:
            del self._uploads[transfer]
        return raw if left >= 0 else None


def _is_number(value: object, least: float, most: float) -> bool:
    return isinstance(value, int | float) and least <= value <= most  # not for NaN


def _is_whole(value: object, least: int, most: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and least <= value <= most


def _is_text(value: object) -> bool:
    return isinstance(value, str) and len(value) <= _MAX_CHARACTERS

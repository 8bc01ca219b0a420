"""What a browser may say."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from flowsplat.output.viewer.messages import MAX_UPLOAD_BYTES, Gate

CAMERA: dict[str, Any] = {
    "type": "ViewerCameraMessage", "wxyz": [1.0, 0, 0, 0], "position": [0, 0, 1.5], "look_at": [0, 0, 0],
    "up_direction": [0, -1, 0], "fov": 1.0, "near": 0.01, "far": 1000.0, "image_height": 400, "image_width": 640,
}  # fmt: skip
CLICK: dict[str, Any] = {
    "type": "ScenePointerMessage", "event_type": "click", "ray_origin": [0.0, 0, 0], "ray_direction": [0.0, 0, 1],
    "screen_pos": [[0.5, 0.25]], "modifier": None,
}  # fmt: skip
UPDATE: dict[str, Any] = {"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": 0.5}}
UPLOAD: dict[str, Any] = {
    "type": "FileTransferStartUpload", "source_component_uuid": "a", "transfer_uuid": "t", "filename": "x.json", "mime_type": "",
    "part_count": 2, "size_bytes": 10,
}  # fmt: skip


def passed(message: Any, gate: Gate | None = None) -> Any:
    admitted = (gate or Gate()).admit(msgspec.msgpack.encode(message))
    return None if admitted is None else msgspec.msgpack.decode(admitted)


def part(number: int, content: bytes, transfer: str = "t") -> dict[str, Any]:
    message = {"type": "FileTransferPart", "source_component_uuid": "a", "transfer_uuid": transfer}
    return {**message, "part_index": number, "content": content}


def test_what_the_page_says_gets_through_unchanged():
    assert passed(CAMERA) == CAMERA
    assert passed(CLICK) == CLICK
    for value in (0.5, 3, True, ".mp4", ""):
        message = {**UPDATE, "updates": {"value": value}}
        assert passed(message) == message
    gate = Gate()
    assert passed(UPLOAD, gate) == UPLOAD
    for message in (part(0, b"12345"), part(1, b"67890")):
        assert passed(message, gate) == message


@pytest.mark.parametrize(
    "change",
    [{"fov": 0.0}, {"fov": 3.2}, {"fov": float("nan")}, {"position": [0, 0, float("inf")]}, {"position": [0]},
     {"position": "abc"}, {"wxyz": [0, 0, 0, 0]}, {"image_width": 10**9}, {"image_width": -1}, {"image_width": "x"}],
)  # fmt: skip
def test_cameras_that_are_none_are_dropped(change):
    assert passed({**CAMERA, **change}) is None
    assert passed({name: value for name, value in CAMERA.items() if name not in change}) is None


@pytest.mark.parametrize(
    "change",
    [{"event_type": "rect-select"}, {"ray_origin": None}, {"ray_direction": [0, float("nan"), 1]}, {"screen_pos": []},
     {"screen_pos": [[0.5, 0.5], [0.6, 0.6]]}, {"screen_pos": [[0.5, 2]]}, {"screen_pos": [["a", 0]]}, {"modifier": "x" * 9999}],
)  # fmt: skip
def test_clicks_that_are_none_are_dropped(change):
    assert passed({**CLICK, **change}) is None
    assert passed({name: value for name, value in CLICK.items() if name not in change}) is None


@pytest.mark.parametrize(
    "updates",
    [{"label": "x"}, {"value": 1, "update_cb": []}, {}, {"value": [1]}, {"value": None}, {"value": float("nan")},
     {"value": "x" * 2000}, {"value": 1e300}, [1], "value"],
)  # fmt: skip
def test_only_plain_values_of_controls_are_set(updates):
    assert passed({**UPDATE, "updates": updates}) is None


@pytest.mark.parametrize("kind", ["ShareUrlRequest", "ShareUrlDisconnect", "GuiButtonHoldMessage", "", None, 3])
def test_other_messages_are_dropped(kind):
    """``ShareUrlRequest`` would open the viewer to the world, by a server of viser's makers."""
    assert passed({"type": kind}) is None


@pytest.mark.parametrize("raw", [b"", b"\xc1", b"\x93\x01", b"\x91" * 100_000, b"\xc4\x05x", np.random.default_rng(0).bytes(5000)])
def test_noise_is_dropped(raw):
    assert Gate().admit(raw) is None


def test_text_frames_are_dropped():
    assert Gate().admit("{}") is None


@pytest.mark.parametrize(
    "change", [{"size_bytes": MAX_UPLOAD_BYTES + 1}, {"size_bytes": -1}, {"part_count": 10**9}, {"size_bytes": 0}]
)
def test_too_large_an_upload_arrives_as_an_empty_file(change):
    gate = Gate()
    found = passed({**UPLOAD, **change}, gate)
    assert (found["size_bytes"], found["part_count"], found["filename"]) == (0, 0, "x.json")
    assert passed(part(0, b"12345"), gate) is None


def test_no_more_is_kept_than_was_announced():
    gate = Gate()
    assert passed(part(0, b"1"), gate) is None, "of no upload"
    passed(UPLOAD, gate)
    assert passed(part(0, b"x" * 9), gate) is not None
    assert passed(part(1, b"x" * 9), gate) is None
    assert passed(part(1, b"x"), gate) is None, "it is over"
    for number in range(4):
        assert passed({**UPLOAD, "transfer_uuid": f"{number}"}, gate) is not None
    assert passed({**UPLOAD, "transfer_uuid": "one more"}, gate) is None

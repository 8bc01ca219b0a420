"""A browser without windows: speaks viser's protocol, so that the viewer is tested as a person uses it."""

from __future__ import annotations

import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import viser
import zstandard
from viser import _messages
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

from flowsplat.output.viewer.options import ViewOptions
from flowsplat.output.viewer.server import Viewer
from tests.output.tiny import red

PATIENCE = 150.0
"""Seconds; kernels may have to be compiled."""


def free_port() -> int:
    """A port that no program listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def heed_ctrl_c() -> None:
    """For ``preexec_fn``: where tests run in the background Ctrl-C is ignored, and a child would inherit that."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


class Browser:
    """One client of the viewer at ``port``."""

    def __init__(self, port: int, size: tuple[int, int] = (96, 72)):
        self._socket = connect(
            f"ws://127.0.0.1:{port}", origin=Origin(f"http://127.0.0.1:{port}"), max_size=None, compression=None,
            subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
        )  # fmt: skip
        self.images: list[np.ndarray] = []
        self.depths: list[bytes | None] = []
        self.controls: dict[str, dict[str, Any]] = {}
        self.downloads: dict[str, bytes] = {}
        self.notes: list[str] = []
        self.nodes: set[str] = set()
        self._transfers: dict[str, str] = {}
        self._size = size
        self._camera = {
            "position": np.array([3.0, 3.0, 3.0]), "look_at": np.zeros(3), "up_direction": np.array([0.0, 0.0, 1.0]), "fov": 1.0,
        }  # fmt: skip
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()
        self.look()

    def close(self) -> None:
        self._socket.close()
        self._thread.join(timeout=10)

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # -- what a person does

    def look(self, **camera: Any) -> None:
        """Move the camera: ``position``, ``look_at``, ``up_direction``, ``fov``."""
        with self._lock:
            self._camera |= camera
            now = dict(self._camera)
        z = now["look_at"] - now["position"]
        if not z.any():
            return  # between two messages of one change
        z = z / np.linalg.norm(z)
        y = -now["up_direction"] + (now["up_direction"] @ z) * z
        y = y / np.linalg.norm(y)
        wxyz = viser.transforms.SO3.from_matrix(np.stack([np.cross(y, z), y, z], axis=1)).wxyz
        self._send(_messages.ViewerCameraMessage(
            wxyz=tuple(wxyz), position=tuple(now["position"]), fov=now["fov"], near=0.01, far=1000.0,
            image_height=self._size[1], image_width=self._size[0], look_at=tuple(now["look_at"]),
            up_direction=tuple(now["up_direction"]),
        ))  # fmt: skip

    @property
    def position(self) -> np.ndarray:
        with self._lock:
            return np.array(self._camera["position"])

    @property
    def reach(self) -> float:
        """How far ahead the point lies round which the camera turns."""
        with self._lock:
            return float(np.linalg.norm(self._camera["look_at"] - self._camera["position"]))

    def set(self, label: str, value: Any) -> None:
        """Set a control, which shows it at once: the viewer answers only where it shall show something else."""
        control = self.wait(lambda: self.controls.get(label))
        control["value"] = value
        self._send(_messages.GuiUpdateMessage(control["uuid"], {"value": value}))

    def click(self, label: str) -> None:
        """Press a button, by the label that it began with."""
        self.set(label, True)

    def double_click(self, x: float, y: float) -> None:
        """On the scene, at shares of the window."""
        for _ in range(2):
            self._send(_messages.ScenePointerMessage("click", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), ((x, y),), None))

    def value(self, label: str) -> Any:
        """What a control shows."""
        return self.controls[label].get("value")

    def upload(self, label: str, name: str, content: bytes) -> None:
        """Give a file to an upload button."""
        uuid = self.wait(lambda: self.controls.get(label))["uuid"]
        self._send(_messages.FileTransferStartUpload(uuid, "t1", name, "application/json", 1, len(content)))
        self._send(_messages.FileTransferPart(uuid, "t1", 0, content))

    def wait(self, what: Callable[[], Any]) -> Any:
        """Until something is true; its value."""
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            if found := what():
                return found
            time.sleep(0.02)
        raise AssertionError("waited in vain")

    def settled(self, quiet: float = 0.8) -> np.ndarray:
        """The last image, once no new one has come for a while."""
        self.wait(lambda: self.images)
        count, since = len(self.images), time.monotonic()
        while time.monotonic() - since < quiet:
            time.sleep(0.05)
            if len(self.images) != count:
                count, since = len(self.images), time.monotonic()
        return self.images[-1]

    # -- the protocol

    def _send(self, message: Any) -> None:
        self._socket.send(msgspec.msgpack.encode(message.as_serializable_dict()))

    def _listen(self) -> None:
        try:
            for frame in self._socket:
                assert isinstance(frame, bytes)
                packed = int.from_bytes(frame[8:16], "little")
                content = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(frame[16 : 16 + packed]))
                for message in content["messages"]:
                    self._take(message)
        except ConnectionClosed:
            pass

    def _take(self, message: dict[str, Any]) -> None:
        kind = message["type"]
        if kind == "BackgroundImageMessage" and message["rgb_data"] is not None:
            image = cv2.imdecode(np.frombuffer(message["rgb_data"], np.uint8), cv2.IMREAD_COLOR)
            self.depths.append(message["depth_data"])
            self.images.append(image[..., ::-1])
        elif kind == "GuiUpdateMessage":
            for control in self.controls.values():
                if control["uuid"] == message["uuid"]:
                    control.update(message["updates"])
        elif kind.startswith("Gui") and "props" in message:
            name = message["props"].get("label") or f"{kind} {len(self.controls)}"
            self.controls[name] = {"uuid": message["uuid"], "value": message.get("value"), **message["props"]}
        elif kind.startswith("SetCamera"):
            names = {"Position": "position", "LookAt": "look_at", "UpDirection": "up_direction", "Fov": "fov"}
            name = names.get(kind.removeprefix("SetCamera").removesuffix("Message"))
            if name is not None:
                value = message.get(name, message.get("position"))  # as viser calls the up direction, too
                self.look(**{name: value if name == "fov" else np.array(value, np.float64)})
        elif kind == "FileTransferStartDownload":
            self._transfers[message["transfer_uuid"]] = message["filename"]
            self.downloads[message["filename"]] = b""
        elif kind == "FileTransferPart" and message["transfer_uuid"] in self._transfers:
            self.downloads[self._transfers[message["transfer_uuid"]]] += message["content"]
        elif kind == "NotificationShowMessage":
            self.notes.append(f"{message['props']['title']}: {message['props']['body']}")
        elif "name" in message and kind.endswith("Message") and "props" in message:
            self.nodes.add(message["name"])
        elif kind == "RemoveSceneNodeMessage":
            self.nodes.discard(message["name"])


@contextmanager
def viewed(folder: Path) -> Iterator[Browser]:
    """A browser that shows a run in a viewer of its own."""
    port = free_port()
    viewer = Viewer(folder, ViewOptions(port=port))
    try:
        with Browser(port) as browser:
            yield browser
    finally:
        viewer.stop()


def place(image: np.ndarray) -> float:
    """Column of the red object, over the width."""
    return float(np.argwhere(red(image))[:, 1].mean() / image.shape[1])

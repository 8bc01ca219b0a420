"""A studio that is served for a test, what a page asks of it, and a tiny clip."""

from __future__ import annotations

import contextlib
import http.client
import json
import socket
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

import cv2
import numpy as np

from flowsplat.common.files import lease
from flowsplat.images.video import write_mp4
from flowsplat.studio.options import StudioOptions
from flowsplat.studio.server import StudioServer
from tests.output.viewer.browser import free_port

SIZE, FRAMES, FPS = (128, 96), 12, 8.0


def write_clip(path: Path, frames: int = FRAMES) -> Path:
    """A video of a textured wall along which the camera goes, and of a red square that goes the other way."""
    write_mp4(path, draw_shot(0, frames), FPS)
    return path


def write_clip_with_cut(path: Path) -> Path:
    """Two of them, with another wall in the second, whose square is where it was at the beginning of the first."""
    write_mp4(path, draw_shot(0) + draw_shot(1), FPS)
    return path


def draw_shot(seed: int, frames: int = FRAMES) -> list[np.ndarray]:
    """Frames of one wall."""
    rng = np.random.default_rng(seed)
    gray = rng.integers(0, 256, (SIZE[1], 3 * SIZE[0]), dtype=np.uint8)
    gray = cv2.normalize(cv2.GaussianBlur(gray, (0, 0), 1.5), None, 60, 200, cv2.NORM_MINMAX)
    wall = np.stack([gray // 2, gray, gray], -1)
    images = []
    for k in range(frames):
        image = wall[: SIZE[1], k : k + SIZE[0]].copy()
        left = 20 + 2 * k
        image[40:64, left : left + 24] = (230, 20, 20)
        images.append(image)
    return images


class Page:
    """A page that was opened with its token."""

    def __init__(self, port: int, token: str):
        self.port = port
        self.cookie = f"flowsplat_{port}={token}"

    def ask(
        self, method: str, path: str, body: Any = None, *, headers: Mapping[str, str | None] | None = None, raw: bytes | None = None
    ) -> tuple[int, Any, http.client.HTTPMessage]:
        """Status, what was said (JSON where it is some), and headers. A header that is None is left out."""
        own = {"Cookie": self.cookie, "Origin": f"http://127.0.0.1:{self.port}", **(headers or {})}
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        try:
            data = raw if raw is not None else None if body is None else json.dumps(body).encode()
            connection.request(method, path, data, {name: value for name, value in own.items() if value is not None})
            answer = connection.getresponse()
            said = answer.read()
        finally:
            connection.close()
        if answer.headers.get_content_type() == "application/json":
            return answer.status, json.loads(said), answer.headers
        return answer.status, said, answer.headers

    def get(self, path: str) -> Any:
        """What is said where all is well."""
        status, said, _ = self.ask("GET", path)
        assert status == 200, said
        return said

    def do(self, method: str, path: str, body: Any = None) -> Any:
        """What is said where all is well."""
        status, said, _ = self.ask(method, path, body)
        assert status in (200, 201), said
        return said

    def send(self, clip: Path, name: str | None = None) -> tuple[int, Any]:
        """Send a clip."""
        status, said, _ = self.ask("PUT", f"/api/clips?name={quote(name or clip.name, safe='')}", raw=clip.read_bytes())
        return status, said

    def begin_sending(self, name: str, length: int, data: bytes = b"") -> socket.socket:
        """Begin to send a clip, and do not go on."""
        connection = socket.create_connection(("127.0.0.1", self.port), timeout=30)
        head = (
            f"PUT /api/clips?name={name} HTTP/1.1\r\nHost: 127.0.0.1:{self.port}\r\nOrigin: http://127.0.0.1:{self.port}\r\n"
            f"Cookie: {self.cookie}\r\nContent-Length: {length}\r\n\r\n"
        )
        connection.sendall(head.encode() + data)
        return connection

    def wait(self, name: str, what: Callable[[dict[str, Any]], bool], seconds: float = 60.0) -> dict[str, Any]:
        """The scene ``name``, when it is as it should be."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            found: dict[str, Any] = self.get(f"/api/projects/{name}")
            if what(found):
                return found
            time.sleep(0.1)
        raise AssertionError(f"waited in vain: {found}")


@contextlib.contextmanager
def serve(folder: Path, **options: Any) -> Iterator[Page]:
    """A studio in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    with lease(folder):
        server = StudioServer(folder, StudioOptions(port=free_port(), **options))
        try:
            assert server.guard.token is not None
            yield Page(server.guard.port, server.guard.token)
        finally:
            server.stop()


def mark(x: float, y: float, frame: int | str = 0) -> dict[str, float | str]:
    """A click, in a shot of as many frames as the others where it names one (``shot/number``)."""
    shot, _, number = str(frame).rpartition("/")
    return {"x": x, "y": y, "frame": frame, "second": (int(number) + FRAMES * max(int(shot or 1) - 1, 0)) / FPS}


def script(text: str) -> tuple[str, ...]:
    """A program in place of flowsplat: its arguments are ``arguments``, and where a run would be ``out``."""
    begin = (
        "import sys, time, signal, pathlib, json\n"
        "arguments = sys.argv[1:]\n"
        "say = lambda text: print(text, file=sys.stderr, flush=True)\n"
        "out = pathlib.Path(arguments[arguments.index('-o') + 1] if '-o' in arguments else arguments[1])\n"
    )
    return (sys.executable, "-c", begin + text)

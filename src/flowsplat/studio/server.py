"""``flowsplat studio``: serves the page until it is stopped; what runs goes on."""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import secrets
import sys
import threading
import webbrowser
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

from flowsplat.common.errors import InputError, describe_install
from flowsplat.common.files import lease, make_folder, read_text
from flowsplat.common.files.writing import make_writing_error
from flowsplat.common.progress import report
from flowsplat.common.run_paths import RunPaths
from flowsplat.output.viewer.guard import Guard, check_address, is_local
from flowsplat.studio.choices import split_options
from flowsplat.studio.options import StudioOptions
from flowsplat.studio.studio import Studio

if TYPE_CHECKING:
    from tornado.httpserver import HTTPServer

ADVANCE_SECONDS = 0.5
"""Seconds between two looks at what works. Chosen by eye."""
CLIP_THREADS = 2
"""Threads that read clips for the page. Chosen by eye."""
CHUNK_BYTES = 1_000_000
"""Bytes of a clip that are written to disk at a time. A round number."""
TOKEN = ".token"
"""In the folder of the studio: the token of its address. It stays the same, so that an open page finds its server again."""


class StudioServer:
    """A server of a studio in a thread of its own. The caller has the lease of the folder."""

    def __init__(self, folder: Path, options: StudioOptions):
        """Begin to serve.

        Raises:
            InputError: an option cannot be used, tornado is missing, or the address cannot be listened on.
        """
        check_serving(options)
        run_options = split_options(options.run_options)
        self.guard = Guard(options.host, options.port, _keep_token(folder), "studio", "flowsplat studio")
        self.studio = Studio(folder, run_options, round(options.max_upload_gb * 1e9))
        self._pool = ThreadPoolExecutor(CLIP_THREADS)
        self._ready, self._failure = threading.Event(), None  # type: tuple[threading.Event, BaseException | None]
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stopping: asyncio.Event | None = None
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()
        self._ready.wait()
        if self._failure is not None:
            raise self._failure

    def stop(self) -> None:
        """Serve no longer. What runs goes on, and clips on their way are deleted."""
        if self._loop is not None and self._stopping is not None:
            with contextlib.suppress(RuntimeError):  # it has ended by itself
                self._loop.call_soon_threadsafe(self._stopping.set)
        self._thread.join(timeout=20)
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _work(self) -> None:
        try:
            asyncio.run(self._serve())
        except BaseException as error:
            self._failure = error
        finally:
            self._ready.set()

    async def _serve(self) -> None:
        server = self._listen()
        self._loop, self._stopping = asyncio.get_running_loop(), asyncio.Event()
        self._ready.set()
        try:
            while not self._stopping.is_set():
                self.studio.advance()
                with contextlib.suppress(asyncio.TimeoutError, TimeoutError):
                    await asyncio.wait_for(self._stopping.wait(), ADVANCE_SECONDS)
        finally:
            server.stop()
            self.studio.uploads.close()
            await server.close_all_connections()

    def _listen(self) -> HTTPServer:
        from tornado.httpserver import HTTPServer
        from tornado.netutil import bind_sockets
        from tornado.web import Application

        from flowsplat.studio.handlers import MAX_BODY_BYTES, ROUTES, NothingHandler

        made_of = {"studio": self.studio, "guard": self.guard, "pool": self._pool}
        application = Application(
            [(route, handler, made_of) for route, handler in ROUTES], default_handler_class=NothingHandler,
            default_handler_args=made_of, log_function=lambda _: None,
        )  # fmt: skip
        server = HTTPServer(application, max_body_size=MAX_BODY_BYTES, chunk_size=CHUNK_BYTES)
        try:
            server.add_sockets(bind_sockets(self.guard.port, self.guard.host))
        except OSError as error:
            reason = error.strerror or error
            raise InputError(f"Cannot listen on {self.guard.host}, port {self.guard.port} ({reason}).") from error
        return server


def check_serving(options: StudioOptions) -> None:
    """Refuse options that nothing could be served with, and a machine without tornado.

    Raises:
        InputError: names it.
    """
    if not 0 < options.max_upload_gb <= 10_000:
        raise InputError(f"--max-upload-gb is {options.max_upload_gb:g}: give more than 0, and 10000 at most.")
    try:
        import tornado  # noqa: F401 (the one thing that may be missing)
    except ImportError as error:
        raise InputError(f"The studio needs tornado: {describe_install('studio')}.") from error
    check_address(options.host, options.port)


def serve(folder: Path, options: StudioOptions) -> None:
    """Serve a studio until Ctrl-C.

    Args:
        folder: of the studio; it is made.

    Raises:
        InputError: see ``StudioServer``, the folder cannot be that of a studio, or another server has it.
    """
    check_serving(options)
    split_options(options.run_options)
    _make_studio(folder)
    with lease(folder):
        server = StudioServer(folder, options)
        try:
            report(f"The studio in {folder} is at {server.guard.address} - Ctrl-C stops it, and what runs goes on.")
            if not is_local(options.host):
                report("Every computer that reaches this one can open the studio, with this whole address.")
            if options.open_browser and _has_screen():
                webbrowser.open(server.guard.address)
            threading.Event().wait()
        except KeyboardInterrupt:
            report("The studio is stopped. What runs goes on; the same command shows it again.")
        finally:
            server.stop()


def _make_studio(folder: Path) -> None:
    """Make the folder of a studio, unless it is there.

    Raises:
        InputError: it is something else, or cannot be made or written.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder} is a file: flowsplat studio takes the folder where scenes are kept; drop the file on its page.")
    if RunPaths(folder).holds_run:
        raise InputError(f"{folder} is the folder of a run, not of a studio: flowsplat view shows it.")
    try:
        make_folder(folder)
    except InputError as error:
        raise InputError(f"The folder of the studio {folder} cannot be made or written: name another one.") from error


def _has_screen() -> bool:
    return sys.platform in ("darwin", "win32") or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def _keep_token(folder: Path) -> str:
    """Return the token of a studio, which only its owner can read; a new one where there is none.

    Raises:
        InputError: it cannot be written.
    """
    path = folder / TOKEN
    with contextlib.suppress(InputError):
        found = read_text(path, 1000).strip()
        if re.fullmatch(r"[A-Za-z0-9_-]{32,100}", found) and not path.stat().st_mode & 0o077:
            return found
    token = secrets.token_urlsafe(24)
    try:
        path.unlink(missing_ok=True)
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(file, "w") as opened:
            opened.write(token)
    except OSError as error:
        raise make_writing_error(error, path) from error
    return token

"""Answer the page: every request passes the guard first, and every refusal is a sentence."""

from __future__ import annotations

import asyncio
import base64
import mimetypes
import os
import re
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from http import HTTPStatus
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import quote

import msgspec
from tornado import web
from tornado.httputil import HTTPHeaders

from flowsplat.common.errors import InputError, one_line
from flowsplat.images.colors import object_color
from flowsplat.images.html import encode
from flowsplat.output.viewer.guard import Guard
from flowsplat.studio.choices import (
    LARGE,
    PRESETS,
    Choices,
    first_choices,
    list_cut,
    name_frame,
    read_choices,
    read_config,
    split_frame,
)
from flowsplat.studio.clips import FRAME_QUALITY, CutClip, Looks, OpenClip, check_clip, draw_masks, look
from flowsplat.studio.project import Project
from flowsplat.studio.results import SERVED, pack_folder
from flowsplat.studio.studio import Studio, delete
from flowsplat.studio.tasks import KILL_SECONDS
from flowsplat.studio.uploads import Refusal, Upload

T = TypeVar("T")

ASSETS = Path(__file__).parent / "assets"
SHEET = "filming.html"
"""How to film, with a style of its own and no script."""
MAX_BODY_BYTES = 1_000_000
"""Of what the page says, clips excepted. A round number."""

MAX_SENTENCE_LENGTH = 500
"""Characters of what the page says at a time. Chosen by eye."""
COLORS = 12
"""Of objects, that the page knows. Chosen by eye."""

_PAGE_POLICY = "; ".join((
    "default-src 'none'", "script-src 'self'", "style-src 'self'", "img-src 'self' data: blob:", "media-src 'self' blob:",
    "connect-src 'self'", "frame-src 'self'", "base-uri 'none'", "form-action 'none'", "frame-ancestors 'none'",
))  # fmt: skip
_PLAYER_POLICY = "sandbox allow-scripts allow-downloads allow-pointer-lock; frame-ancestors 'self'"
"""Of a page that plays a scene: it may run its script, and reaches nothing of the studio."""
_REPORT_POLICY = "connect-src 'none'; form-action 'none'; base-uri 'none'; frame-ancestors 'self'"
_FILE_POLICY = "sandbox; default-src 'none'; img-src 'self'; media-src 'self'; style-src 'unsafe-inline'"

_VIDEO_TYPES = {".mp4": "video/mp4", ".m4v": "video/mp4", ".mov": "video/mp4", ".webm": "video/webm", ".mkv": "video/x-matroska"}
"""QuickTime's files are those of MP4 in another coat, and browsers play them under that name."""


def read_frame(text: str) -> int | str:
    """Return the frame that an address names, as marks name it."""
    return name_frame(*split_frame(text))


def shorten(text: str) -> str:
    """Return the beginning of a sentence that is too long for the page: what was sent may stand in it."""
    return text if len(text) <= MAX_SENTENCE_LENGTH else f"{text[:MAX_SENTENCE_LENGTH]} ..."


class _Headers:
    """Headers of a request as the guard reads them."""

    def __init__(self, headers: HTTPHeaders):
        self._headers = headers

    def get_all(self, name: str) -> list[str]:
        return self._headers.get_list(name)


class Handler(web.RequestHandler):
    """What all requests have in common."""

    studio: Studio
    guard: Guard
    pool: ThreadPoolExecutor

    def initialize(self, studio: Studio, guard: Guard, pool: ThreadPoolExecutor, **_: Any) -> None:
        """Take what the server is made of."""
        self.studio, self.guard, self.pool = studio, guard, pool

    def set_default_headers(self) -> None:
        """What every answer says to a browser."""
        self.clear_header("Server")
        for name, value in {
            "Content-Security-Policy": _FILE_POLICY, "Cross-Origin-Opener-Policy": "same-origin",
            "Cross-Origin-Resource-Policy": "same-origin", "Referrer-Policy": "no-referrer", "X-Content-Type-Options": "nosniff",
            "X-Frame-Options": "DENY", "Cache-Control": "no-store",
        }.items():  # fmt: skip
            self.set_header(name, value)

    def prepare(self) -> None:
        """Refuse what the guard refuses, before a byte of the body is read."""
        changes = self.request.method not in ("GET", "HEAD")
        reason = self.guard.refusal(self.request.uri or "/", _Headers(self.request.headers), changes)
        if reason is not None:
            self.refuse(HTTPStatus.FORBIDDEN, reason)

    def check_xsrf_cookie(self) -> None:
        """The guard has asked for the page's own origin instead."""

    def refuse(self, status: int, message: str) -> None:
        """Answer with a sentence, which names files as they lie in the studio."""
        self.set_status(status)
        self.answer({"error": shorten(one_line(message).replace(f"{self.studio.folder}{os.sep}", ""))})

    def answer(self, value: Any) -> None:
        """Answer with JSON."""
        self.set_header("Content-Type", "application/json")
        self.finish(msgspec.json.encode(value))

    def write_error(self, status_code: int, **about: Any) -> None:
        """Answer what went wrong: a sentence where it was meant for people."""
        error = (about.get("exc_info") or (None, None, None))[1]
        if isinstance(error, Refusal):
            self.refuse(error.status, str(error))
        elif isinstance(error, InputError):
            self.refuse(HTTPStatus.BAD_REQUEST, str(error))
        elif isinstance(error, web.HTTPError):
            self.refuse(status_code, f"{self._reason}.")
        elif isinstance(error, OSError):
            self.refuse(
                HTTPStatus.INSUFFICIENT_STORAGE, f"The studio's folder cannot be read or written: {error.strerror or error}."
            )
        else:
            self.refuse(HTTPStatus.INTERNAL_SERVER_ERROR, f"That did not work here ({type(error).__name__}).")

    def log_exception(self, *about: Any) -> None:
        """Only what nobody has foreseen is for the terminal."""
        if not isinstance(about[1], InputError | web.HTTPError | OSError):
            super().log_exception(*about)

    def body(self) -> Any:
        """Return the JSON that was sent.

        Raises:
            InputError: it is none.
        """
        try:
            return msgspec.json.decode(self.request.body)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
            raise InputError("The page has sent what cannot be read.") from error

    async def aside(self, function: Callable[..., T], *arguments: Any) -> T:
        """Call what takes long in another thread."""
        return await asyncio.get_running_loop().run_in_executor(self.pool, function, *arguments)


class PageHandler(Handler):
    """The page itself, its style and script, and the sheet on filming."""

    def get(self, name: str) -> None:
        """Send a file of ``assets``."""
        file = ASSETS / (name or "studio.html")
        kinds = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}
        self.set_header("Content-Type", f"{kinds[file.suffix]}; charset=utf-8")
        self.set_header("Content-Security-Policy", _FILE_POLICY if name == SHEET else _PAGE_POLICY)
        if self.get_query_argument("token", None) is not None:
            self.set_header("Set-Cookie", self.guard.cookie)
        self.finish(file.read_bytes())


class ListHandler(Handler):
    """All scenes."""

    def get(self) -> None:
        """Send a summary of each, and how large a clip may be."""
        self.answer({"projects": self.studio.summarize(), "max_bytes": self.studio.uploads.max_bytes})


@web.stream_request_body
class ClipHandler(Handler):
    """A clip that comes."""

    _upload: Upload | None = None

    def prepare(self) -> None:
        """Begin to receive it, or refuse it before anything was."""
        super().prepare()
        if self.request.method != "PUT" or self._finished:
            return
        length = self.request.headers.get("Content-Length", "")
        size = int(length) if re.fullmatch(r"\d{1,15}", length) else None
        try:
            self._upload = self.studio.uploads.begin(self._name(), size)
        except Refusal as refusal:
            self.refuse(refusal.status, str(refusal))
            return
        connection: Any = self.request.connection
        connection.set_max_body_size(self.studio.uploads.max_bytes + 1)

    def _name(self) -> str:
        """Return what the clip is called, as it was sent: tornado would make another name of one that holds control characters."""
        return b"".join(self.request.query_arguments.get("name", [])[-1:]).decode(errors="replace")

    def data_received(self, chunk: bytes) -> None:
        """Keep a piece."""
        if self._upload is None or self._finished:
            return
        if self._upload not in self.studio.uploads.under_way:  # it was silent for too long
            self.refuse(HTTPStatus.REQUEST_TIMEOUT, "The clip came too slowly.")
            return
        try:
            self._upload.write(chunk)
        except Refusal as refusal:
            self._drop()
            self.refuse(refusal.status, str(refusal))

    async def put(self) -> None:
        """All is there: look at it, and make a project of it."""
        upload = self._upload
        assert upload is not None
        try:
            upload.finish()
            poster = upload.place.parent / ".poster.jpg"  # no clip can be called so
            options = read_config([*self.studio.run_options, *list_cut(first_choices(), LARGE)]).input
            opened = await self.aside(check_clip, upload.place, options, poster)
            project = Project.create(self.studio.folder, upload.name, upload.place)
            poster.rename(project.poster)
            opened.move(project.clip)
            self.studio.clips.keep(project.clip, options, opened)
            self.studio.add(project)
        finally:
            self._drop()
        self.set_status(HTTPStatus.CREATED)
        self.answer(self.studio.describe(project))

    def on_connection_close(self) -> None:
        """The browser has gone."""
        self._drop()
        super().on_connection_close()

    def on_finish(self) -> None:
        """Whatever happened, nothing is left."""
        self._drop()

    def _drop(self) -> None:
        if self._upload is not None:
            self._upload.close()
            self._upload = None


class ProjectHandler(Handler):
    """One scene."""

    def get(self, name: str) -> None:
        """Send all that the page shows of it."""
        self.answer(self.studio.describe(self.studio.project(name)))

    async def delete(self, name: str) -> None:
        """Delete it with all that belongs to it."""
        project = self.studio.project(name)
        gone = self.studio.remove(project)
        ends = time.monotonic() + KILL_SECONDS
        while not gone():
            if time.monotonic() > ends:
                self.studio.add(project)
                raise InputError("Its process does not end: try again.")
            await asyncio.sleep(0.05)
        await self.aside(delete, project.folder)
        self.answer({})


class ClipReader(Handler):
    """What needs the clip of a project as it is cut."""

    async def open(self, project: Project, choices: Choices) -> OpenClip:
        """Return it as large as any preset takes it: which frames there are does not depend on the size."""
        options = read_config([*self.studio.run_options, *list_cut(choices, LARGE)]).input
        try:
            return await self.aside(self.studio.clips.open, project.clip, options)
        except InputError as error:
            raise InputError(str(error).replace(str(project.clip), project.name)) from error

    async def open_cut(self, project: Project) -> CutClip:
        """Return it in its shots, where each becomes a scene."""
        choices = project.choices
        await self.open(project, choices)  # which words what is wrong with it
        config = read_config([*self.studio.run_options, *list_cut(choices, LARGE)])
        shots = project.shots
        spans = None if not project.is_cut_fixed else [(shot.start, shot.end) for shot in shots or ()]
        return await self.aside(self.studio.clips.cut, project.clip, config, choices.get("shots") != "off", spans)

    async def look(self, project: Project) -> Looks:
        """Return what there is to know before a run."""
        return await self.aside(look, await self.open_cut(project), project.choices, self.studio.run_options)


class ChoicesHandler(ClipReader):
    """What is chosen."""

    async def put(self, name: str) -> None:
        """Set it; what cannot be is refused, and what was chosen before stays."""
        project = self.studio.project(name)
        choices = read_choices(self.body())
        await self.open(project, choices)
        self.studio.choose(project, choices)
        self.answer(self.studio.describe(project))


class LookHandler(ClipReader):
    """What there is to know before a run: frames and times."""

    async def get(self, name: str) -> None:
        """Send it; places that were clicked on frames which the cut has no more are gone then."""
        project = self.studio.project(name)
        looks = await self.look(project)
        lost = self.studio.fit_marks(project, dict(looks.frames))
        self.answer({
            "frames": looks.frames, "shots": looks.shots, "has_cuts": looks.has_cuts, "num_frames": looks.num_frames,
            "duration": looks.duration, "notes": looks.notes, "lost": lost,
            "choices": project.choices,
            "colors": [f"#{bytes(object_color(number)).hex()}" for number in range(1, COLORS + 1)],
            "estimates": {preset: {"says": str(looks.estimates[preset]), "seconds": looks.estimates[preset].expected}
                          for preset in PRESETS},
        })  # fmt: skip


class FrameHandler(ClipReader):
    """A frame as it is cut."""

    async def get(self, name: str, number: str) -> None:
        """Send it as JPEG."""
        project = self.studio.project(name)
        opened = await self.open_cut(project)
        image = await self.aside(opened.frame, read_frame(number))
        self.set_header("Content-Type", "image/jpeg")
        self.finish(await self.aside(encode, image, FRAME_QUALITY))


class MasksHandler(ClipReader):
    """What the clicks on a frame mean."""

    async def post(self, name: str, number: str) -> None:
        """Send colors on nothing, and how much of the image each object is."""
        project = self.studio.project(name)
        choices = project.choices
        opened = await self.open_cut(project)
        options = read_config([*self.studio.run_options, *list_cut(choices)]).input
        image, shares = await self.aside(draw_masks, opened, options, choices, read_frame(number))
        self.answer({"image": f"data:image/png;base64,{base64.b64encode(image).decode()}", "shares": shares})


class ActionHandler(ClipReader):
    """What is done with a scene."""

    async def post(self, name: str, action: str) -> None:
        """Do it, and send the scene as it is then."""
        project = self.studio.project(name)
        if action == "run":
            looks = await self.look(project)
            if self.studio.fit_marks(project, dict(looks.frames)):
                raise InputError("Some places that you clicked are on frames that the cut leaves out: look at them again.")
            self.studio.ask_run(project, looks.expected)
        elif action == "stop":
            self.studio.stop(project)
        elif action == "copy":
            project = self.studio.copy(project)
        else:
            value = self.body()
            wanted, shot = (str(value.get(name) or "") if isinstance(value, dict) else "" for name in ("to", "shot"))
            (self.studio.ask_export if action == "export" else self.studio.ask_render)(project, wanted, shot)
        self.studio.advance()
        self.answer(self.studio.describe(project))


class FileHandler(Handler, web.StaticFileHandler):
    """A file of a project, or a piece of one: videos are asked for in pieces."""

    def initialize(self, studio: Studio, guard: Guard, pool: ThreadPoolExecutor, **_: Any) -> None:  # type: ignore[override]
        """Take what the server is made of."""
        Handler.initialize(self, studio, guard, pool)
        web.StaticFileHandler.initialize(self, str(studio.folder))

    async def head(self, name: str, path: str) -> None:  # type: ignore[override]
        """Send what would be said of it."""
        await self.get(name, path, include_body=False)

    async def get(self, name: str, path: str, include_body: bool = True) -> None:  # type: ignore[override]
        """Send it, where it is one of those that the page shows."""
        project = self.studio.project(name)
        if not SERVED.fullmatch(path):
            raise web.HTTPError(HTTPStatus.NOT_FOUND)
        self.root = str(project.folder)
        await web.StaticFileHandler.get(self, path, include_body)

    def validate_absolute_path(self, root: str, absolute_path: str) -> str | None:
        """Refuse what leads out of the project, by a link, too."""
        found = super().validate_absolute_path(root, absolute_path)
        if found is not None and not os.path.realpath(found).startswith(os.path.realpath(root) + os.sep):
            raise web.HTTPError(HTTPStatus.NOT_FOUND)
        return found

    def compute_etag(self) -> str | None:
        """None: that would read the whole file, and when it was changed tells as much."""
        return None

    def get_content_type(self) -> str:
        """Of a clip one that a browser may play, and never a page, whatever it is called."""
        if self.path.startswith("clip/"):
            return _VIDEO_TYPES.get(Path(self.path).suffix.lower(), "application/octet-stream")
        return mimetypes.guess_type(self.path)[0] or "application/octet-stream"

    def set_extra_headers(self, path: str) -> None:
        """Say what a browser may do with it."""
        if path.endswith(".html") and not path.startswith("clip/"):
            self.set_header("Content-Security-Policy", _PLAYER_POLICY if "/export/" in path else _REPORT_POLICY)
            self.set_header("X-Frame-Options", "SAMEORIGIN")
        if self.get_query_argument("download", None) is not None or path.startswith("downloads/"):
            served = SERVED.fullmatch(path)
            names = [Path(self.root).name, served["shot"] if served is not None else None, Path(path).name]
            name = "-".join(each for each in names if each)
            self.set_header("Content-Disposition", f"attachment; filename*=UTF-8''{quote(name)}")


class PackHandler(Handler):
    """An export that is a folder."""

    async def get(self, name: str, to: str, shot: str | None) -> None:
        """Pack it, and lead to the packed file."""
        project = self.studio.project(name)
        packed = await self.aside(pack_folder, project, to, shot or "")
        self.redirect(f"/files/{project.id}/downloads/{quote(packed.name)}?v={packed.stat().st_mtime_ns:x}")


class NothingHandler(Handler):
    """All other addresses."""

    def prepare(self) -> None:
        """There is nothing."""
        super().prepare()
        if not self._finished:
            self.refuse(HTTPStatus.NOT_FOUND, "There is nothing here.")


_ID = r"([a-z0-9][a-z0-9-]{0,62})"
_FRAME = r"((?:[1-9][0-9]{0,3}/)?[0-9]{1,5})"
PAGE_FILES = sorted(path.name for path in ASSETS.iterdir() if path.suffix in (".css", ".js") or path.name == SHEET)
"""What the start page needs, and the sheet on filming."""
ROUTES: list[tuple[str, type[Handler]]] = [
    (rf"/(|{'|'.join(re.escape(name) for name in PAGE_FILES)})", PageHandler),
    (r"/api/projects", ListHandler),
    (r"/api/clips", ClipHandler),
    (rf"/api/projects/{_ID}", ProjectHandler),
    (rf"/api/projects/{_ID}/choices", ChoicesHandler),
    (rf"/api/projects/{_ID}/look", LookHandler),
    (rf"/api/projects/{_ID}/frames/{_FRAME}", FrameHandler),
    (rf"/api/projects/{_ID}/masks/{_FRAME}", MasksHandler),
    (rf"/api/projects/{_ID}/(run|stop|copy|export|render)", ActionHandler),
    (rf"/files/{_ID}/(.+)", FileHandler),
    (rf"/pack/{_ID}/([a-z0-9_-]{{1,40}})(?:/([0-9]{{2,5}}))?", PackHandler),
]

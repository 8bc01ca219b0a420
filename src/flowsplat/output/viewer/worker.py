"""The one thread that renders, for all clients in turn.

Kernels must not be called by two threads at once, and two images at the same time would each take twice as long. So
everything that renders comes here: the images that clients need, and longer tasks such as recordings, which advance by
one step between two images.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator

from flowsplat.common.progress import report
from flowsplat.output.viewer.browser_frame import BrowserFrame
from flowsplat.output.viewer.drawing import Drawing, draw
from flowsplat.output.viewer.session import ImageJob, Session
from flowsplat.output.viewer.source import Source

SendImage = Callable[[ImageJob, Drawing], None]
"""Sends an image to its client."""

_MODEL_CHECK_INTERVAL = 1.0
"""Seconds between two looks at whether there is a newer model. Chosen by eye."""
_ACTIVE_WAIT, _IDLE_WAIT = 0.015, 0.25
"""Seconds to wait for something to do, while a client may soon need an image and while none does. Chosen by eye."""


class Worker:
    """Renders for sessions until it is stopped. ``lock`` guards the sessions; leave it with ``change``."""

    def __init__(self, source: Source, reloaded: Callable[[], None] = lambda: None):
        """``reloaded`` is called after a newer model was read."""
        self._source, self._reloaded = source, reloaded
        self._scene, self._browser = source.scene, BrowserFrame(source.scene.similarity)
        self._sessions: dict[int, tuple[Session, SendImage]] = {}
        self._turns: deque[int] = deque()
        self._tasks: deque[tuple[int, Iterator[None]]] = deque()
        self._condition = threading.Condition(threading.RLock())
        self._stopping = False
        self._watched, self._trouble = float("-inf"), ""
        self._thread = threading.Thread(target=self._run, name="flowsplat viewer", daemon=True)

    def start(self) -> None:
        """Begin to render."""
        self._thread.start()

    def stop(self) -> None:
        """End after the image that is being rendered."""
        with self._condition:
            self._stopping = True
            self._condition.notify_all()
        if self._thread.is_alive():
            self._thread.join(timeout=30)

    @contextlib.contextmanager
    def change(self) -> Iterator[None]:
        """Change sessions in this block; the worker looks at them afterwards."""
        with self._condition:
            yield
            self._condition.notify_all()

    def add(self, client: int, session: Session, show: SendImage) -> None:
        """A client is there."""
        with self.change():
            self._sessions[client] = (session, show)
            self._turns.append(client)

    def remove(self, client: int) -> None:
        """A client left, and with it what it had begun."""
        with self.change():
            self._sessions.pop(client, None)
            if client in self._turns:
                self._turns.remove(client)
            for owner, task in list(self._tasks):
                if owner == client:
                    self._tasks.remove((owner, task))
                    self._close(task)

    def begin(self, client: int, task: Iterator[None]) -> None:
        """Take on a task of a client: it may render between two of its ``yield``."""
        with self.change():
            self._tasks.append((client, task))

    # -- in the worker's thread

    def _run(self) -> None:
        while not self._stopping:
            self._watch()
            found = self._next_job()
            if found is not None:
                self._serve(*found)
            if not self._advance() and found is None:
                with self._condition:
                    restless = any(session.is_restless(time.monotonic()) for session, _ in self._sessions.values())
                    if not self._stopping:
                        self._condition.wait(_ACTIVE_WAIT if restless else _IDLE_WAIT)
        with self._condition:
            for _, task in self._tasks:
                self._close(task)

    def _watch(self) -> None:
        now = time.monotonic()
        if now - self._watched < _MODEL_CHECK_INTERVAL:
            return
        self._watched = now
        try:
            if self._source.refresh():
                if self._source.scene is not self._scene:
                    self._scene, self._browser = self._source.scene, BrowserFrame(self._source.scene.similarity)
                report(f"Showing a newer model: {self._source.loaded.state}.")
                self._reloaded()
        except Exception as error:  # Without this thread no client would get another image, of what was there before either.
            trouble = f"{type(error).__name__}: {error}"
            if trouble != self._trouble:  # which the next look may meet again
                report(f"A newer model could not be taken up: {trouble}")
            self._trouble = trouble

    def _next_job(self) -> tuple[int, Session, SendImage, ImageJob] | None:
        """Return the first client, in turn,  that needs an image."""
        with self._condition:
            for _ in range(len(self._turns)):
                client = self._turns[0]
                self._turns.rotate(-1)
                session, show = self._sessions[client]
                job = session.job(time.monotonic(), self._source.loaded.number)
                if job is not None:
                    return client, session, show, job
        return None

    def _serve(self, client: int, session: Session, show: SendImage, job: ImageJob) -> None:
        started = time.monotonic()
        try:
            drawing = draw(self._source, self._browser, job.wish)
            with self._condition:
                session.finish_image(job, time.monotonic(), time.monotonic() - started)
                if client not in self._sessions:
                    return
            show(job, drawing)
        except Exception as error:  # One client's bad luck must not end the viewer for the others.
            report(f"An image could not be made: {type(error).__name__}: {error}")
            with self._condition:
                session.finish_image(job, time.monotonic(), time.monotonic() - started)

    def _advance(self) -> bool:
        """Return one step of the task whose turn it is; False where there is none."""
        with self._condition:
            if not self._tasks:  # looked at under the lock: the client of the last one may be leaving
                return False
            client, task = self._tasks.popleft()
        try:
            next(task)
        except StopIteration:
            return True
        except Exception as error:
            report(f"It could not be finished: {type(error).__name__}: {error}")
            return True
        with self._condition:
            if client in self._sessions and not self._stopping:
                self._tasks.append((client, task))
                return True
        self._close(task)
        return True

    @staticmethod
    def _close(task: Iterator[None]) -> None:
        close = getattr(task, "close", None)
        if close is not None:
            close()

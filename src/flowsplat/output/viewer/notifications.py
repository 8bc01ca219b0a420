"""Notifications to a client of the viewer, and callbacks that show its errors there."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import viser

from flowsplat.common.errors import InputError, first_line


class Notifications:
    """Messages to one client, and callbacks that show it what went wrong."""

    def __init__(self, client: viser.ClientHandle):
        self._client = client
        # One thread: viser has 32 for callbacks, and of two clicks the second could be heard first.
        self._thread = ThreadPoolExecutor(1, "client")

    def show(self, title: str, text: str, color: Any = None) -> None:
        """Show a message for some seconds."""
        self._client.add_notification(title, text, auto_close_seconds=8.0, color=color)

    def show_error(self, error: InputError) -> None:
        """Show what did not work, and why."""
        self.show("This did not work", str(error), "red")

    def callback(self, action: Callable[[], None]) -> Callable[[Any], Coroutine[Any, Any, None]]:
        """Return an action as viser calls it: only for events of a client, and an InputError is shown to that client.

        Actions of one client run one after the other, in the order of its events.
        """

        def call() -> None:
            try:
                action()
            except InputError as error:
                self.show_error(error)
            except Exception as error:  # of ours: the client is told, and the viewer goes on
                self.show_error(InputError(f"{type(error).__name__}: {first_line(error)}"))

        async def begin(event: Any) -> None:
            if event.client_id is not None:
                self._thread.submit(call)

        return begin

"""What the viewer says to a person, and how it listens."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import viser

from flowsplat.common.errors import InputError


class Talk:
    """Messages to one client, and callbacks that tell it what went wrong."""

    def __init__(self, client: viser.ClientHandle):
        self._client = client

    def note(self, title: str, text: str, color: Any = None) -> None:
        """Show a message for some seconds."""
        self._client.add_notification(title, text, auto_close_seconds=8.0, color=color)

    def wrong(self, error: InputError) -> None:
        """Tell what did not work, and why."""
        self.note("This did not work", str(error), "red")

    def told(self, action: Callable[[], None]) -> Callable[[Any], None]:
        """An action as viser calls it: only when a person did something, and what is wrong is told to that person."""

        def call(event: Any) -> None:
            if event.client_id is None:
                return
            try:
                action()
            except InputError as error:
                self.wrong(error)

        return call

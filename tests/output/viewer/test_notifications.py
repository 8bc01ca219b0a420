"""What a client's events set off, without a server."""

import asyncio
import threading
from types import SimpleNamespace

from flowsplat.common.errors import InputError
from flowsplat.output.viewer.notifications import Notifications


class Client:
    """Keeps the texts that it is shown."""

    def __init__(self) -> None:
        self.shown: list[str] = []

    def add_notification(self, title: str, text: str, **_: object) -> None:
        self.shown.append(text)


def test_actions_run_in_the_order_of_the_events_and_what_fails_is_shown_to_the_client_who_asked():
    client, order, ended = Client(), [], threading.Event()
    notifications = Notifications(client)

    def slow():
        ended.wait(0.2)  # a second thread would be done before
        order.append("slow")

    def refuses():
        order.append("refuses")
        raise InputError("no keys yet")

    def fails():
        order.append("fails")
        raise ValueError("of two\nlines")

    async def events():
        for action in (slow, refuses, fails):
            await notifications.callback(action)(SimpleNamespace(client_id=1))
        await notifications.callback(lambda: order.append("nobody's"))(SimpleNamespace(client_id=None))
        await notifications.callback(ended.set)(SimpleNamespace(client_id=1))

    asyncio.run(events())
    assert ended.wait(20)
    assert order == ["slow", "refuses", "fails"]
    assert client.shown == ["no keys yet", "ValueError: of two"]

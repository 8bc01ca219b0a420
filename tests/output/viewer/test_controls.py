"""Controls keep what a client asked for, and refuse what they cannot have."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace

import pytest

pytest.importorskip("viser", reason="viser is not installed: pip install 'flowsplat[view]'")

from flowsplat.common.errors import InputError
from flowsplat.output.viewer.controls import Controls


class Handle:
    """A control of viser's, which calls back at once."""

    def __init__(self, value):
        self.value = value

    def on_update(self, call):
        self.call = call

    def set_by(self, client_id, value):
        self.value = value
        asyncio.run(self.call(SimpleNamespace(client_id=client_id)))


@pytest.fixture
def slider():
    """A control with its handle, and the events that it told of."""
    handle, events = Handle(0.0), []
    control = Controls(SimpleNamespace(add_slider=lambda *_, **__: handle)).add_slider("Seconds", min=0.0, max=2.0, step=0.1)

    async def told(event):
        events.append(event.client_id)

    control.on_update(told)
    return control, handle, events


def test_what_a_client_set_is_taken_though_something_else_was_shown_since(slider):
    control, handle, events = slider
    handle.set_by(1, 1.5)
    control.value = 0.2  # of an image that was being drawn
    assert control.value == 0.2
    assert control.take() == 1.5
    assert handle.value == 1.5, "and is shown again"
    handle.set_by(None, 0.4)  # by us
    assert control.take() == 1.5
    assert events == [1, None]


def test_what_cannot_be_is_refused_and_the_control_goes_back(slider):
    control, handle, _ = slider
    handle.set_by(1, 1.5)
    assert control.take() == 1.5
    for bad in (9.0, float("nan"), "1"):
        handle.set_by(1, bad)
        with pytest.raises(InputError, match="Seconds cannot be"):
            control.take()
        assert handle.value == 1.5

"""Who is let through, request by request; ``test_hostile_page`` asks a real browser."""

from __future__ import annotations

import http.client
import socket

import pytest
from websockets.datastructures import Headers

pytest.importorskip("viser", reason="viser is not installed: pip install 'flowsplat[view]'")

from flowsplat.common.errors import InputError
from flowsplat.output.viewer import guard as guarding
from flowsplat.output.viewer.guard import Guard, is_local
from flowsplat.output.viewer.options import ViewOptions
from flowsplat.output.viewer.server import Viewer
from tests.output.viewer.browser import Browser, free_port

HERE = Guard.of("127.0.0.1", 8080)
OPEN = Guard.of("0.0.0.0", 8080)
SOCKET = {"Upgrade": "websocket"}


def asked(guard: Guard, path: str = "/", **headers: str) -> str | None:
    return guard.refusal(path, Headers({name.replace("_", "-"): value for name, value in headers.items()}))


@pytest.mark.parametrize("host", ["localhost:8080", "127.0.0.1:8080", "[::1]:80", "LOCALHOST:8080", "localhost:9000", "localhost"])
def test_its_own_page_is_let_through_also_by_a_tunnel(host):
    assert asked(HERE, Host=host) is None
    assert asked(HERE, Host=host, Origin=f"http://{host.lower()}", **SOCKET) is None


@pytest.mark.parametrize(
    "host",
    ["evil.example:8080", "localhost.evil.example:8080", "evil.example@localhost:8080", "", "127.0.0.1.evil.example",
     "10.0.0.1:8080", "localhost:8080;script-src *", "[::1", "localhost\u00ad:8080"],
)  # fmt: skip
def test_other_names_are_refused(host):
    assert "not served under that name" in asked(HERE, Host=host)


@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", "null", "", "http://localhost:3000", "http://127.0.0.1:8080", "http://localhost:8080.evil.example",
     "file://"],
)  # fmt: skip
def test_other_pages_are_refused(origin):
    """Those of other ports of this machine, too, and of a name of it that is not the page's own."""
    assert "Another page" in asked(HERE, Host="localhost:8080", Origin=origin, **SOCKET)
    assert "Another page" in asked(HERE, Host="localhost:8080", Origin=origin)


def test_messages_need_an_origin_and_nothing_may_come_twice():
    assert "Another page" in asked(HERE, Host="localhost:8080", **SOCKET)
    twice = Headers([("Host", "localhost:8080"), ("Host", "localhost:8080")])
    assert HERE.refusal("/", twice) is not None
    assert HERE.refusal("/", Headers()) is not None
    origins = Headers([("Host", "localhost:8080"), ("Origin", "http://localhost:8080"), ("Origin", "http://evil.example")])
    assert HERE.refusal("/", origins) is not None


def test_another_page_may_not_frame_it_or_load_it_as_a_script():
    for into in ("iframe", "script", "image", "empty"):
        assert asked(HERE, Host="localhost:8080", Sec_Fetch_Site="cross-site", Sec_Fetch_Dest=into) is not None
        assert asked(HERE, Host="localhost:8080", Sec_Fetch_Site="same-site", Sec_Fetch_Dest=into) is not None
    assert asked(HERE, Host="localhost:8080", Sec_Fetch_Site="cross-site", Sec_Fetch_Dest="document") is None
    said = HERE.headers("/", Headers({"Host": "localhost:8080"}))
    assert said["X-Frame-Options"] == "DENY"
    assert "frame-ancestors 'none'" in said["Content-Security-Policy"]
    assert "Set-Cookie" not in said


def test_only_addresses_that_others_reach_have_a_token():
    for host in ("127.0.0.1", "127.0.0.2", "::1", "localhost"):
        assert is_local(host)
        assert Guard.of(host, 8080).token is None
    for host in ("0.0.0.0", "::", "192.168.1.5", "here.example"):
        assert len(Guard.of(host, 8080).token or "") >= 32
    assert OPEN.token != Guard.of("0.0.0.0", 8080).token


def test_the_token_is_asked_for_and_becomes_a_cookie():
    own = {"Host": "192.168.1.5:8080"}
    assert "token" in asked(OPEN, **own)
    assert "token" in asked(OPEN, "/?token=", **own)
    assert "token" in asked(OPEN, f"/?token={OPEN.token}x", **own)
    assert "token" in asked(OPEN, "/?token=\u00e9", **own)
    assert asked(OPEN, f"/?token={OPEN.token}", **own) is None
    cookie = OPEN.headers(f"/?token={OPEN.token}", Headers(own))["Set-Cookie"]
    assert "HttpOnly" in cookie
    value = cookie.split(";")[0]
    assert asked(OPEN, "/", **own, Cookie=f"other=1; {value}") is None
    assert asked(OPEN, "/", **own, Cookie=value, Origin="http://192.168.1.5:8080", **SOCKET) is None
    assert "Another page" in asked(OPEN, "/", **own, Cookie=value, Origin="http://evil.example", **SOCKET)
    assert "token" in asked(OPEN, "/", **own, Cookie="flowsplat_8080=x; =;;")


def test_names_under_which_others_reach_it():
    asking = f"/?token={OPEN.token}"
    for host in ("10.0.0.1", "[fe80::1]:8080", f"{socket.gethostname()}:8080"):
        assert asked(OPEN, asking, Host=host) is None
    assert "name" in asked(OPEN, asking, Host="evil.example:8080")
    named = Guard.of("here.example", 8080)
    assert asked(named, f"/?token={named.token}", Host="here.example:8080") is None
    assert "name" in asked(named, f"/?token={named.token}", Host="10.0.0.1:8080")


def answered(port: int, path: str = "/", **headers: str) -> tuple[int, str]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    try:
        connection.request("GET", path, headers={name.replace("_", "-"): value for name, value in headers.items()})
        response = connection.getresponse()
        return response.status, response.headers.get("Set-Cookie", "")
    finally:
        connection.close()


def test_the_server_that_runs_is_guarded(run_folder):
    port = free_port()
    viewer = Viewer(run_folder, ViewOptions(port=port))
    try:
        assert answered(port)[0] == 200
        assert answered(port, Host="evil.example")[0] == 403
        assert answered(port, Origin="http://evil.example")[0] == 403
        assert answered(port, "/%2e%2e/%2e%2e/etc/passwd")[0] == 404
        key = {"Sec_WebSocket_Version": "13", "Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ=="}
        handshake = {"Connection": "Upgrade", **key, **SOCKET}
        assert answered(port, Origin="http://evil.example", **handshake)[0] == 403
        assert answered(port, **handshake)[0] == 403
        assert answered(port, Host="evil.example", Origin="http://evil.example", **handshake)[0] == 403
        with Browser(port) as browser:
            browser.settled()
    finally:
        viewer.stop()


def test_a_server_that_others_reach_asks_for_its_token(run_folder):
    port = free_port()
    viewer = Viewer(run_folder, ViewOptions(host="0.0.0.0", port=port))
    try:
        assert answered(port)[0] == 403
        status, cookie = answered(port, viewer.guard.query)
        assert status == 200
        assert answered(port, Cookie=cookie.split(";")[0])[0] == 200
    finally:
        viewer.stop()


def test_a_viser_that_cannot_be_guarded_is_not_served(run_folder, monkeypatch):
    """Such as one that starts its server in another way."""
    monkeypatch.setattr(guarding.Guard, "refusal", lambda *_: None)
    port = free_port()
    with pytest.raises(InputError, match="cannot be kept from other pages"):
        Viewer(run_folder, ViewOptions(port=port))
    with pytest.raises(OSError):
        answered(port)

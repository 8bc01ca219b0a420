"""Admit connections to a server of pages that listens on this machine: the viewer, and the studio.

Any page in a browser may open a connection to any port of the machine it is shown on; what keeps it from the server must be done
here. viser (1.1) looks neither at ``Origin`` nor at ``Host`` and has no place to do so, but it starts its server with one call of
``websockets.asyncio.server.serve``: ``guard_server`` takes that call's place while a server starts, and ``is_guarded`` asks the
server that came of it, so that another viser is noticed rather than trusted.

- ``Host`` has to be a name of this machine: a page of another name that has that name resolved to this machine ("DNS rebinding") is
  refused.
- ``Origin`` has to be the page that was opened from here; connections for messages must have one.
- Where others can reach the viewer, and always in the studio, the address holds a random token, which becomes a cookie of the page.
"""

from __future__ import annotations

import contextlib
import errno
import hmac
import http.client
import ipaddress
import re
import secrets
import socket
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

from flowsplat.common.errors import InputError
from flowsplat.output.viewer.messages import Gate

LOOPBACK = frozenset({"localhost", "127.0.0.1", "::1"})
WILDCARDS = frozenset({"0.0.0.0", "::", ""})
_HOST = re.compile(r"(?P<name>\[[0-9a-f:.]+\]|[a-z0-9._-]+)(:[0-9]{1,5})?")
_NOBODY = "nobody.invalid"
"""A name that no machine has (RFC 2606)."""

_POLICY = "; ".join((
    "default-src 'none'", "script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:", "worker-src 'self' blob: data:",
    "style-src 'self' 'unsafe-inline'", "img-src 'self' data: blob:", "media-src 'self' data: blob:", "font-src 'self' data:",
    "connect-src 'self' data: blob: {sockets}", "base-uri 'none'", "form-action 'none'", "frame-ancestors 'none'",
))  # fmt: skip

_STARTING = threading.Lock()


@dataclass(frozen=True)
class Guard:
    """What a connection must bring.

    Attributes:
        host: the address that is listened on.
        port: the port of it.
        token: what the address of the page ends with; None where only this machine reaches it.
        what: is served, in words for who is refused.
        command: that serves it.
    """

    host: str
    port: int
    token: str | None
    what: str = "viewer"
    command: str = "flowsplat view"

    @staticmethod
    def of(host: str, port: int) -> Guard:
        """Return the guard of an address: with a new token where others can reach it."""
        return Guard(host, port, None if is_local(host) else secrets.token_urlsafe(24))

    @property
    def query(self) -> str:
        """What comes behind the address of the page."""
        return "" if self.token is None else f"/?token={self.token}"

    @property
    def address(self) -> str:
        """What to open in a browser."""
        shown = "localhost" if self.host in LOOPBACK | WILDCARDS else self.host
        return f"http://{f'[{shown}]' if ':' in shown else shown}:{self.port}{self.query}"

    def refusal(self, path: str, headers: Any, changes: bool = False) -> str | None:
        """Why a request is refused, in a sentence; None where it is not.

        Args:
            path: what is asked for, with its query.
            headers: of the request, with ``get_all``.
            changes: whether it asks to change something: then it must say which page it comes from.
        """
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or not self._is_ours(hosts[0]):
            return f"This {self.what} is not served under that name: open the address that {self.command} has printed."
        needs_origin = changes or bool(headers.get_all("Upgrade"))
        own = {f"http://{hosts[0].lower()}", f"https://{hosts[0].lower()}"}
        if len(origins) > 1 or any(origin.lower() not in own for origin in origins) or (needs_origin and not origins):
            return f"Another page may not use this {self.what}."
        site, into = (headers.get_all(f"Sec-Fetch-{part}") for part in ("Site", "Dest"))
        if site and site[0] not in ("same-origin", "none") and into and into[0] != "document":
            return f"Another page may not show this {self.what}."
        if self.token is not None and not self._has_token(path, headers):
            return f"This {self.what} needs its token: open the whole address that {self.command} has printed."
        return None

    def headers(self, path: str, headers: Any) -> dict[str, str]:
        """Return what an answer to an allowed request says to the browser."""
        host = headers.get_all("Host")[0]
        found = {
            "Content-Security-Policy": _POLICY.format(sockets=f"ws://{host} wss://{host}"),
            "Cross-Origin-Opener-Policy": "same-origin",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "X-Frame-Options": "DENY",
        }
        if self.token is not None and self._answer(path) is not None:
            found["Set-Cookie"] = self.cookie
        return found

    @property
    def cookie(self) -> str:
        """The header that gives the token to the browser."""
        return f"{self._cookie}={self.token}; HttpOnly; SameSite=Lax; Path=/"

    @property
    def _cookie(self) -> str:
        return f"flowsplat_{self.port}"  # a machine's ports share their cookies

    def _is_ours(self, host: str) -> bool:
        found = _HOST.fullmatch(host.lower())
        if found is None:
            return False
        name = found["name"].strip("[]")
        if name in LOOPBACK or name == self.host.lower():
            return True
        if self.host not in WILDCARDS:
            return False
        here = socket.gethostname().lower()
        return name in (here, f"{here}.local") or _is_address(name)

    def _answer(self, path: str) -> str | None:
        return next(iter(parse_qs(urlsplit(path).query).get("token", ())), None)

    def _has_token(self, path: str, headers: Any) -> bool:
        found = [self._answer(path)]
        for line in headers.get_all("Cookie"):
            with contextlib.suppress(CookieError):
                cookies = SimpleCookie(line)
                found.append(cookies[self._cookie].value if self._cookie in cookies else None)
        assert self.token is not None
        return any(value is not None and hmac.compare_digest(value.encode(), self.token.encode()) for value in found)


def check_address(host: str, port: int) -> None:
    """Refuse an address that cannot be listened on; viser would silently take another port.

    Raises:
        InputError: names the option to change.
    """
    if not 1 <= port <= 65535:
        raise InputError(f"There is no port {port}: give --port a number from 1 to 65535.")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                raise InputError(f"Port {port} is in use: choose another one with --port.") from error
            reason = error.strerror or error
            raise InputError(f"Cannot listen on {host}, port {port} ({reason}): choose others with --host and --port.") from error


def is_local(host: str) -> bool:
    """Return whether only this machine reaches what listens there."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


@contextlib.contextmanager
def guard_server(guard: Guard) -> Iterator[None]:
    """A server that viser starts in this block lets only through what ``guard`` and ``Gate`` admit."""
    from websockets.asyncio import server

    plain = server.serve

    def serve(handler: Callable[..., Any], *arguments: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        def admit(connection: Any, request: Any) -> Any:
            reason = guard.refusal(request.path, request.headers)
            if reason is not None:
                return connection.respond(HTTPStatus.FORBIDDEN, f"{reason}\n")
            response = process_request(connection, request)
            if response is not None:
                for name, value in guard.headers(request.path, request.headers).items():
                    response.headers[name] = value
            return response

        async def handle(connection: Any) -> None:
            connection.recv = Gate().wrap_receive(connection.recv)
            await handler(connection)

        return plain(handle, *arguments, process_request=admit, **options)

    with _STARTING:
        server.serve = serve  # type: ignore[assignment, misc]
        try:
            yield
        finally:
            server.serve = plain  # type: ignore[misc]


def is_guarded(host: str, port: int) -> bool:
    """Return whether the server that listens there refuses a foreign name and a foreign page."""
    where = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
    own = f"[{where}]:{port}" if ":" in where else f"{where}:{port}"
    for headers in ({"Host": _NOBODY}, {"Host": own, "Origin": f"http://{_NOBODY}"}):
        connection = http.client.HTTPConnection(where, port, timeout=20)
        try:
            connection.request("GET", "/", headers=headers)
            if connection.getresponse().status != HTTPStatus.FORBIDDEN:
                return False
        except (OSError, http.client.HTTPException):
            return False
        finally:
            connection.close()
    return True

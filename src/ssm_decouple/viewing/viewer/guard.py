"""Who may use a page: those who ask for it at an address of this machine, and no page of anybody else.

A browser lets any web page connect to any address, and a name of its own may be made to mean 127.0.0.1 (DNS
rebinding). It says truly, though, what it was asked for (Host) and by whose page (Origin), so both are checked, for
files and for the connection that drives the page alike. A program that is no browser sends no Origin; it needs none.
"""

from __future__ import annotations

import http.client
import ipaddress
import re
import socket
import threading
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import TYPE_CHECKING, Any

from ssm_decouple.errors import InputError

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.datastructures import Headers
    from websockets.http11 import Request, Response

LOOPBACK = ("localhost", "127.0.0.1", "::1")
ANYWHERE = ("0.0.0.0", "::", "")
FOREIGN = "not-this-machine.invalid"  # a name that nobody can have: what the trial asks for
PATIENCE = 10.0  # s
_PLACE = re.compile(r"(\[[0-9a-f:.]*:[0-9a-f:.]*\]|[a-z0-9._-]+)(?::([0-9]{1,5}))?", re.ASCII | re.IGNORECASE)
_OPENING = threading.Lock()

Answer = Callable[["ServerConnection", "Request"], "Response | Awaitable[Response | None] | None"]


def names_of(host: str) -> frozenset[str]:
    """Return the names and addresses under which a page on `host` may be asked for, but for those it is reached at."""
    names = {*LOOPBACK, host}
    if _plain(host) not in LOOPBACK:
        names |= {socket.gethostname(), socket.getfqdn()}
    return frozenset(map(_plain, names))


def refusal(headers: Headers, names: frozenset[str], address: str, port: int) -> str | None:
    """Return why a request is refused, in a line; None where it is not.

    Args:
        headers: Of the request.
        names: What the page may be called.
        address: Of this machine, at which the request arrived; it may be called that too.
        port: At which it arrived; every name is taken with this port alone.
    """
    allowed = names | {_plain(address.partition("%")[0])}
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    if len(hosts) != 1 or _place(hosts[0]) not in {(name, port) for name in allowed}:
        return f"{_told('Host', hosts)} is not an address of this page. {_way(allowed, port)}"
    if len(origins) > 1 or (origins and not _is_own(origins[0], allowed, port)):
        return f"{_told('Origin', origins)}: no page from elsewhere may use this one. {_way(allowed, port)}"
    return None


@contextmanager
def guarded(host: str) -> Iterator[None]:
    """Have the server that viser opens on `host` meanwhile refuse what is not asked for at this machine's addresses.

    viser has no setting for it, but gives websockets' `serve` a function that sees every request before it is answered.
    """
    import websockets.asyncio.server as websockets_server

    names, serve = names_of(host), websockets_server.serve

    def serving(*words: Any, process_request: Answer | None = None, **settings: Any) -> Any:
        if process_request is not None and process_request.__module__.startswith("viser."):
            process_request = _checked(process_request, names)
        return serve(*words, process_request=process_request, **settings)

    with _OPENING:
        websockets_server.serve = serving  # type: ignore[misc,assignment]
        try:
            yield
        finally:
            websockets_server.serve = serve  # type: ignore[misc]


def try_guard(host: str, port: int) -> None:
    """Ask for the page and for its connection as a foreign page would.

    Raises:
        InputError: it was answered: another viser than those this was written for opens its server in another way.
    """
    for words in ({"Host": FOREIGN}, {"Host": f"localhost:{port}", "Origin": f"http://{FOREIGN}"}):
        for upgrade in ({}, {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}):
            if _status(host, port, words | upgrade) != HTTPStatus.FORBIDDEN:
                from importlib import metadata

                raise InputError(
                    f"viser {metadata.version('viser')} does not let the page check who connects, so that any web page "
                    "could use it: it is not opened; pip install 'viser==1.1.1'"
                )


def _status(host: str, port: int, headers: dict[str, str]) -> int:
    address = {"0.0.0.0": "127.0.0.1", "": "127.0.0.1", "::": "::1"}.get(host, host)
    connection = http.client.HTTPConnection(address, port, timeout=PATIENCE)
    try:
        connection.putrequest("GET", "/", skip_host=True, skip_accept_encoding=True)
        for name, value in headers.items():
            connection.putheader(name, value)
        connection.endheaders()
        return connection.getresponse().status
    except (OSError, http.client.HTTPException):
        return 0
    finally:
        connection.close()


def _checked(answer: Answer, names: frozenset[str]) -> Answer:
    async def checked(connection: ServerConnection, request: Request) -> Response | None:
        address, port = connection.local_address[:2]
        told = refusal(request.headers, names, address, port)
        if told is not None:
            return connection.respond(HTTPStatus.FORBIDDEN, f"{told}\n")
        response = answer(connection, request)
        if isinstance(response, Awaitable):
            response = await response
        if response is not None:
            # A page from elsewhere that holds this one in a frame could have its reader click here unawares.
            response.headers["Content-Security-Policy"] = "frame-ancestors 'self'"
        return response

    return checked


def _place(text: str) -> tuple[str, int] | None:
    """Return name and port that a Host asks for; None where it is none."""
    found = _PLACE.fullmatch(text)
    return None if found is None else (_plain(found[1]), int(found[2] or http.client.HTTP_PORT))


def _is_own(origin: str, allowed: frozenset[str], port: int) -> bool:
    scheme, _, place = origin.partition("://")
    return scheme.lower() == "http" and _place(place) in {(name, port) for name in allowed}


def _plain(name: str) -> str:
    """Return a name or address in the one way of several to write it that all are compared in."""
    name = name.lower()
    name = name[1:-1] if name.startswith("[") else name.removesuffix(".")
    try:
        address = ipaddress.ip_address(name)
    except ValueError:
        return name
    return str(getattr(address, "ipv4_mapped", None) or address)


def _told(header: str, given: list[str]) -> str:
    return f"{header} {', '.join(repr(word[:100]) for word in given[:3]) or '(none)'}"


def _way(allowed: frozenset[str], port: int) -> str:
    shown = sorted(allowed - set(ANYWHERE), key=lambda name: (name not in LOOPBACK, name))
    listed = ", ".join(f"http://[{name}]:{port}" if ":" in name else f"http://{name}:{port}" for name in shown)
    return f"It is at {listed}; through an ssh tunnel with this port at both ends: ssh -L {port}:localhost:{port} .."

"""Who may use a page: raw requests with every kind of Host and Origin."""

from __future__ import annotations

import contextlib
import dataclasses
import re
import socket

import pytest
import viser
from hypothesis import example, given
from hypothesis import strategies as st
from websockets.datastructures import Headers

import ssm_decouple as ssm
from ssm_decouple.viewing.viewer import export, guard, scenes_of
from ssm_decouple.viewing.viewer import server as page_server
from ssm_decouple.viewing.viewer.live import Live
from ssm_decouple.viewing.viewer.server import open_server, url_of

UPGRADE = (
    "Upgrade: websocket",
    "Connection: Upgrade",
    "Sec-WebSocket-Version: 13",
    "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
    f"Sec-WebSocket-Protocol: viser-v{viser.__version__}",
)
NAMES = guard.names_of("127.0.0.1")


def ask(port, lines, upgrade=False, address="127.0.0.1"):
    """Send a request of these header lines and return the status and all that comes with it."""
    with socket.create_connection((address, port), timeout=20.0) as connection:
        request = ["GET / HTTP/1.1", *lines, *(UPGRADE if upgrade else ("Connection: close",)), "", ""]
        connection.sendall("\r\n".join(request).encode("latin-1"))
        answer = connection.recv(65536)
        while b"\r\n\r\n" not in answer or answer.endswith(b"\r\n\r\n"):
            more = connection.recv(65536) if not upgrade or b" 101 " not in answer else b""
            if not more:
                break
            answer += more
    return int(answer.split()[1]), answer.decode("latin-1")


@pytest.fixture(scope="module")
def port():
    server = open_server(port=0)
    yield server.get_port()
    server.stop()


@pytest.mark.parametrize(
    "lines",
    [
        ["Host: 127.0.0.1:{port}"],
        ["Host: localhost:{port}"],
        ["Host: LocalHost:{port}"],
        ["Host: localhost.:{port}"],
        ["Host: [::1]:{port}"],
        ["Host: [0:0:0:0:0:0:0:1]:{port}"],
        ["hOsT:   127.0.0.1:{port}  "],
        ["Host: 127.0.0.1:{port}", "Origin: http://127.0.0.1:{port}"],
        ["Host: 127.0.0.1:{port}", "Origin: HTTP://LOCALHOST:{port}"],
        ["Host: [::1]:{port}", "Origin: http://[::1]:{port}"],
    ],
)
@pytest.mark.parametrize("upgrade", [False, True])
def test_the_page_s_own_addresses_are_answered(port, lines, upgrade):
    status, answer = ask(port, [line.format(port=port) for line in lines], upgrade)
    assert status == (101 if upgrade else 200), answer
    if not upgrade:
        assert "frame-ancestors 'self'" in answer  # no page from elsewhere holds it in a frame


GOOD = "Host: 127.0.0.1:{port}"


@pytest.mark.parametrize(
    "lines",
    [
        [],
        ["Host:"],
        ["Host: evil.example"],
        ["Host: evil.example:{port}"],
        ["Host: EVIL.example.:{port}"],
        ["Host: 127.0.0.1"],
        ["Host: localhost"],
        ["Host: 127.0.0.1:{other}"],
        ["Host: localhost:{other}"],
        ["Host: localhost..:{port}"],
        ["Host: localhost.evil.example:{port}"],
        ["Host: evil.localhost:{port}"],
        ["Host: 127.0.0.1.evil.example:{port}"],
        ["Host: localhost:{port}@evil.example:{port}"],
        ["Host: evil.example@localhost:{port}"],
        ["Host: localhost:{port},evil.example"],
        ["Host: 127.0.0.2:{port}"],
        ["Host: 2130706433:{port}"],
        ["Host: 0x7f000001:{port}"],
        ["Host: 127.1:{port}"],
        ["Host: [::2]:{port}"],
        ["Host: [localhost]:{port}"],
        ["Host: ::1:{port}"],
        ["Host: 0.0.0.0:{port}"],
        ["Host: localhost:0{port}0"],
        ["Host: localhost:-1"],
        ["Host: http://localhost:{port}"],
        ["Host: evil.example:{port}", "Host: 127.0.0.1:{port}"],
        ["Host: 127.0.0.1:{port}", "Host: evil.example:{port}"],
        ["X-Forwarded-Host: 127.0.0.1:{port}", "Host: evil.example"],
        [GOOD, "Origin: http://evil.example"],
        [GOOD, "Origin: http://evil.example:{port}"],
        [GOOD, "Origin: null"],
        [GOOD, "Origin:"],
        [GOOD, "Origin: 127.0.0.1:{port}"],
        [GOOD, "Origin: http://127.0.0.1"],
        [GOOD, "Origin: http://127.0.0.1:{other}"],
        [GOOD, "Origin: http://localhost:3000"],
        [GOOD, "Origin: https://127.0.0.1:{port}"],
        [GOOD, "Origin: file://"],
        [GOOD, "Origin: http://127.0.0.1:{port}/"],
        [GOOD, "Origin: http://127.0.0.1:{port}.evil.example"],
        [GOOD, "Origin: http://127.0.0.1:{port}@evil.example"],
        [GOOD, "Origin: http://evil.example http://127.0.0.1:{port}"],
        [GOOD, "Origin: http://127.0.0.1:{port}", "Origin: http://evil.example"],
        [GOOD, "Origin: http://evil.example", "Origin: http://127.0.0.1:{port}"],
        ["Host: evil.example:{port}", "Origin: http://evil.example:{port}"],  # DNS rebinding: both agree
    ],
)
@pytest.mark.parametrize("upgrade", [False, True])
def test_what_is_not_is_refused_in_a_line_that_says_how(port, lines, upgrade):
    status, answer = ask(port, [line.format(port=port, other=port + 1) for line in lines], upgrade)
    assert status == 403, answer
    head, _, told = answer.partition("\r\n\r\n")
    assert "text/plain" in head
    assert told.count("\n") == 1
    assert f"http://localhost:{port}" in told
    assert f"ssh -L {port}:localhost:{port}" in told


LITERALS = {f"{name}:81" for name in ("localhost", "localhost.", "127.0.0.1", "127.0.0.1.", "[::1]")}
LETTERS = st.characters(codec="latin-1", exclude_categories=["Cc"])  # others no header can hold
near = st.sampled_from(sorted(LITERALS))


@given(
    st.one_of(
        st.text(LETTERS, max_size=30),
        near,
        st.builds(
            lambda text, at, more: text[:at] + more + text[at:],
            near,
            st.integers(0, 14),
            st.text(LETTERS, max_size=3),
        ),
        st.builds(lambda text, at: text[:at] + text[at + 1 :], near, st.integers(0, 14)),
        st.builds(lambda text, upper: text.upper() if upper else text, near, st.booleans()),
    )
)
@example("[::1.]:81")
@example("[0:0::1]:81")
@example("localhost:081")
def test_no_other_text_is_an_address_of_the_page(text):
    """Against a plain reading: name and port, the name in a list, IPv6 in any of its writings."""

    def own(place):
        name, colon, number = place.lower().rpartition(":")
        bracketed = re.fullmatch(r"\[([0-9a-f:.]+)\]", name)
        if bracketed:
            with contextlib.suppress(OSError):
                short = socket.inet_ntop(socket.AF_INET6, socket.inet_pton(socket.AF_INET6, bracketed[1]))
                name = "127.0.0.1" if short == "::ffff:127.0.0.1" else f"[{short}]"
        return bool(colon) and re.fullmatch("0*81", number, re.ASCII) and len(number) <= 5 and f"{name}:81" in LITERALS

    host, origin = Headers(), Headers()
    host["Host"], origin["Host"], origin["Origin"] = text, "localhost:81", f"http://{text}"
    for headers in (host, origin):
        accepted = guard.refusal(headers, NAMES, "127.0.0.1", 81) is None
        assert not accepted or own(text), text
        assert accepted or not own(text), text


def test_port_80_need_not_be_said():
    headers = Headers()
    headers["Host"], headers["Origin"] = "localhost", "http://localhost"
    assert guard.refusal(headers, NAMES, "127.0.0.1", 80) is None
    assert guard.refusal(headers, NAMES, "127.0.0.1", 81) is not None


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "::1", "localhost"])
def test_other_addresses_to_listen_on_have_their_names(host):
    if ":" in host and not socket.has_ipv6:
        pytest.skip("this machine has no IPv6")
    server = open_server(host, 0)
    try:
        port, ours = server.get_port(), socket.gethostname()
        own, address = host in ("::1", "localhost"), "::1" if ":" in host else "127.0.0.1"
        assert ask(port, [f"Host: {ours.upper()}:{port}"], address=address)[0] == (403 if own else 200)
        assert ask(port, [f"Host: [::1]:{port}", f"Origin: http://[::1]:{port}"], True, address)[0] == 101
        assert ask(port, [f"Host: evil.example:{port}"], address=address)[0] == 403
        assert ask(port, [f"Host: {ours}.evil.example:{port}"], address=address)[0] == 403
        assert url_of(server, host) == f"http://{'[::1]' if host == '::1' else 'localhost'}:{port}"
    finally:
        server.stop()


def test_a_page_for_others_may_be_asked_for_at_the_address_where_it_is_reached():
    server = open_server("0.0.0.0", 0)
    try:
        port = server.get_port()
        for address in ("127.0.0.1", "127.0.0.5"):
            with contextlib.suppress(OSError):
                assert ask(port, [f"Host: {address}:{port}"], True, address)[0] == 101
        assert ask(port, [f"Host: 127.0.0.9:{port}"], address="127.0.0.1")[0] == 403
    finally:
        server.stop()


def test_every_page_is_guarded():
    motion = dataclasses.replace(ssm.load_case("case1"), duration=1.0).run()
    scenes = scenes_of(motion)
    with (
        Live(ssm.load_case("case1"), port=0) as live,
        ssm.view(motion, port=0, playing=False) as player,
        export._staged(scenes, True, True) as (staged, _),
    ):
        for server in (live.server, player.server, staged):
            port = server.get_port()
            assert ask(port, [f"Host: 127.0.0.1:{port}"])[0] == 200
            assert ask(port, [f"Host: 127.0.0.1:{port}", "Origin: http://evil.example"], True)[0] == 403
            assert ask(port, [f"Host: evil.example:{port}"])[0] == 403


def test_a_viser_that_opens_its_server_otherwise_is_not_opened(monkeypatch):
    """Where the guard is not called any more nobody is let in unseen: the page says so and does not open."""
    opened = []
    monkeypatch.setattr(page_server, "guarded", lambda _: contextlib.nullcontext())
    make = viser.ViserServer

    def making(**words):
        opened.append(make(**words))
        return opened[-1]

    monkeypatch.setattr(viser, "ViserServer", making)
    with pytest.raises(ssm.InputError, match=r"viser \d.* any web page could use it: it is not opened"):
        open_server(port=0)
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", opened[0].get_port()), timeout=2.0)


def test_servers_of_others_are_left_alone_meanwhile(monkeypatch):
    import websockets.asyncio.server as websockets_server

    monkeypatch.setattr(websockets_server, "serve", lambda *words, process_request=None, **_: process_request)
    plain = websockets_server.serve

    def answer(connection, request):
        return None

    with guard.guarded("127.0.0.1"):
        assert websockets_server.serve(None, "127.0.0.1", 0, process_request=answer) is answer
        assert websockets_server.serve(None, "127.0.0.1", 0) is None
        answer.__module__ = "viser.infra._infra"
        assert websockets_server.serve(None, "127.0.0.1", 0, process_request=answer) is not answer
    assert websockets_server.serve is plain

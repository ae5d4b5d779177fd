"""The viewer's server: where it listens, whom it accepts, what it serves, and that it prints nothing."""

import gzip
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import raw_viewer_client
import rich
import viser
from live_program import wait_for
from new_interpreter import python
from raw_viewer_client import camera_message, raw_client
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.http11 import Request, Response

from taichi_mrf.errors import TaichiMRFError
from taichi_mrf.viewer.transport import pulse, viser_internals
from taichi_mrf.viewer.transport import server as viewer_server
from taichi_mrf.viewer.transport.origin import answer_page, refusal
from taichi_mrf.viewer.transport.server import start_server

CLIENT_BUILD = Path(viser.__file__).parent / "client" / "build"


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    running = start_server("127.0.0.1", 0, "A title")
    yield running
    running.stop()


def http_answer(port: int, target: bytes, *headers: bytes) -> tuple[int, bytes]:
    """Status and everything that came back for a GET of ``target``, byte for byte as given."""
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.sendall(
            b"\r\n".join([b"GET " + target + b" HTTP/1.1", b"Host: localhost", *headers, b"", b""])
        )
        answer = b"".join(iter(lambda: connection.recv(65536), b""))
    return int(answer.split(b" ", 2)[1]), answer


@pytest.mark.parametrize("packing", [b"gzip", b"identity"])
def test_the_tab_has_the_projects_name(server: viser.ViserServer, packing: bytes) -> None:
    _, answer = http_answer(server.get_port(), b"/", b"Accept-Encoding: " + packing)
    page = answer.partition(b"\r\n\r\n")[2]
    page = gzip.decompress(page) if packing == b"gzip" else page
    assert b"<title>taichi_mrf</title>" in page


@pytest.mark.parametrize(
    ("origin", "host"),
    [
        ("http://127.0.0.1:{port}", "127.0.0.1:{port}"),
        ("http://localhost:{port}", "localhost:{port}"),
        ("http://localhost:9999", "localhost:9999"),
        ("http://map.localhost:9999", "map.localhost:9999"),
        ("http://[::1]:9999", "[::1]:9999"),
        ("http://192.168.7.7", "192.168.7.7"),
        (f"http://{socket.gethostname().lower()}:80", socket.gethostname()),
    ],
)
def test_our_own_page_is_let_in(server: viser.ViserServer, origin: str, host: str) -> None:
    port = server.get_port()
    with raw_client(port, origin=origin.format(port=port), host=host.format(port=port)) as client:
        assert client.hear_type("SetGuiPanelLabelMessage")["label"] == "A title"


@pytest.mark.parametrize(
    ("origin", "host"),
    [
        ("http://evil.example", "127.0.0.1:{port}"),
        ("http://127.0.0.1.evil.example:{port}", "127.0.0.1:{port}"),
        ("http://203.0.113.7:{port}", "127.0.0.1:{port}"),
        ("http://localhost:{port}", "127.0.0.1:{port}"),
        ("http://127.0.0.1:1", "127.0.0.1:{port}"),
        ("http://127.0.0.1", "127.0.0.1:{port}"),
        ("null", "127.0.0.1:{port}"),
        ("file://127.0.0.1:{port}", "127.0.0.1:{port}"),
        ("none", "127.0.0.1:{port}"),
        ("http://rebound.evil.example:{port}", "rebound.evil.example:{port}"),
        ("http://localhost.evil.example:{port}", "localhost.evil.example:{port}"),
    ],
)
def test_foreign_pages_and_rebound_names_are_refused(
    server: viser.ViserServer, origin: str, host: str
) -> None:
    port = server.get_port()
    with (
        pytest.raises(InvalidStatus) as refused,
        raw_client(port, origin=origin.format(port=port), host=host.format(port=port)),
    ):
        pass
    assert refused.value.response.status_code == 403


def test_the_name_that_was_asked_for_is_ours() -> None:
    headers = Headers(Origin="https://map.example", Host="map.example")
    assert refusal(headers, "Map.Example") is None
    assert refusal(headers, "127.0.0.1") is not None


def test_the_default_port_is_the_schemes() -> None:
    assert refusal(Headers(Origin="http://localhost", Host="localhost:80"), "") is None
    assert refusal(Headers(Origin="https://localhost", Host="localhost:443"), "") is None
    assert refusal(Headers(Origin="https://localhost", Host="localhost:80"), "") is not None


@pytest.mark.parametrize("name", ["Origin", "Host"])
def test_a_second_header_is_refused(name: str) -> None:
    headers = Headers([("Origin", "http://localhost"), ("Host", "localhost")])
    assert refusal(headers, "127.0.0.1") is None
    headers[name] = headers[name]
    assert refusal(headers, "127.0.0.1") is not None


@pytest.mark.parametrize(
    "origin",
    ["", "localhost", "http://", "http://localhost/", "http://localhost:x", "http://a@localhost", "http://["],
)
def test_an_unreadable_origin_is_refused(origin: str) -> None:
    assert refusal(Headers(Origin=origin, Host="localhost"), "127.0.0.1") is not None


def test_the_page_is_served_unframed_and_unsniffed(server: viser.ViserServer) -> None:
    nonces: list[bytes] = []
    for target in (b"/", b"/index.html", b"/?fixedDpr=1&x=%2e%2e/%00", b"/index.html?"):
        status, answer = http_answer(server.get_port(), target)
        head, body = answer.split(b"\r\n\r\n", 1)
        assert status == 200
        assert b"X-Frame-Options: DENY" in head
        assert b"X-Content-Type-Options: nosniff" in head
        policy = head.partition(b"Content-Security-Policy: ")[2].partition(b"\r\n")[0]
        assert b"default-src 'none'" in policy
        scripts = next(each for each in policy.split(b"; ") if each.startswith(b"script-src"))
        (nonce,) = re.findall(rb"'nonce-([\w-]{22})'", scripts)
        nonces.append(nonce)
        assert b"unsafe-inline" not in scripts
        viser_page = (CLIENT_BUILD / "index.html").read_bytes()
        page = viser_page.decode().replace("<title>Viser</title>", "<title>taichi_mrf</title>" + pulse.TAG)
        assert body.decode() == viser_internals.with_nonce(page, nonce.decode())
    assert len(set(nonces)) == len(nonces)


def test_the_server_says_whether_the_mapping_process_speaks(monkeypatch: pytest.MonkeyPatch) -> None:
    mapper = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    heard = pulse.Pulse(mapper.pid)
    running = start_server("127.0.0.1", 0, "Alive", heard)
    try:

        def answer() -> bytes:
            status, found = http_answer(running.get_port(), b"/alive")
            assert status == 200
            assert b"Cache-Control: no-store" in found
            return found.partition(b"\r\n\r\n")[2]

        assert answer() == b'{"mapper": true}'
        mapper.send_signal(signal.SIGSTOP)
        wait_for(lambda: answer() == b'{"mapper": false}', "the stop")
        mapper.send_signal(signal.SIGCONT)
        wait_for(lambda: answer() == b'{"mapper": true}', "the process again")
        monkeypatch.setattr(pulse, "SILENCE_S", 0.0)
        assert answer() == b'{"mapper": false}'
    finally:
        mapper.kill()
        mapper.communicate()
        running.stop()


OTHER_FILES = [
    b"/../package.json",
    b"/..",
    b"/%2e%2e/package.json",
    b"/%2E%2E%2Fpackage.json",
    b"/%252e%252e/package.json",
    b"/..%5cpackage.json",
    b"/..\\package.json",
    b"/\\..\\package.json",
    b"//etc/passwd",
    b"/etc/passwd",
    b"/%2fetc/passwd",
    b"/C:/Windows/win.ini",
    b"/C:%5cWindows",
    b"/index.html%00.png",
    b"/index.html\x00",
    b"/%ff",
    b"/\xff",
    b"/.gitignore",
    b"/" + b"a" * 5000,
    b"http://localhost/../package.json",
    b"file:///etc/passwd",
    b"..",
    b"*",
]


@pytest.mark.parametrize("target", OTHER_FILES)
def test_no_other_file_is_served(
    server: viser.ViserServer, target: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[Path] = []
    monkeypatch.setattr(Path, "read_bytes", lambda path: read.append(path) or b"")
    status, answer = http_answer(server.get_port(), target)
    assert status == 404
    assert b"X-Frame-Options: DENY" in answer
    assert read == []


@pytest.mark.parametrize("target", OTHER_FILES)
def test_viser_is_not_even_asked_for_odd_paths(target: bytes) -> None:
    asked: list[str] = []
    request = Request(target.decode("latin-1"), Headers())
    connection = cast(ServerConnection, SimpleNamespace(respond=lambda *args: Response(404, "", Headers())))
    answer_page(connection, request, lambda _, passed: asked.append(passed.path))
    assert asked == [] or re.fullmatch(r"/[a-zA-Z/]+", asked[0])


def test_a_page_under_a_foreign_name_says_what_to_do(server: viser.ViserServer) -> None:
    with socket.create_connection(("127.0.0.1", server.get_port())) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\nHost: rebound.example\r\n\r\n")
        answer = b"".join(iter(lambda: connection.recv(65536), b""))
    assert answer.startswith(b"HTTP/1.1 403 ")
    assert b"use the machine's IP address" in answer


def test_odd_requests_do_no_harm(server: viser.ViserServer) -> None:
    port = server.get_port()
    http_answer(port, b"/", b"Upgrade: websocket", b"Upgrade: websocket", b"Connection: upgrade")
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.sendall(b"\x16\x03\x01 not http\r\n\r\n")
        connection.recv(65536)
    assert http_answer(port, b"/")[0] == 200


def test_it_listens_on_its_host_alone(server: viser.ViserServer) -> None:
    port = server.get_port()
    socket.create_connection(("127.0.0.1", port)).close()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", port))


def test_a_busy_port_gives_another_one() -> None:
    with socket.create_server(("127.0.0.1", 0)) as busy:
        asked = busy.getsockname()[1]
        running = start_server("127.0.0.1", asked, "Another port")
        try:
            assert asked < running.get_port() < asked + viewer_server.PORTS_TO_TRY
            assert http_answer(running.get_port(), b"/")[0] == 200
        finally:
            running.stop()


def test_no_free_port_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer_server, "PORTS_TO_TRY", 1)
    with socket.create_server(("127.0.0.1", 0)) as busy:
        asked = busy.getsockname()[1]
        with pytest.raises(
            TaichiMRFError, match=f"cannot listen on 127.0.0.1: no port from {asked} on is free"
        ):
            start_server("127.0.0.1", asked, "Nowhere")


@pytest.mark.parametrize(
    ("host", "port"),
    [("203.0.113.1", 8080), ("no-such-host.invalid", 8080), ("127.0.0.1", -1), ("127.0.0.1", 70000)],
)
def test_an_unusable_address_is_reported(host: str, port: int) -> None:
    with pytest.raises(TaichiMRFError, match="cannot listen on"):
        start_server(host, port, "Nowhere")


def _is_let_in(port: int) -> bool:
    with raw_client(port) as client:
        try:
            client.hear_type("SetGuiPanelLabelMessage")
        except ConnectionClosed:
            return False
    return True


def test_no_more_browsers_connect_than_there_is_room_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer_server, "MOST_CLIENTS", 1)
    running = start_server("127.0.0.1", 0, "Full")
    try:
        with raw_client(running.get_port()) as first:
            first.hear_type("SetGuiPanelLabelMessage")
            with pytest.raises(ConnectionClosed) as closed, raw_client(running.get_port()) as second:
                second.hear_type("never")
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 1013
        wait_for(lambda: _is_let_in(running.get_port()), "the place of the first one")
    finally:
        running.stop()


def test_visers_environment_variable_is_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        elsewhere = listener.getsockname()[1]
    monkeypatch.setenv("_VISER_PORT_OVERRIDE", str(elsewhere))
    running = start_server("127.0.0.1", 0, "Not there")
    try:
        assert running.get_port() != elsewhere
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.1", elsewhere))
    finally:
        running.stop()


def test_there_is_no_share_button_and_no_tunnel(server: viser.ViserServer) -> None:
    with raw_client(server.get_port()) as client:
        theme = client.hear_type("ThemeConfigurationMessage")
    assert theme["show_share_button"] is False
    assert theme["show_logo"] is False
    with pytest.raises(TaichiMRFError):
        server.request_share_url()


def test_an_unknown_viser_is_not_run_unguarded(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    monkeypatch.setitem(viser_internals.SERVER, "gui._handles_by_name", dict)
    with pytest.raises(TaichiMRFError, match=r"cannot guard viser .*gui\._handles_by_name.*viser_internals"):
        start_server("127.0.0.1", port, "Unknown")
    socket.create_server(("127.0.0.1", port)).close()


def test_a_viser_that_starts_by_itself_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viser_internals, "serving_by", lambda serve: nullcontext())
    with pytest.raises(TaichiMRFError, match="does not call websockets' serve"):
        start_server("127.0.0.1", 0, "By itself")


def test_a_viser_that_serves_in_another_way_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    serve = viewer_server._Door.serve
    monkeypatch.setattr(
        viewer_server._Door, "serve", lambda door, *args, process_request, **rest: serve(door, *args, **rest)
    )
    with pytest.raises(TaichiMRFError, match="calls websockets' serve in another way"):
        start_server("127.0.0.1", 0, "In another way")


def test_it_ends_although_a_client_neither_reads_nor_answers() -> None:
    running = start_server("127.0.0.1", 0, "Frozen client")
    port = running.get_port()
    request = (
        f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nOrigin: http://127.0.0.1:{port}\r\n"
        "Upgrade: websocket\r\n"
        "Connection: Upgrade\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n"
        f"Sec-WebSocket-Protocol: viser-v{viser.__version__}\r\n\r\n"
    )
    with socket.create_connection(("127.0.0.1", port)) as frozen:
        frozen.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        frozen.sendall(request.encode())
        connections = running._websock_server._live_connections
        wait_for(lambda: len(connections) == 1, "the connection")
        running.scene.add_point_cloud("/more-than-buffers-hold", np.zeros((2_000_000, 3)), np.zeros(3))
        wait_for(
            lambda: any(each.transport.get_write_buffer_size() for each in connections.values()), "a jam"
        )
        running.stop()
        thread = running._websock_server._server_thread
        assert thread is not None
        assert not thread.is_alive()


QUIET_SCRIPT = """
import sys, time
sys.path.insert(0, {tests!r})
from live_program import wait_for
from raw_viewer_client import camera_message, raw_client
from taichi_mrf.viewer.transport.server import start_server
server = start_server("127.0.0.1", 0, "Quiet")
with raw_client(server.get_port(), version="0.0.1") as old:
    try:
        old.connection.recv()
    except Exception as error:
        assert error.rcvd.code == 1002, error
with raw_client(server.get_port()) as client:
    client.say(camera_message())
    wait_for(lambda: len(server.get_clients()) == 1, "the client")
with raw_client(server.get_port()) as client:
    client.say("text")
    try:
        while True:
            client.connection.recv()
    except Exception as error:
        assert error.rcvd.code == 1003, error
{ending}
"""


@pytest.mark.parametrize("ending", ["server.stop()", ""], ids=["stopped", "left to the interpreter's exit"])
def test_it_prints_nothing(ending: str) -> None:
    script = QUIET_SCRIPT.format(tests=str(Path(raw_viewer_client.__file__).parent), ending=ending)
    finished = python("-c", script)
    assert (finished.returncode, finished.stdout, finished.stderr) == (0, "", "")


def test_rich_prints_for_others_again(server: viser.ViserServer, capsys: pytest.CaptureFixture[str]) -> None:
    rich.print("still here")
    assert capsys.readouterr().out == "still here\n"


def test_a_client_counts_once_its_camera_is_known(server: viser.ViserServer) -> None:
    before = set(server.get_clients())
    with raw_client(server.get_port()) as client:
        client.say(camera_message())
        wait_for(lambda: len(set(server.get_clients()) - before) == 1, "the client")
    wait_for(lambda: set(server.get_clients()) == before, "the end of the client")

# SPDX-License-Identifier: BSD-3-Clause
"""Who may connect to the viewer: its own page, under a name of this machine; a real server and real sockets."""

import contextlib
import http.client
from types import SimpleNamespace

import numpy as np
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from groma.viz.viewer.server import Doorkeeper, keep_cameras, start_server, stop_server


@pytest.fixture(scope="module")
def server():
    said: list[str] = []
    running = start_server("127.0.0.1", 0, said.append)
    yield running, said
    stop_server(running)


def _answer(port: int, host: str, origin: str | None) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    connection.putrequest("GET", "/", skip_host=True)
    connection.putheader("Host", host)
    if origin is not None:
        connection.putheader("Origin", origin)
    connection.endheaders()
    response = connection.getresponse()
    content = response.read()
    connection.close()
    return response.status, content


@pytest.mark.parametrize("name", ["localhost", "127.0.0.1", "[::1]", "LOCALHOST"])
def test_names_of_this_machine_are_served(server, name):
    port = server[0].get_port()
    assert _answer(port, f"{name}:{port}", None)[0] == 200
    assert _answer(port, f"{name}:{port}", f"http://{name}:{port}")[0] == 200
    assert _answer(port, f"{name}:9000", f"http://{name}:9000")[0] == 200  # through a tunnel


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:8080", "192.168.1.5", "localhost.evil.example", "", "[", "a@b"]
)
def test_other_hosts_are_refused_in_one_line(server, host):
    status, content = _answer(server[0].get_port(), host, None)
    assert status == 403
    assert content.startswith(b"groma view refused a request for the host") and content.count(b"\n") == 1


@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", "https://localhost.evil.example", "null", "http://localhost:3000", "file://", "http://["],
)
def test_web_sockets_of_other_pages_are_refused(server, origin):
    running, said = server
    with pytest.raises(InvalidStatus) as refused:
        connect(f"ws://localhost:{running.get_port()}/", origin=origin, open_timeout=20).close()
    assert refused.value.response.status_code == 403
    assert any(origin in sentence for sentence in said) or len(said) == 5


def test_its_own_page_may_connect(server):
    port = server[0].get_port()
    with connect(
        f"ws://localhost:{port}/", origin=f"http://localhost:{port}", subprotocols=["viser-v0"], open_timeout=20
    ) as socket:
        assert socket.response is not None and socket.response.status_code == 101


def test_two_headers_are_refused(server):
    keeper = Doorkeeper("127.0.0.1")
    assert keeper.refusal(["localhost", "evil.example"], []) is not None
    assert keeper.refusal(["localhost"], ["http://localhost", "http://evil.example"]) is not None
    assert keeper.refusal([], []) is not None


def test_an_open_server_takes_addresses_but_no_strange_names():
    keeper = Doorkeeper("0.0.0.0")
    assert keeper.refusal(["192.168.1.5:8080"], ["http://192.168.1.5:8080"]) is None
    assert keeper.refusal(["192.168.1.5:8080"], ["http://evil.example"]) is not None
    assert keeper.refusal(["rebound.example:8080"], []) is not None


def test_only_a_few_refusals_are_said():
    said: list[str] = []
    keeper = Doorkeeper("127.0.0.1", said.append)
    for number in range(100):
        keeper.note(f"{number // 2}")
    assert said == ["0", "1", "2", "3", "4"]


def test_a_page_that_comes_back_keeps_its_camera():
    on, begun = {}, []
    server = SimpleNamespace(
        on_client_connect=lambda call: on.update(connect=call), on_client_disconnect=lambda call: on.update(leave=call)
    )
    keep_cameras(server, begun.append)

    def page(position, look_at):
        camera = SimpleNamespace(position=np.array(position), look_at=np.array(look_at), up_direction=np.eye(3)[2])
        return SimpleNamespace(camera=camera, atomic=contextlib.nullcontext)

    on["leave"](page([1.0, 2.0, 3.0], [0.0, 0.5, 0.0]))
    back, new = page([1.0, 3.0, -2.0], [0.0, 0.0, 0.0]), page([-5.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    on["connect"](back)
    on["connect"](new)
    assert begun == [new]
    np.testing.assert_array_equal(back.camera.position, [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(back.camera.look_at, [0.0, 0.5, 0.0])

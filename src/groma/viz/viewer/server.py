# SPDX-License-Identifier: BSD-3-Clause
"""The server of the viewer; only pages that it served itself, under a name of this machine, may connect to it.

A browser lets every page open a web socket to this machine, and a page can give this machine another name (DNS
rebinding). Two headers are checked: ``Host`` must be a name or address that the server has, and ``Origin``, where there
is one, must be that same host, port included. All else gets 403 before anything of the scene is sent.
"""

from __future__ import annotations

import contextlib
import http
import io
import ipaddress
import socket
import threading
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import numpy as np

from groma.errors import GromaError

if TYPE_CHECKING:
    import viser

#: Called with a sentence when a connection is refused.
Say = Callable[[str], None]
#: Maximum number of reported refusals, so that a page that keeps trying does not fill the terminal.
_MOST_SAID = 5
_EVERY_ADDRESS = ("0.0.0.0", "::", "")
_starting = threading.Lock()


def start_server(host: str, port: int, say: Say | None = None) -> viser.ViserServer:
    """Return a viser server on a port, or the next free one, that refuses strangers.

    Parameters
    ----------
    host : str
        Address to listen on.
    port : int
        Port; 0 takes any.
    say : callable, optional
        Called with a sentence when a connection is refused, from another thread, a few times.

    Raises
    ------
    GromaError
        If the connections of this version of viser cannot be checked.
    """
    import viser

    with silenced(), _checked(Doorkeeper(host, say)) as applied:
        server = viser.ViserServer(host=host, port=port, label="groma", verbose=False)
    if not applied:
        stop_server(server)
        raise GromaError(f"viser {viser.__version__} cannot be made safe. Install an earlier one.")
    return server


def stop_server(server: viser.ViserServer) -> None:
    """Stop a server, silently."""
    with silenced():
        server.stop()


def silenced() -> contextlib.AbstractContextManager[Any]:
    """Suppress output of the server, which ignores its own option for that."""
    return contextlib.redirect_stdout(io.StringIO())


class Doorkeeper:
    """Who may connect to a server that listens on an address."""

    def __init__(self, host: str, say: Say | None = None) -> None:
        self._host, self._say = host.strip("[]").lower(), say
        self._said: set[str] = set()

    def refusal(self, hosts: list[str], origins: list[str]) -> str | None:
        """Return the reason for which the headers ``Host`` and ``Origin`` of a request are refused; None: accepted."""
        name = _name_of(f"http://{hosts[0]}") if len(hosts) == 1 else None
        if name is None or not self._is_mine(name):
            return f"refused a request for the host {_cut(hosts)}; expected localhost or {self._host or 'an address'}."
        if origins and (len(origins) > 1 or not _same_place(origins[0], hosts[0])):
            return f"refused a page of {_cut(origins)} that wanted to read the scene; expected http://{hosts[0][:60]}."
        return None

    def note(self, sentence: str) -> None:
        """Report a refusal, unless it was reported before."""
        if self._say is not None and sentence not in self._said and len(self._said) < _MOST_SAID:
            self._said.add(sentence)
            self._say(sentence)

    def _is_mine(self, name: str) -> bool:
        if name in ("localhost", self._host) or name.endswith(".localhost"):
            return True
        try:
            address = ipaddress.ip_address(name)
        except ValueError:  # the name of this machine, accepted if the server listens on all addresses
            return self._host in _EVERY_ADDRESS and name == socket.gethostname().lower()
        return address.is_loopback or self._host in _EVERY_ADDRESS


def _name_of(address: str) -> str | None:
    try:
        return urlsplit(address).hostname
    except ValueError:
        return None


def _same_place(origin: str, host: str) -> bool:
    """Whether an origin is a page of the host (name and port), with or without encryption by a proxy."""
    try:
        page = urlsplit(origin)
    except ValueError:
        return False
    return page.scheme in ("http", "https") and page.netloc.lower() == host.lower()


def _cut(values: list[str]) -> str:
    return repr(", ".join(values)[:80]) if values else "that is not said"


@contextlib.contextmanager
def _checked(doorkeeper: Doorkeeper) -> Iterator[list[bool]]:
    """Within the block, web socket servers check connections by the doorkeeper; viser has no option for that."""
    from websockets.asyncio import server as sockets

    serve, applied = sockets.serve, []

    def serve_checked(handler: Any, *where: Any, process_request: Any = None, **options: Any) -> Any:
        def ask_first(connection: Any, request: Any) -> Any:
            why = doorkeeper.refusal(request.headers.get_all("Host"), request.headers.get_all("Origin"))
            if why is not None:
                doorkeeper.note(why)
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"groma view {why}\n")
            return None if process_request is None else process_request(connection, request)

        applied.append(True)
        return serve(handler, *where, process_request=ask_first, **options)

    with _starting:
        sockets.serve = serve_checked  # type: ignore[assignment]
        try:
            yield applied
        finally:
            sockets.serve = serve


def keep_cameras(server: viser.ViserServer, begin: Callable[[Any], None] = lambda client: None) -> None:
    """Give a page whose connection was cut the camera that it had; ``begin`` is called for other pages.

    It tells its place before it knows the up direction, so only the distance from the origin can be compared.
    """
    left: list[Any] = []

    def remember(client: Any) -> None:
        left.append((client.camera.position, client.camera.look_at, client.camera.up_direction))

    def connected(client: Any) -> None:
        camera = client.camera
        for position, look_at, up in left:
            if np.isclose(np.linalg.norm(camera.position), np.linalg.norm(position)):
                with client.atomic():
                    camera.up_direction, camera.position, camera.look_at = up, position, look_at
                return
        begin(client)

    server.on_client_disconnect(remember)
    server.on_client_connect(connected)

# SPDX-License-Identifier: BSD-3-Clause
"""A scene in the browser: cameras with their images, points, lines, planes, directions; a click shows a line's numbers.

The page is served by viser from this machine; nothing is fetched from elsewhere. What is drawn is computed in
:mod:`groma.viz.viewer.content`; :mod:`groma.viz.viewer.nodes` hands it to the server and wires the switches to it.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator

from groma.errors import InputError
from groma.scene import Scene
from groma.viz.pictures import ImageFiles
from groma.viz.viewer.content import view_content
from groma.viz.viewer.nodes import SceneView
from groma.viz.viewer.server import Say, start_server, stop_server


def open_viewer(
    scene: Scene, images: ImageFiles | None = None, port: int = 8080, host: str = "127.0.0.1", say: Say | None = None
) -> SceneView:
    """Serve a scene to the browser and return at once.

    Parameters
    ----------
    scene : Scene
        What to show.
    images : path or mapping, optional
        Folder of the photographs, or files by image name.
    port : int
        Port to listen on, or the next free one; 0 takes any.
    host : str
        Address to listen on; by default only this machine can connect. "0.0.0.0" lets every machine in the network.
        Pages of other places are refused in any case (:mod:`groma.viz.viewer.server`).
    say : callable, optional
        Called with a sentence when a connection is refused, from another thread.

    Returns
    -------
    SceneView
        ``view.server.get_port()`` is the port; ``view.server.stop()`` ends it.

    Raises
    ------
    InputError
        If there is nothing to draw, or ``images`` is not a folder.
    """
    if not (scene.num_images or scene.num_points or scene.num_lines):
        raise InputError("The scene has no images, points or lines: there is nothing to look at.")
    if isinstance(images, str | os.PathLike) and not os.path.isdir(images):
        raise InputError(f"{os.fspath(images)} is not a folder of images. Check --images.")
    content = view_content(scene, images)
    server = start_server(host, port, say)
    try:
        return SceneView(server, content, images)
    except BaseException:
        stop_server(server)
        raise


@contextlib.contextmanager
def serving(
    scene: Scene, images: ImageFiles | None = None, port: int = 8080, say: Say | None = None
) -> Iterator[SceneView]:
    """Serve a scene inside a ``with`` block; parameters are those of :func:`open_viewer`."""
    view = open_viewer(scene, images, port, say=say)
    try:
        yield view
    finally:
        stop_server(view.server)


def wait_for_interrupt() -> None:
    """Wait until Ctrl-C is pressed, which raises :class:`KeyboardInterrupt`."""
    never = threading.Event()
    while not never.wait(0.5):  # a wait without end cannot be interrupted on every system
        pass


__all__ = ["SceneView", "open_viewer", "serving", "wait_for_interrupt"]

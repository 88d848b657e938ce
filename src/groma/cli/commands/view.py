# SPDX-License-Identifier: BSD-3-Clause
"""``groma view``: a scene in the browser."""

from pathlib import Path
from typing import Annotated

import typer

from groma.cli.shared import options as _options
from groma.cli.shared.console import Console
from groma.cli.shared.interrupt import PROCESS


def view(
    console: Console,
    source: Annotated[Path, typer.Argument(metavar="INPUT", help="Model to view; with --live the OUT of a track.")],
    images: Annotated[
        Path | None,
        _options.PLAIN.option(
            "Folder of the photographs. Default: the one recorded by groma map, or a folder images near INPUT.",
            metavar="DIR",
        ),
    ] = None,
    port: Annotated[
        int, _options.PLAIN.option("Port, or the next free one; 0: any.", "--port", "-p", min=0, max=65535, metavar="N")
    ] = 8080,  # convention: of viser
    live: Annotated[
        bool, _options.PLAIN.option("Follow groma track while it runs: INPUT is its OUT.", "--live")
    ] = False,
    browser: Annotated[bool, _options.PLAIN.option("Open a browser.")] = True,
    force: _options.ForceReport = False,
) -> None:
    """View a scene in the browser: cameras, points, lines, planes. Click a line for its observations.

    The page is served to this machine only, until Ctrl-C. --json writes the address and the counts as soon as the page
    is ready. With --live the page shows a running track, and its result at the end.
    """
    import contextlib

    from groma.cli.shared import output as _output
    from groma.cli.shared.input import check_inputs, refuse_idle

    _output.check_json(console.json_target, force)

    refuse_idle(("--images", images is not None and live, "without --live"))
    if live:
        _follow(source, port, browser, console, force)
        return
    check_inputs(source, images)

    from groma.io import read_scene
    from groma.scene.counts import counts_of, sentence_of
    from groma.viz.pictures import folder_of_images
    from groma.viz.viewer.scene import serving, wait_for_interrupt

    scene = read_scene(source)
    console.say(sentence_of(scene))
    if images is None and (images := folder_of_images(source, scene.images.names)) is not None:
        console.say(f"Photographs: {images}")
    PROCESS.regular = True  # once the page is served, Ctrl-C is the regular way to end
    with serving(scene, images, port, say=console.warn) as shown, contextlib.suppress(KeyboardInterrupt):
        address = f"http://localhost:{shown.server.get_port()}"
        if images is not None and shown.num_pictures == 0:
            console.warn(f"{images} holds none of the images of the scene, such as {scene.images.names[0]!r}.")
        console.say(f"Open {address} in a browser. Ctrl-C ends.")
        _output.write_json(console.json_target, {"address": address, **counts_of(scene)}, force)
        if browser:
            _open_browser(address)
        wait_for_interrupt()
    console.say("\nClosed.")


def _follow(output: Path, port: int, browser: bool, console: Console, force: bool) -> None:
    """Serve a running track until Ctrl-C."""
    import contextlib
    import time

    from groma.cli.shared import output as _output
    from groma.errors import InputError
    from groma.viz.viewer.live import EVERY, WAITING, following

    if output.is_file():
        raise InputError(f"{output} is a file. With --live, pass the folder that groma track -o was given.")

    def sentence(state: str) -> str:
        if state == WAITING:
            return f"There is nothing in {output} yet; waiting for groma track SEQUENCE -o {output}."
        return f"The track of {output} is {state}."

    PROCESS.regular = True
    with following(output, port, say=console.warn) as shown, contextlib.suppress(KeyboardInterrupt):
        shown.refresh()
        address = f"http://localhost:{shown.server.get_port()}"
        console.say(f"Open {address} in a browser. Ctrl-C ends.")
        console.say(sentence(shown.state))
        _output.write_json(console.json_target, {"address": address, "state": shown.state}, force)
        if browser:
            _open_browser(address)
        before = shown.state
        while True:
            time.sleep(EVERY)
            shown.refresh()
            if shown.state != before:
                before = shown.state
                console.say(sentence(before))
    console.say("\nClosed.")


def _open_browser(address: str) -> None:
    """Open a browser with windows; never one that would take over the terminal."""
    import os
    import sys
    import webbrowser

    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return
    webbrowser.open(address)

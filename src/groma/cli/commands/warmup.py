# SPDX-License-Identifier: BSD-3-Clause
"""``groma warmup``: compile everything once, so that no later command waits for the compiler."""

from typing import Annotated, Any

import typer

from groma._counted import counted
from groma.cli.shared import command as _complete
from groma.cli.shared import options as _options
from groma.cli.shared.console import Console


def warmup(
    console: Console,
    parts: Annotated[
        list[str] | None,
        typer.Argument(
            autocompletion=_complete.one_of(*_complete.COMPILED),
            metavar="PART",
            help="Commands to compile for: adjust, map, track. Default: all.",
        ),
    ] = None,
    again: Annotated[bool, _options.PLAIN.option("Run even if everything is compiled.", "--again")] = False,
    force: _options.ForceReport = False,
) -> None:
    """Compile the kernels of groma adjust, groma map and groma track for this machine.

    Small scenes are adjusted, mapped and tracked, and the compiled code is kept on disk: in NUMBA_CACHE_DIR if that is
    set, else beside the sources, else (if these are read-only) in the user's cache folder. Use it after an
    installation, an upgrade or a change of the processor, and when building a machine image.
    """
    from groma.cli.shared import output as _output

    _output.check_json(console.json_target, force)

    from groma.compilation.warmup import PARTS, warm_up

    with console.stages() as progress:
        numbers = warm_up(parts or PARTS, progress, again)
    ran = bool(numbers.pop("run"))
    console.say(*_sentences(numbers, ran))
    if numbers["unsaved"]:
        console.warn(f"{counted(numbers['unsaved'], 'functions')} could not be written; is the disk full?")
    _output.write_json(console.json_target, numbers, force)
    if numbers["unsaved"]:
        raise typer.Exit(1)


def _sentences(numbers: dict[str, Any], ran: bool) -> list[str]:
    parts = ", ".join(numbers["parts"])
    if not ran:
        return [f"Everything is there for {parts} ({numbers['seconds']:.1f} s).", f"Folder: {numbers['folder']}"]
    return [
        f"Compiled {counted(numbers['compiled'], 'functions')} for {parts} in {numbers['seconds']:.1f} s; "
        f"{numbers['loaded']:,} were there.",
        f"Folder: {numbers['folder']}",
    ]

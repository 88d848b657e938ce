# SPDX-License-Identifier: BSD-3-Clause
"""Checks of inputs and options before any library is loaded."""

from pathlib import Path

from groma.bounded.names import existing
from groma.errors import InputError


def refuse_idle(*options: tuple[str, bool, str]) -> None:
    """Refuse options without effect: (option, whether it has none, what it needs)."""
    for option, in_vain, others in options:
        if in_vain:
            raise InputError(f"{option} acts only {others}. Leave it out.")


def camera_parameters(text: str | None) -> tuple[float, ...] | None:
    """Return the numbers of --camera-params, separated by commas."""
    if text is None:
        return None
    try:
        return tuple(float(number) for number in text.split(","))
    except ValueError:
        raise InputError(f"--camera-params must be numbers with commas between them; got {text!r}.") from None


def camera_line(model: str | None, params: str | None) -> str | None:
    """Return a camera as one line, model and parameters; None if neither is given, which belong together."""
    numbers = camera_parameters(params)
    if (model is None) != (numbers is None):
        raise InputError("--camera-model and --camera-params belong together. Pass both, or none.")
    return None if model is None or numbers is None else " ".join([model, *map(repr, numbers)])


def check_inputs(*paths: Path | None) -> None:
    """Refuse paths that do not exist; None: not given."""
    for path in paths:
        if path is not None:
            existing(path)

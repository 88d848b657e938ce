# SPDX-License-Identifier: BSD-3-Clause
"""Options of commands that take measurements of other instruments: positions, control points, distances."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from groma.errors import InputError

if TYPE_CHECKING:
    from groma.adjustment.survey.attach import Survey
    from groma.cli.shared.console import Console

PANEL = "Measurements"
#: Residuals so many times as large as stated are told.
WORSE = 2.0
Positions = Annotated[
    str | None,
    typer.Option(
        "--positions",
        metavar="FILE",
        help="Measured camera positions: name, coordinates, standard deviations (CSV, or geo.txt of OpenDroneMap), or "
        "exif for the GPS of the photographs. The scene is brought into their frame.",
        rich_help_panel=PANEL,
    ),
]
PositionSigma = Annotated[
    str | None,
    typer.Option(
        "--position-sigma",
        metavar="S[,S[,S]]",
        help="Standard deviation of positions where the file states none; or horizontal, vertical.",
        rich_help_panel=PANEL,
    ),
]
Control = Annotated[
    Path | None,
    typer.Option(
        "--control",
        metavar="FILE",
        help="Control points with their marks in the images: gcp_list.txt of OpenDroneMap, or OpenSfM's "
        "ground_control_points.json.",
        rich_help_panel=PANEL,
    ),
]
ControlSigma = Annotated[
    str | None,
    typer.Option(
        "--control-sigma",
        metavar="S[,S[,S]]",
        help="Standard deviation of their coordinates; or horizontal, vertical.",
        rich_help_panel=PANEL,
    ),
]
MarkSigma = Annotated[
    float,
    typer.Option(
        "--mark-sigma", metavar="PX", help="Standard deviation of marks, pixels.", rich_help_panel=PANEL, min=1e-3
    ),
]
Check = Annotated[
    str | None,
    typer.Option(
        "--check",
        metavar="NAME,...",
        help="Control points that are kept back to check the result.",
        rich_help_panel=PANEL,
    ),
]
Distances = Annotated[
    Path | None,
    typer.Option(
        "--distances",
        metavar="FILE",
        help="Measured distances: name, name, distance, standard deviation; between control points or images.",
        rich_help_panel=PANEL,
    ),
]
DistanceSigma = Annotated[
    float | None,
    typer.Option(
        "--distance-sigma",
        metavar="S",
        help="Standard deviation of distances where the file states none.",
        rich_help_panel=PANEL,
    ),
]
Crs = Annotated[
    str | None,
    typer.Option(
        "--crs",
        metavar="NAME",
        help="Frame of the result: enu (default for longitude and latitude), utm, or a code such as EPSG:25832.",
        rich_help_panel=PANEL,
    ),
]


@dataclass(frozen=True)
class Measured:
    """What the options of :data:`PANEL` were given."""

    positions: str | None = None
    position_sigma: str | None = None
    control: Path | None = None
    control_sigma: str | None = None
    mark_sigma: float = 1.0
    check: str | None = None
    distances: Path | None = None
    distance_sigma: float | None = None
    crs: str | None = None

    @property
    def files(self) -> tuple[Path | None, ...]:
        """Files that must be there."""
        positions = None if self.positions is None or _exif(self.positions) is not None else Path(self.positions)
        return positions, self.control, self.distances

    @property
    def given(self) -> dict[str, object]:
        """Options that name files, by name, for commands that take none of them."""
        return {"--positions": self.positions, "--control": self.control, "--distances": self.distances}

    def __bool__(self) -> bool:
        return any(part is not None for part in (self.positions, self.control, self.distances))

    def read(self, images: Path | None, names: Callable[[], Sequence[str]]) -> Survey:
        """Read the files.

        Parameters
        ----------
        images : Path, optional
            Folder of the photographs, for ``--positions exif``.
        names : callable
            Gives their names in it, or those of the images of the scene.
        """
        from groma.adjustment.survey.attach import Survey
        from groma.io.survey import read_control, read_distances, read_exif_positions, read_positions

        places = None
        if self.positions is not None:
            folder = _exif(self.positions)
            if folder is None:
                places = read_positions(self.positions)
            elif (where := Path(folder) if folder else images) is not None:
                places = read_exif_positions(where, names())
            else:
                raise InputError("--positions exif needs the folder of the photographs: --positions exif:FOLDER.")
        return Survey(
            positions=places,
            control=None if self.control is None else read_control(self.control),
            distances=None if self.distances is None else read_distances(self.distances),
            position_sigma=_sigma(self.position_sigma, "--position-sigma"),
            control_sigma=_sigma(self.control_sigma, "--control-sigma"),
            distance_sigma=self.distance_sigma,
            mark_sigma_px=self.mark_sigma,
            check=tuple(name.strip() for name in self.check.split(",") if name.strip()) if self.check else (),
            crs=self.crs,
        )


def check_measured(measured: Measured) -> None:
    """Refuse options that nothing is given for."""
    needs = {
        "--position-sigma": (measured.position_sigma, measured.positions, "--positions"),
        "--control-sigma": (measured.control_sigma, measured.control, "--control"),
        "--check": (measured.check, measured.control, "--control"),
        "--distance-sigma": (measured.distance_sigma, measured.distances, "--distances"),
        "--crs": (measured.crs, measured.positions or measured.control, "--positions or --control"),
    }
    for option, (given, needed, name) in needs.items():
        if given is not None and needed is None:
            raise InputError(f"{option} belongs to {name}. Add it, or leave {option} out.")


def _exif(text: str) -> str | None:
    """Return the folder of ``exif:FOLDER``, empty for ``exif``; None for the name of a file."""
    return text[5:] if text == "exif" or text.startswith("exif:") else None


def _sigma(text: str | None, option: str) -> tuple[float, ...]:
    if text is None:
        return ()
    try:
        values = tuple(float(word) for word in text.split(","))
    except ValueError:
        values = ()
    if not 1 <= len(values) <= 3 or not all(0.0 < value < float("inf") for value in values):
        raise InputError(f"{option} must be one to three positive numbers with commas between them; got {text!r}.")
    return values


def say_survey(console: Console, numbers: dict[str, Any]) -> None:
    """Say how the scene got into its frame, how the measurements fit, and which are wrong."""
    for sentence in numbers.get("notes", ()):
        console.say(sentence)
    shown = [
        f"{kind}s {component:.2f}" for kind, component in numbers.get("variance_components", {}).items() if component
    ]
    if shown:
        console.say(f"Standard deviations that the residuals show, over those stated: {', '.join(shown)}.")
    for one in numbers.get("check_points", ()):
        dx, dy, dz = one["difference"]
        console.say(f"Check point {one['name']}: off by {dx:.3f}, {dy:.3f}, {dz:.3f}.")
    worse = {kind: size for kind, size in numbers.get("variance_components", {}).items() if size and size > WORSE}
    for kind, size in worse.items():
        console.warn(
            f"The residuals of the {kind}s are {size:.1f} times as large as their standard deviations say. Repeat with "
            "larger ones, or look for what is wrong with all of them."
        )
    suspects = [one for one in numbers.get("measurements", ()) if one["is_suspect"] and one["kind"] not in worse]
    for one in sorted(suspects, key=lambda one: -abs(one["normalized"]))[:5]:
        console.warn(
            f"Probably wrong: {one['kind']} {one['name']} {one['coordinate']}".rstrip()
            + f" (residual {one['residual']:.4g}, {abs(one['normalized']):.1f} standard deviations). Check it."
        )
    if len(suspects) > 5:
        console.warn(f"{len(suspects) - 5} more measurements are probably wrong; the protocol lists them.")


__all__ = [
    "Check", "Control", "ControlSigma", "Crs", "DistanceSigma", "Distances", "MarkSigma", "Measured", "PositionSigma",
    "Positions", "check_measured", "say_survey",
]  # fmt: skip

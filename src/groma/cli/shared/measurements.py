# SPDX-License-Identifier: BSD-3-Clause
"""Options of commands that take measurements of other instruments: positions, control points, distances, and so on."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from groma.cli.shared.command import Panel
from groma.errors import InputError

if TYPE_CHECKING:
    from groma.adjustment.survey.given import Survey
    from groma.cli.shared.console import Console

PANEL = Panel("Measurements")
#: Ratio of residuals to stated deviations above which a warning is printed.
WORSE = 2.0
#: Suspect measurements that are named.
_LISTED = 5
#: Units of residuals that are no lengths, by kind.
_UNITS = {"mark": " pixels", "known direction": " degrees"}
Positions = Annotated[
    str | None,
    PANEL.option(
        "Measured camera positions: name, coordinates, standard deviations (CSV, or geo.txt of OpenDroneMap),"
        " or exif for the GPS of the photographs. The scene is transformed into their frame.",
        metavar="FILE",
    ),
]
Control = Annotated[
    Path | None,
    PANEL.option(
        "Control points with their marks in the images: gcp_list.txt of OpenDroneMap, or OpenSfM's "
        "ground_control_points.json.",
        metavar="FILE",
    ),
]
Crs = Annotated[
    str | None,
    PANEL.option(
        "Frame of the result: enu (default for longitude and latitude), utm, or a code such as EPSG:25832.",
        metavar="NAME",
    ),
]


@dataclass(frozen=True)
class Measured:
    """The options under :data:`PANEL`, one parameter of a command, with their values."""

    positions: Positions = None
    position_sigma: Annotated[
        str | None,
        PANEL.option(
            "Standard deviation of positions without one in the file; or horizontal, vertical.", metavar="S[,S[,S]]"
        ),
    ] = None
    control: Control = None
    control_sigma: Annotated[
        str | None, PANEL.option("Standard deviation of control points; or horizontal, vertical.", metavar="S[,S[,S]]")
    ] = None
    mark_sigma: Annotated[float, PANEL.option("Standard deviation of marks, pixels.", metavar="PX", min=1e-3)] = 1.0
    check: Annotated[str | None, PANEL.option("Control points to hold out as check points.", metavar="NAME,...")] = None
    distances: Annotated[
        Path | None,
        PANEL.option(
            "Measured distances: name, name, distance, standard deviation; between images, control points and "
            "landmarks (line:5, plane:2, point:17).",
            metavar="FILE",
        ),
    ] = None
    distance_sigma: Annotated[
        float | None, PANEL.option("Standard deviation of distances without one in the file.", metavar="S")
    ] = None
    directions: Annotated[
        Path | None,
        PANEL.option(
            "Known directions: image, direction of down in its camera frame (x right, y down, z forward), standard "
            "deviation in degrees; or line:5 vertical 0.5.",
            metavar="FILE",
        ),
    ] = None
    direction_sigma: Annotated[
        float | None, PANEL.option("Standard deviation of directions without one in the file, degrees.", metavar="DEG")
    ] = None
    known_planes: Annotated[
        Path | None,
        PANEL.option(
            "Objects on planes with known coordinates: p1 z 12.3 0.01, or plane:2 0 0 1 -12.3 0.01 (n.X + w = 0).",
            metavar="FILE",
        ),
    ] = None
    plane_sigma: Annotated[
        float | None, PANEL.option("Standard deviation of known planes without one in the file.", metavar="S")
    ] = None
    poses: Annotated[
        Path | None,
        PANEL.option(
            "Measured poses: name x y z qx qy qz qw and standard deviations or a covariance; or any file of "
            "poses, with --pose-sigma.",
            metavar="FILE",
        ),
    ] = None
    pose_sigma: Annotated[
        str | None,
        PANEL.option(
            "Standard deviations of poses without one in the file: of positions, and of orientations in degrees.",
            metavar="S,DEG",
        ),
    ] = None
    hold: Annotated[
        str | None,
        PANEL.option("Images (also old/*), control points and landmarks (line:5) to hold fixed.", metavar="NAME,..."),
    ] = None
    crs: Crs = None
    keep_suspects: Annotated[
        bool, PANEL.option("Report gross errors, but keep them in the adjustment.", "--keep-suspects")
    ] = False

    def validate(self) -> None:
        """Refuse standard deviations that are not positive, and options without the measurements that they apply to."""
        needs = {
            "--position-sigma": (self.position_sigma, self.positions, "--positions"),
            "--control-sigma": (self.control_sigma, self.control, "--control"),
            "--mark-sigma": (None if self.mark_sigma == 1.0 else self.mark_sigma, self.control, "--control"),
            "--check": (self.check, self.control, "--control"),
            "--distance-sigma": (self.distance_sigma, self.distances, "--distances"),
            "--direction-sigma": (self.direction_sigma, self.directions, "--directions"),
            "--plane-sigma": (self.plane_sigma, self.known_planes, "--known-planes"),
            "--pose-sigma": (self.pose_sigma, self.poses, "--poses"),
            "--crs": (self.crs, self.positions or self.control, "--positions or --control"),
        }
        for option, (given, needed, name) in needs.items():
            if isinstance(given, float) and not 0.0 < given < float("inf"):
                raise InputError(f"{option} must be a positive number; got {given:g}.")
            if given is not None and needed is None:
                raise InputError(f"{option} belongs to {name}. Add it, or leave {option} out.")

    @property
    def files(self) -> tuple[Path | None, ...]:
        """Files that must exist."""
        positions = None if self.positions is None or _exif(self.positions) is not None else Path(self.positions)
        return positions, self.control, self.distances, self.directions, self.known_planes, self.poses

    @property
    def given(self) -> dict[str, object]:
        """Options that bring measurements, by name, for commands that take none of them."""
        return {
            "--positions": self.positions, "--control": self.control, "--distances": self.distances,
            "--directions": self.directions, "--known-planes": self.known_planes, "--poses": self.poses,
            "--hold": self.hold,
        }  # fmt: skip

    def __bool__(self) -> bool:
        return any(part is not None for part in self.given.values())

    def read(self, images: Path | None, names: Callable[[], Sequence[str]]) -> Survey:
        """Read the files.

        Parameters
        ----------
        images : Path, optional
            Folder of the photographs, for ``--positions exif``.
        names : callable
            Returns their names in it, or those of the images of the scene.
        """
        from groma.adjustment.survey.given import Survey
        from groma.io import survey as files
        from groma.io.measured_poses import read_camera_poses

        return Survey(
            positions=self._positions(images, names),
            control=_read(files.read_control, self.control),
            distances=_read(files.read_distances, self.distances),
            directions=_read(files.read_directions, self.directions),
            planes=_read(files.read_known_planes, self.known_planes),
            poses=None if self.poses is None else read_camera_poses(self.poses, names()),
            position_sigma=_sigma(self.position_sigma, "--position-sigma"),
            control_sigma=_sigma(self.control_sigma, "--control-sigma"),
            distance_sigma=self.distance_sigma,
            direction_sigma_deg=self.direction_sigma,
            plane_sigma=self.plane_sigma,
            pose_sigma=_sigma(self.pose_sigma, "--pose-sigma", (2, 2)),
            mark_sigma_px=self.mark_sigma,
            check=_names(self.check, "--check"),
            hold=_names(self.hold, "--hold"),
            crs=self.crs,
        )

    def _positions(self, images: Path | None, names: Callable[[], Sequence[str]]) -> Any:
        from groma.io.survey import read_exif_positions, read_positions

        if self.positions is None:
            return None
        folder = _exif(self.positions)
        if folder is None:
            return read_positions(self.positions)
        where = Path(folder) if folder else images
        if where is None:
            raise InputError("--positions exif needs the folder of the photographs: --positions exif:FOLDER.")
        return read_exif_positions(where, names())


#: Of a command that was given none.
NOTHING = Measured()


def _read(reader: Callable[[Path], Any], path: Path | None) -> Any:
    return None if path is None else reader(path)


def _names(text: str | None, option: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in (text or "").split(",") if name.strip())
    if text is not None and not names:
        raise InputError(f"{option} must be names with commas between them; got {text!r}.")
    return names


def _exif(text: str) -> str | None:
    """Return the folder of ``exif:FOLDER``, empty for ``exif``; None for the name of a file."""
    return text[5:] if text == "exif" or text.startswith("exif:") else None


def _sigma(text: str | None, option: str, count: tuple[int, int] = (1, 3)) -> tuple[float, ...]:
    if text is None:
        return ()
    try:
        values = tuple(float(word) for word in text.split(","))
    except ValueError:
        values = ()
    if not count[0] <= len(values) <= count[1] or not all(0.0 < value < float("inf") for value in values):
        number = "two" if count == (2, 2) else "one to three"
        raise InputError(f"{option} must be {number} positive numbers with commas between them; got {text!r}.")
    return values


def say_survey(console: Console, numbers: dict[str, Any]) -> None:
    """Print how the scene was placed in its frame, how the measurements fit, and which contradict the rest."""
    console.say(*numbers.get("notes", ()))
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
    suspects = sorted(suspects, key=lambda one: -abs(one["normalized"]))
    first = {(one["kind"], one["name"]): one for one in reversed(suspects) if one["is_rejected"]}
    rejected = sorted(first.values(), key=lambda one: -abs(one["normalized"]))
    left = [one for one in suspects if not one["is_rejected"]]
    _warn_of(console, "Taken out", rejected, "Correct or delete it, or keep it with --keep-suspects.")
    _warn_of(console, "Suspect", left, "Check it.")


def _warn_of(console: Console, what: str, measurements: Sequence[Mapping[str, Any]], advice: str) -> None:
    """Warn of measurements, worst first."""
    for one in measurements[:_LISTED]:
        unit = " degrees" if "turn" in one["coordinate"] else _UNITS.get(one["kind"], "")
        console.warn(
            f"{what}: {one['kind']} {one['name']} {one['coordinate']}".rstrip()
            + f" disagrees with photographs and other measurements by {one['residual']:.4g}{unit} "
            f"({abs(one['normalized']):.1f} standard deviations). {advice}"
        )
    if len(measurements) > _LISTED:
        console.warn(f"{what}: {len(measurements) - _LISTED} more, listed in the protocol.")

# SPDX-License-Identifier: BSD-3-Clause
"""From files of measurements to tables of a scene that lies where they say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from groma._counted import counted
from groma._typing import FloatArray, IntArray
from groma.adjustment.survey.names import nearest, require_some, rows_by_name
from groma.adjustment.survey.similarity import GATES, RobustSimilarity, robust_similarity, upright
from groma.adjustment.survey.triangulate import triangulated
from groma.errors import InputError
from groma.io.survey import ControlFile, DistancesFile, Places, WorldFrame, common_frame
from groma.scene import CameraDistances, CameraPositions, ControlPoints, Marks, PointDistances, Scene, Similarity
from groma.scene.survey import CHECK, CONTROL, UNKNOWN, diagonal_covariance

#: Names that a sentence lists at most.
_LISTED = 5


@dataclass(frozen=True, eq=False)
class Survey:
    """Measurements as files hold them, and how they are meant."""

    #: Positions of cameras: :func:`groma.io.survey.read_positions`, :func:`groma.io.survey.read_exif_positions`.
    positions: Places | None = None
    #: Control points and their marks: :func:`groma.io.survey.read_control`.
    control: ControlFile | None = None
    #: Distances between control points or images: :func:`groma.io.survey.read_distances`.
    distances: DistancesFile | None = None
    #: Standard deviations of positions, of control points (one, or horizontal and vertical, or three) and of
    #: distances, where files do not state them; units of the coordinates.
    position_sigma: tuple[float, ...] = ()
    control_sigma: tuple[float, ...] = ()
    distance_sigma: float | None = None
    #: Standard deviation of a coordinate of a mark, pixels.
    mark_sigma_px: float = 1.0
    #: Names of control points that are kept back to check the result.
    check: tuple[str, ...] = ()
    #: ``enu``, ``utm`` or a system such as ``EPSG:32632``; None: that of the files.
    crs: str | None = None

    def __bool__(self) -> bool:
        return any(part is not None for part in (self.positions, self.control, self.distances))


@dataclass(frozen=True, eq=False)
class Surveyed:
    """A scene with its measurements, in their frame."""

    scene: Scene
    #: ``new_from_old``.
    similarity: Similarity
    #: What its coordinates mean.
    frame: WorldFrame
    #: What was read, assumed and left out, in sentences.
    notes: tuple[str, ...] = ()
    #: The fit of the similarity; None where the scene was not moved, or only scaled.
    alignment: RobustSimilarity | None = field(default=None)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        fit = self.alignment
        return {
            "frame": self.frame.to_dict(),
            "scale": self.similarity.scale,
            "scatter": None if fit is None else fit.scatter,
            "num_used": None if fit is None else int(fit.inliers.sum()),
            "num_places": None if fit is None else len(fit.inliers),
            "notes": list(self.notes),
        }


def with_survey(scene: Scene, survey: Survey) -> Surveyed:
    """Bring a scene into the frame of measurements, and add these to it.

    Positions and control points (not those kept back) determine a robust similarity; distances alone the scale. A scene
    that holds such measurements already stays where it is.

    Parameters
    ----------
    scene : Scene
        Cameras with poses.
    survey : Survey
        What was measured.

    Raises
    ------
    InputError
        If names are unknown, coordinate systems or axes do not fit, or accuracies are missing.
    """
    notes: list[str] = []
    groups = [group for group in (survey.positions, survey.control and survey.control.places) if group is not None]
    places, frame = common_frame(groups, survey.crs)
    for group in groups:
        notes += group.notes
    tables: dict[str, Any] = {}
    if survey.positions is not None:
        tables["camera_positions"] = _positions(scene, survey, places[0], notes)
    if survey.control is not None:
        tables["control_points"], tables["marks"] = _control(scene, survey, survey.control, places[-1], notes)
    if survey.distances is not None:
        points = tables.get("control_points", scene.control_points)
        tables |= _distances(scene, survey, survey.distances, points)
    moved, similarity, fit = _in_place(scene, tables, survey, notes)
    if "control_points" in tables:
        seen, _ = triangulated(moved, tables["marks"], len(tables["control_points"]))
        known = np.isfinite(seen).all(axis=1)
        start = np.where(known[:, None], seen, tables["control_points"].measured)
        tables["control_points"] = tables["control_points"].replace(xyz=start)
    if fit is not None:
        notes.append(_say_fit(fit, similarity, frame))
    return Surveyed(moved.replace(**tables), similarity, frame, tuple(notes), fit)


# ------------------------------------------------------------------------------------------------------------- tables
def _positions(scene: Scene, survey: Survey, xyz: FloatArray, notes: list[str]) -> CameraPositions:
    given = survey.positions
    assert given is not None
    rows = rows_by_name(given.names, scene.images.names)
    require_some(rows, given.names, scene.images.names, given.source, "an image")
    _tell_unknown(given, rows, scene.images.names, "images that are not in the scene", notes)
    known = np.flatnonzero(np.asarray(rows) >= 0)
    sigma = _sigma(given, survey.position_sigma, "--position-sigma")
    if (twice := len(known) - len(np.unique(rows[known]))) > 0:
        raise InputError(f"{given.source}: {counted(twice, 'images')} have two positions under different names.")
    return CameraPositions(rows[known], xyz[known], diagonal_covariance(sigma[known]))


def _control(
    scene: Scene, survey: Survey, given: ControlFile, xyz: FloatArray, notes: list[str]
) -> tuple[ControlPoints, Marks]:
    places, known_place = given.places, np.isfinite(xyz).all(axis=1)
    if unknown := [name for name in survey.check if name not in places.names]:
        raise InputError(
            f"--check names {unknown[0]!r}, which is no control point{nearest(unknown[0], places.names)}. The file has "
            f"{', '.join(places.names[:_LISTED])}."
        )
    image = rows_by_name(given.image_names, scene.images.names)
    require_some(image, given.image_names, scene.images.names, places.source, "an image")
    if missing := len(set(np.asarray(given.image_names)[image < 0].tolist())):
        notes.append(
            f"{places.source}: {counted(int((image < 0).sum()), 'marks')} in {counted(missing, 'images')} that are not "
            "in the scene."
        )
    pixels = given.pixels
    if given.normalized:
        camera = scene.images.camera_idx[np.maximum(image, 0)]
        extent = np.stack([scene.cameras.width[camera], scene.cameras.height[camera]], axis=1).astype(float)
        pixels = pixels * extent.max(axis=1, keepdims=True) + extent / 2.0
    _check_inside(scene, places.source, image, pixels)
    is_check = given.is_check | np.isin(places.names, survey.check)
    role = np.where(~known_place, UNKNOWN, np.where(is_check, CHECK, CONTROL))
    marked = np.bincount(given.point_idx[image >= 0], minlength=len(role))
    keep = np.flatnonzero((marked >= 2) | ((marked == 1) & (role == CONTROL)))
    if left := [places.names[row] for row in np.flatnonzero(~np.isin(np.arange(len(role)), keep))]:
        notes.append(f"Left out, marked in too few images: {_listed(left, 'control points')}.")
    sigma = _sigma(places, survey.control_sigma, "--control-sigma", known_place & (role != UNKNOWN))
    names = tuple(places.names[row] for row in keep)
    start = np.where(known_place[:, None], xyz, 0.0)[keep]
    points = ControlPoints(names, start, start, diagonal_covariance(sigma[keep]), role[keep])
    new_row = np.full(len(role), -1)
    new_row[keep] = np.arange(len(keep))
    rows = np.flatnonzero((image >= 0) & (new_row[given.point_idx] >= 0))
    noise = np.full(len(rows), survey.mark_sigma_px)
    return points, Marks(image[rows], new_row[given.point_idx[rows]], pixels[rows], noise)


def _check_inside(scene: Scene, source: str, image: IntArray, pixels: FloatArray) -> None:
    """Refuse marks outside their images: they were made in images of another size."""
    camera = scene.images.camera_idx[np.maximum(image, 0)]
    size = np.stack([scene.cameras.width[camera], scene.cameras.height[camera]], axis=1)
    outside = (image >= 0) & (size > 0).all(axis=1) & ((pixels < -1.0) | (pixels > size + 1.0)).any(axis=1)
    if outside.any():
        row = int(np.argmax(outside))
        name, (width, height) = scene.images.names[image[row]], size[row]
        raise InputError(
            f"{source}: {counted(int(outside.sum()), 'marks')} lie outside their images, such as "
            f"({pixels[row, 0]:.0f}, {pixels[row, 1]:.0f}) in {name} of {width} x {height} pixels. Were they made in "
            "images of another size?"
        )


def _distances(scene: Scene, survey: Survey, given: DistancesFile, points: ControlPoints) -> dict[str, Any]:
    sigma = np.where(np.isfinite(given.sigma), given.sigma, survey.distance_sigma or np.nan)
    if not np.isfinite(sigma).all():
        raise InputError(f"{given.source} does not say how exact its distances are. Say it: --distance-sigma 0.001.")
    found: dict[str, Any] = {}
    in_points, in_images = (
        np.stack([rows_by_name(names, known) for names in (given.first, given.second)], axis=1)
        for known in (points.names, scene.images.names)
    )
    of_points = (in_points >= 0).all(axis=1)
    of_images = (in_images >= 0).all(axis=1) & ~of_points
    if not (of_points | of_images).all():
        row = int(np.argmin(of_points | of_images))
        known = (*points.names, *scene.images.names)
        pair = (given.first[row], given.second[row])
        wrong = next((name for name in pair if rows_by_name([name], known)[0] < 0), None)
        reason = (
            f"{wrong!r} is neither a control point nor an image{nearest(wrong, known)}"
            if wrong
            else (f"{pair[0]!r} and {pair[1]!r} are not of one kind: distances are between control points or images")
        )
        raise InputError(f"{given.source}: {reason}. Use the same names.")
    if of_points.any():
        found["point_distances"] = PointDistances(
            in_points[of_points, 0], in_points[of_points, 1], given.distance[of_points], sigma[of_points]
        )
    if of_images.any():
        found["camera_distances"] = CameraDistances(
            in_images[of_images, 0], in_images[of_images, 1], given.distance[of_images], sigma[of_images]
        )
    return found


def _sigma(given: Places, stated: tuple[float, ...], option: str, needed: Any = True) -> FloatArray:
    """Return standard deviations (N, 3): of the file, else as stated."""
    sigma = given.sigma.copy()
    if stated:
        east, north, up = {1: stated * 3, 2: (stated[0], *stated), 3: stated}[len(stated)]
        sigma[:] = np.where(np.isfinite(sigma), sigma, [east, north, up])
    missing = ~np.isfinite(sigma).all(axis=1)
    if (missing & needed).any():
        raise InputError(
            f"{given.source} does not say how exact its coordinates are. Say it: {option} 0.02, or horizontal and "
            f"vertical: {option} 0.02,0.04 (units of the coordinates)."
        )
    sigma[missing] = 1.0
    return sigma


# ----------------------------------------------------------------------------------------------------------- in place
def _in_place(
    scene: Scene, tables: dict[str, Any], survey: Survey, notes: list[str]
) -> tuple[Scene, Similarity, RobustSimilarity | None]:
    """Return the scene where the measurements say it is, the similarity, and its fit."""
    if scene.is_surveyed:
        notes.append("The scene holds positions or control points already and stays where it is.")
        return scene, Similarity(), None
    source, target = _correspondences(scene, tables)
    if len(source) == 0:
        return _scaled(scene, tables, notes)
    if len(source) < 3:
        raise InputError(
            f"The measurements place only {len(source)} cameras or control points of the scene; three are "
            "needed. Add positions, or control points that two images show."
        )
    try:
        fit = robust_similarity(source, target)
    except InputError:
        _check_exchanged(scene, survey, source, tables, None)
        raise
    _check_exchanged(scene, survey, source, tables, fit)
    if fit.on_line:
        fit = upright(fit, scene, target)
        notes.append(
            "The measured places are on a line: they do not tell how the scene is turned about it. It was turned so "
            "that the cameras stand upright."
        )
    if len(far := np.flatnonzero(~fit.inliers)):
        names = [*[scene.images.names[i] for i in _of(tables, "camera_positions", "image_idx")]]
        names += _control_names(scene, tables)
        rows = far[np.argsort(-np.linalg.norm(fit.residuals[far], axis=1))]
        listed = [f"{names[row]} ({np.linalg.norm(fit.residuals[row]):.3g})" for row in rows]
        notes.append(f"Far from where the others put them, before the adjustment: {_listed(listed, 'places')}.")
    return scene.transformed(fit.similarity), fit.similarity, fit


def _of(tables: dict[str, Any], table: str, column: str) -> Any:
    return getattr(tables[table], column) if table in tables else ()


def _correspondences(scene: Scene, tables: dict[str, Any]) -> tuple[FloatArray, FloatArray]:
    source, target = [np.zeros((0, 3))], [np.zeros((0, 3))]
    if "camera_positions" in tables:
        source.append(scene.cam_centers_in_world[tables["camera_positions"].image_idx])
        target.append(tables["camera_positions"].xyz)
    if "control_points" in tables:
        points = tables["control_points"]
        seen, _ = triangulated(scene, tables["marks"], len(points))
        usable = points.is_control & np.isfinite(seen).all(axis=1)
        source.append(seen[usable])
        target.append(points.measured[usable])
    return np.concatenate(source), np.concatenate(target)


def _control_names(scene: Scene, tables: dict[str, Any]) -> list[str]:
    if "control_points" not in tables:
        return []
    points = tables["control_points"]
    seen, _ = triangulated(scene, tables["marks"], len(points))
    return [points.names[row] for row in np.flatnonzero(points.is_control & np.isfinite(seen).all(axis=1))]


def _check_exchanged(
    scene: Scene, survey: Survey, source: FloatArray, tables: dict[str, Any], fit: RobustSimilarity | None
) -> None:
    """Refuse longitudes and latitudes that fit much better the other way round, or only so."""
    given = survey.positions
    if given is None or not given.system.is_geographic or "control_points" in tables or len(source) < 4:
        return
    swapped = replace(given, coordinates=given.coordinates[:, [1, 0, 2]])
    if np.abs(swapped.coordinates[:, 1]).max() > 90.0:
        return
    xyz = common_frame([swapped])[0][0]
    try:
        other = robust_similarity(source, xyz[rows_by_name(given.names, scene.images.names) >= 0])
    except InputError:
        return
    if fit is None or other.scatter * GATES.mirrored < fit.scatter:
        raise InputError(
            f"{given.source}: its places fit the scene much better with longitude and latitude exchanged. x is the "
            "longitude; correct the order."
        )


def _scaled(scene: Scene, tables: dict[str, Any], notes: list[str]) -> tuple[Scene, Similarity, None]:
    """Return the scene in the unit of its measured distances."""
    ratios: list[float] = []
    if (between := tables.get("camera_distances")) is not None:
        centers = scene.cam_centers_in_world
        ratios += (between.distance / _apart(centers, between)).tolist()
    if (between := tables.get("point_distances")) is not None:
        points, marks = tables.get("control_points", scene.control_points), tables.get("marks", scene.marks)
        seen, _ = triangulated(scene, marks, len(points))
        ratios += (between.distance / _apart(seen, between)).tolist()
    usable = [ratio for ratio in ratios if np.isfinite(ratio)]
    if not usable:
        return scene, Similarity(), None
    similarity = Similarity(float(np.median(usable)))
    notes.append(
        f"The scene was scaled by {similarity.scale:.6g} to its measured distances; place and direction are as before."
    )
    return scene.transformed(similarity), similarity, None


def _apart(places: FloatArray, between: PointDistances | CameraDistances) -> FloatArray:
    apart = np.linalg.norm(places[between.second_idx] - places[between.first_idx], axis=1)
    return np.where(apart > 0.0, apart, np.nan)


# -------------------------------------------------------------------------------------------------------------- words
def _tell_unknown(given: Places, rows: IntArray, known: Sequence[str], words: str, notes: list[str]) -> None:
    unknown = [given.names[row] for row in np.flatnonzero(rows < 0)]
    if unknown:
        listed = [name + nearest(name, known) for name in unknown[:_LISTED]]
        more = f" and {len(unknown) - _LISTED} more" if len(unknown) > _LISTED else ""
        notes.append(f"{given.source}: {counted(len(unknown), 'positions')} of {words}: {', '.join(listed)}{more}.")


def _listed(names: Sequence[str], kind: str) -> str:
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return f"{counted(len(names), kind)}, {', '.join(names[:_LISTED])}{more}"


def _say_fit(fit: RobustSimilarity, similarity: Similarity, frame: WorldFrame) -> str:
    return (
        f"The scene was brought into {frame.description} by a similarity (scale {similarity.scale:.6g}) to "
        f"{int(fit.inliers.sum())} of {len(fit.inliers)} measured places, which scatter by {fit.scatter:.3g} a "
        "coordinate."
    )


__all__ = ["Survey", "Surveyed", "with_survey"]

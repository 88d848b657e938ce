# SPDX-License-Identifier: BSD-3-Clause
"""Planes, common directions, and which points and lines belong to them: the structure of a scene.

From a scene with poses, points and perhaps lines:

1. the noise of every landmark, from its observations, the cameras held;
2. planes in points and segments (:mod:`groma.estimators.plane_fit`), directions shared by lines
   (:mod:`groma.estimators.directions`), with covariances;
3. relations, each a statistical test: point on plane, line on plane, line along direction, point on line, lines that
   meet, planes and directions that are parallel or at right angles. Gravity, where it was measured, is a direction too.

There are no tolerances in pixels or scene units; all tests use the covariances. Uncertain pairs are left out: a missing
relation costs little, a wrong one bends the scene.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.adjustment.assembly_options import SURFACE_SIGMA_PX
from groma.adjustment.terms.relations import ANGLES, lengths_per_pixel
from groma.errors import InputError, given_or_default
from groma.estimators.directions import DirectionOptions, DirectionSet, directions_from_lines
from groma.estimators.plane_search import PlaneOptions, PlaneSearch, PlaneSet
from groma.execution import begin, together
from groma.geometry.algebra import norm
from groma.mapping.groups import num_distinct
from groma.mapping.noise.landmarks import LineNoise, PointNoise, line_noise, point_noise
from groma.mapping.structure.angles import Vector, angles_between, vertical_of
from groma.mapping.structure.bending import bending
from groma.mapping.structure.junctions import meetings
from groma.mapping.structure.relations import Landmarks, Pairs, on_lines, spacings
from groma.mapping.structure.rough_planes import on_fitted_planes
from groma.scene import Directions, Held, Planes, Relations, Scene
from groma.scene.checks import check_scene_given
from groma.scene.survey import Kind
from groma.scene.table import new_index_of

#: Of points, and of lines.
LandmarkNoise = tuple[PointNoise, LineNoise]
#: Related lines below which a direction is not one that lines share.
_MIN_PARALLEL = 2


@dataclass(frozen=True)
class StructureOptions:
    """Options of :func:`find_structure`."""

    #: What counts as a plane.
    planes: PlaneOptions = field(default_factory=PlaneOptions)
    #: What counts as a direction shared by lines.
    directions: DirectionOptions = field(default_factory=partial(DirectionOptions, min_coincidences=2))
    #: Whether relations between points and lines are returned.
    points_on_lines: bool = True
    #: Level of the chi-square tests of relations (convention: level of a test).
    level: float = 0.99
    #: Least probability that a related landmark is no clutter.
    min_probability: float = 0.7
    #: The same for lines on planes. It is higher, as a wrong relation bends a whole line, and as covariances do not
    #: contain errors that images share, such as those of an edge that is a groove.
    min_line_probability: float = 0.9
    #: The same for lines along directions, whose errors have heavy tails already (chosen on boxes 704 and 1403 of
    #: benchmarks/structure.py).
    min_direction_probability: float = 0.8
    #: Landmarks seen in fewer images take no part: nothing checks their matches. A stereo pair is two images.
    min_views: int = 3
    #: Points whose reprojection error is so many times the usual one take no part. Lines do, with the noise that their
    #: own residuals show.
    max_misfit: float = 3.0
    #: Deviation of landmarks from the surfaces they lie on, as a length in the images, pixels, that is added to their
    #: noise while planes are sought; how far they deviate beyond that is estimated. For what lies on a plane within
    #: this noise a common deviation is estimated for the adjustment (:mod:`groma.mapping.structure.flatness`).
    surface_sigma_px: float = SURFACE_SIGMA_PX
    #: Standard deviations of points and of segment end points, pixels; None: from the residuals.
    point_sigma_px: float | None = None
    line_sigma_px: float | None = None


@dataclass(frozen=True)
class Structure:
    """A scene with its structure, and how sure it is."""

    #: The scene with new planes, directions and relations.
    scene: Scene
    #: The planes as found, with covariance, in the order of the scene.
    planes: PlaneSet
    #: The directions as found, with covariance, in the order of the scene.
    directions: DirectionSet
    #: Probability that each relation is no coincidence, by the names of :class:`groma.scene.Relations`.
    probability: dict[str, FloatArray]
    #: Standard deviations that the tests used, pixels; 0 where there is nothing of the kind.
    point_sigma_px: float
    line_sigma_px: float


def find_structure(
    scene: Scene,
    options: StructureOptions | None = None,
    progress: Callable[[str, int, int], None] | None = None,
    noise: LandmarkNoise | None = None,
) -> Scene:
    """Return the scene with planes, directions and relations found in its points and lines.

    Parameters
    ----------
    scene : Scene
        Posed images with points, lines or both, and their observations. It is not changed; planes, directions and
        relations that it has are replaced.
    options : StructureOptions, optional
        See there.
    progress : callable, optional
        Called with stage, number done, number in all.
    noise : optional
        :func:`landmark_noise` of the scene, where it is known already.

    Returns
    -------
    Scene
        The same cameras and landmarks; planes, directions and relations are new, and none where none stands out.

    Raises
    ------
    InputError
        If an option is out of range.

    Notes
    -----
    Poses are held. Adjust the scene first: in a distorted reconstruction walls are not planar.
    """
    return detect_structure(scene, options, progress, noise).scene


def detect_structure(
    scene: Scene,
    options: StructureOptions | None = None,
    progress: Callable[[str, int, int], None] | None = None,
    noise: LandmarkNoise | None = None,
) -> Structure:
    """Find planes, directions and relations, and return them with covariances and probabilities.

    Parameters and exceptions are those of :func:`find_structure`.
    """
    options = given_or_default(options, StructureOptions)
    check_scene_given(scene)
    _check(options)
    scene = scene.keep(planes=[], directions=[])
    report = progress or (lambda stage, done, total: None)
    level, least, least_line = options.level, options.min_probability, options.min_line_probability
    report("finding planes", 0, 1)
    marks = _landmarks(scene, options, noise)
    parallels = begin(partial(_parallels, scene, marks, options))
    meeting = begin(partial(meetings, marks, level, least_line))
    on_line = on_lines(marks, level, least)
    search = partial(_plane_search(marks, on_line, options).planes, progress=partial(report, "finding planes"))
    enough = options.planes.min_support
    planes, point_on_plane, line_on_plane = on_fitted_planes(
        marks, search(), level, (least, least_line), enough, again=search
    )
    report("finding directions", 0, 1)
    directions, along = parallels()
    found = {"lines_meeting": meeting()}
    report("finding relations", 0, 1)
    support = point_on_plane.counts(len(planes)) + 2 * line_on_plane.counts(len(planes))
    kept = (support >= (enough + 1) // 2) & ~bending(marks, planes, point_on_plane, line_on_plane, level)
    planes, new = _only(planes, kept)
    found |= {"point_on_plane": point_on_plane.renumbered(new), "line_on_plane": line_on_plane.renumbered(new)}
    found["line_along_direction"] = along
    found["point_on_line"] = on_line if options.points_on_lines else Pairs.empty()
    vertical = vertical_of(scene)
    found |= angles_between(planes, directions, (found["line_on_plane"], along), vertical, level)
    return Structure(
        scene=_with_vertical(scene, vertical, directions, found).replace(
            planes=Planes(np.arange(len(planes)) + 1, planes.planes), relations=_relations(found, marks, options)
        ),
        planes=planes,
        directions=directions,
        probability={name: relation.probability for name, relation in found.items()},
        point_sigma_px=marks.point_noise.sigma_px if scene.num_points else 0.0,
        line_sigma_px=marks.line_noise.sigma_px if scene.num_lines else 0.0,
    )


def _check(options: StructureOptions) -> None:
    least = options.min_probability, options.min_line_probability, options.min_direction_probability
    if not (0.0 < options.level < 1.0 and all(0.0 <= one < 1.0 for one in least)):
        raise InputError(
            "level must lie between 0 and 1, min_probability, min_line_probability and min_direction_probability from "
            f"0 to below 1; got {options.level} and {', '.join(map(str, least))}. Usual values are 0.95, and 0.7, 0.9 "
            "and 0.8."
        )


def _plane_search(marks: Landmarks, on_line: Pairs, options: StructureOptions) -> PlaneSearch:
    """A search for planes in the usable points and segments."""
    points, lines = np.flatnonzero(marks.point_usable), np.flatnonzero(marks.line_usable)
    line_of_point, position = np.full(len(marks.points), -1), np.full(len(marks.segments) + 1, -1)
    line_of_point[on_line.pairs[:, 0]] = on_line.pairs[:, 1]
    position[lines] = np.arange(len(lines))
    return PlaneSearch(
        marks.points[points],
        marks.point_noise.covariance[points],
        marks.segments[lines],
        marks.line_noise.ends(lines),
        options.planes,
        position[line_of_point[points]],
    )


def _parallels(scene: Scene, marks: Landmarks, options: StructureOptions) -> tuple[DirectionSet, Pairs]:
    """Directions that usable lines share, and the lines along them."""
    lines, length = np.flatnonzero(marks.line_usable), norm(marks.segments[:, 1] - marks.segments[:, 0])
    found = directions_from_lines(
        scene.lines.plucker[lines, 3:],
        marks.own_line_noise.directions(length)[lines],
        replace(options.directions, level=options.level),
        math.sqrt(2.0) * marks.line_pixel[lines] / length[lines],
    )
    rows = np.flatnonzero(found.label >= 0)
    rows = rows[found.probability[rows] > options.min_direction_probability]
    pairs = np.column_stack([lines[rows], found.label[rows]])
    along = Pairs(pairs, found.probability[rows], found.deviation[rows])
    directions, new = _only_directions(found, along.counts(len(found)) >= _MIN_PARALLEL)
    return directions, along.renumbered(new)


def _relations(found: dict[str, Pairs], marks: Landmarks, options: StructureOptions) -> Relations:
    """Relations, with standard deviations of their own where landmarks deviate from a structure."""
    sigma = {}
    for kind, pixel in (("point_on_plane", marks.point_pixel), ("line_on_plane", marks.line_pixel)):
        mark, rough = found[kind].pairs[:, 0], found[kind].deviation
        sigma[f"{kind}_sigma"] = (rough > 0.0) * np.hypot(rough, options.surface_sigma_px) * pixel[mark]
    first, missing = found["lines_meeting"].pairs[:, 0], found["lines_meeting"].deviation
    sigma["lines_meeting_sigma"] = missing * marks.line_pixel[first]
    along, crooked = found["line_along_direction"].pairs[:, 0], found["line_along_direction"].deviation
    turned = math.sqrt(2.0) * crooked * (marks.line_pixel / norm(marks.segments[:, 1] - marks.segments[:, 0]))[along]
    sigma |= {f"{kind}_sigma": found[kind].deviation for kind in ANGLES}
    sigma["line_along_direction_sigma"] = (crooked > 0.0) * np.hypot(turned, options.directions.parallel_sigma)
    return Relations(**{kind: pairs.pairs for kind, pairs in found.items()}, **sigma)


def _with_vertical(scene: Scene, vertical: Vector | None, directions: DirectionSet, found: dict[str, Pairs]) -> Scene:
    """Return the scene with its directions; the vertical is one more, and held, where anything is related to it."""
    vectors, held, number = directions.vectors, scene.held, len(directions)
    if vertical is not None and any((found[kind].pairs[:, 1] == number).any() for kind in ANGLES if "dir" in kind):
        vectors = np.vstack([vectors, vertical[0]])
        held = Held(np.append(held.kind, Kind.DIRECTION), np.append(held.idx, number))
    return scene.replace(directions=Directions(np.arange(len(vectors)) + 1, vectors), held=held)


def landmark_noise(scene: Scene, options: StructureOptions) -> LandmarkNoise:
    """Return the noise of points and of lines, which does not depend on the planes that are found in them."""
    of_points = partial(point_noise, scene, options.point_sigma_px)
    return together(of_points, partial(line_noise, scene, options.line_sigma_px))


def _landmarks(scene: Scene, options: StructureOptions, noise: LandmarkNoise | None) -> Landmarks:
    """Points and lines with their noise, and which of them may take part."""
    points, usual = noise or landmark_noise(scene, options)
    own = usual.by_misfit()
    point_pixel, line_pixel = lengths_per_pixel(scene, "point"), lengths_per_pixel(scene, "line")
    points = points.widened(options.surface_sigma_px * point_pixel)
    lines = own.widened(options.surface_sigma_px * line_pixel)
    point_spacing, end_spacing = spacings(scene.points.xyz, scene.lines.segments)
    table = scene.point_observations
    seen = num_distinct(table.point_idx, table.image_idx, scene.num_points)
    seen = seen + np.bincount(table.point_idx[scene.right_columns.observation_idx], minlength=scene.num_points)
    lines_seen = num_distinct(scene.line_observations.line_idx, scene.line_observations.image_idx, scene.num_lines)
    point_usable = (seen >= options.min_views) & (points.misfit < options.max_misfit)
    length = norm(scene.lines.segments[:, 1] - scene.lines.segments[:, 0])
    line_usable = (lines_seen >= options.min_views) & (length > 0.0)
    return Landmarks(
        scene.points.xyz,
        points,
        point_usable,
        scene.lines.segments,
        lines,
        own,
        line_usable,
        point_spacing,
        end_spacing,
        scene.line_intervals,
        point_pixel,
        line_pixel,
    )


def _only(planes: PlaneSet, kept: BoolArray) -> tuple[PlaneSet, IntArray]:
    """Return some of the planes, and the new number of each old one, -1 where it is gone."""
    rows = np.flatnonzero(kept)
    new = new_index_of(rows, len(kept))
    return planes.take(rows, new), new


def _only_directions(directions: DirectionSet, kept: BoolArray) -> tuple[DirectionSet, IntArray]:
    """Return some of the directions, and the new number of each old one, -1 where it is gone."""
    new = new_index_of(np.flatnonzero(kept), len(kept))
    right = new[directions.orthogonal]
    chosen = DirectionSet(
        directions.vectors[kept],
        directions.covariance[kept],
        directions.support[kept],
        directions.log10_false_alarms[kept],
        np.append(new, -1)[directions.label],
        right[(right >= 0).all(axis=1)],
        directions.probability,
        directions.deviation,
    )
    return chosen, new

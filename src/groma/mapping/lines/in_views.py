# SPDX-License-Identifier: BSD-3-Clause
"""Lines of images wider than a plane can hold: mapped in their flat views, and told of the images.

The views of an image (:mod:`groma.mapping.wide_views`) are images of their own in a scene that is made for mapping
lines. Its observations belong to the images again afterwards. Views of one image see from the same place, so they are
no neighbours of each other, and a line must be seen by enough images, not views.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from groma import cameras as camera_models
from groma._rows import pointers_of
from groma._typing import FloatArray, IntArray
from groma.errors import InputError
from groma.features.segments import Segments
from groma.geometry import quaternion
from groma.geometry.algebra import unit
from groma.mapping.groups import num_distinct
from groma.mapping.lines.build import map_lines
from groma.mapping.lines.hypotheses.earlier import EarlierMap
from groma.mapping.lines.line_map import LineMap
from groma.mapping.lines.matches import LineMatches, MatchProvider
from groma.mapping.lines.neighbors import covisible_neighbors
from groma.mapping.lines.options import MapLinesOptions
from groma.mapping.lines.outcomes import Outcome
from groma.mapping.wide_views import WideViews
from groma.scene import Cameras, PointObservations, Scene


def map_lines_in_views(
    scene: Scene,
    segments: Sequence[Segments],
    matches: Mapping[tuple[int, int], LineMatches] | MatchProvider | None = None,
    options: MapLinesOptions | None = None,
    progress: Callable[[str, int, int], None] | None = None,
    neighbors: Callable[[Scene], list[IntArray]] | None = None,
    earlier: EarlierMap | None = None,
) -> LineMap:
    """Build 3D lines from the segments of posed images of any camera, panoramas and fisheyes too.

    Arguments and result as in :func:`groma.mapping.lines.build.map_lines`, which does the work. Where images are
    seen in views, ``earlier`` is not used.

    Raises
    ------
    InputError
        As there; and where matches or a choice of neighbours are given for images that are seen in views.
    """
    wide = wide_cameras(scene.cameras)
    if not any(wide):
        return map_lines(scene, segments, matches, options, progress, neighbors, earlier)
    if matches is not None or neighbors is not None:
        raise InputError(
            "Matches of segments and retrieval of images need images that a plane holds; these are panoramas or wide "
            "fisheyes, whose lines are found by poses alone. Leave the matcher, the matches and the retrieval out."
        )
    options = options or MapLinesOptions()
    split = _split(scene, segments, wide)
    choose = partial(split.neighbors, options=options)
    found = map_lines(split.scene, split.segments, None, options, progress, choose)
    return split.joined(found, [len(one) for one in segments], options.min_images)


def wide_cameras(cameras: Cameras) -> list[WideViews | None]:
    """Return the views of each camera, None for those that a plane holds."""
    sizes = np.column_stack([cameras.width, cameras.height]).tolist()
    return [
        WideViews.of(camera_models.model(name), cameras.params_of(row), *sizes[row])
        for row, name in enumerate(cameras.models)
    ]


@dataclass(frozen=True, eq=False)
class _Split:
    """Images as views."""

    #: The views as images, with the points that they see.
    scene: Scene
    #: Of each view.
    segments: list[Segments]
    #: (V,) the image of each view.
    image: IntArray
    #: For each view, the numbers of its segments in their image.
    rows: list[IntArray]

    def neighbors(self, scene: Scene, options: MapLinesOptions) -> list[IntArray]:
        """Neighbours of each view that are no views of the same image."""
        most = int(np.bincount(self.image).max())
        found = covisible_neighbors(scene, options.num_neighbors + most - 1, options.min_shared)
        others = (near[self.image[near] != self.image[view]] for view, near in enumerate(found))
        return [near[: options.num_neighbors] for near in others]

    def joined(self, found: LineMap, counts: Sequence[int], min_images: int) -> LineMap:
        """Return the map in terms of the images, of lines that enough of them see."""
        first = pointers_of(counts)
        row_of = np.concatenate([
            np.zeros(0, np.int64), *(first[i] + rows for i, rows in zip(self.image, self.rows, strict=True))
        ])  # fmt: skip

        def told(values: Any, default: int) -> Any:
            """Values of all segments of the views as values of all segments of the images."""
            whole = np.full((first[-1], *values.shape[1:]), default, values.dtype)
            whole[row_of] = values
            return whole

        image = self.image[found.image_idx]
        number = num_distinct(found.line_idx, image, found.num_lines)
        enough = number >= min_images
        outcomes = told(np.concatenate([np.zeros(0, np.int64), *found.outcomes]), Outcome.TOO_SHORT)
        segment = np.array([self.rows[v][s] for v, s in zip(found.image_idx, found.segment_idx, strict=True)], np.int64)
        dropped = ~enough[found.line_idx]
        outcomes[first[image[dropped]] + segment[dropped]] = Outcome.FEW_IMAGES
        kept = np.flatnonzero(~dropped)
        kept = kept[np.lexsort([segment[kept], image[kept], found.line_idx[kept]])]
        supporters = np.where(found.supporters >= 0, row_of[found.supporters], -1)
        neighbors = [np.zeros(0, np.int64) for _ in counts]
        for view, near in enumerate(found.neighbors):
            own = neighbors[self.image[view]]
            neighbors[self.image[view]] = np.concatenate([own, np.setdiff1d(self.image[near], own)])
        return replace(
            found,
            lines=found.lines[enough],
            segments=found.segments[enough],
            image_idx=image[kept],
            segment_idx=segment[kept],
            line_idx=(np.cumsum(enough) - 1)[found.line_idx[kept]],
            residual=found.residual[kept],
            num_images=number[enough],
            median_residual=found.median_residual[enough],
            uncertainty=found.uncertainty[enough],
            outcomes=tuple(np.split(outcomes, first[1:-1])),
            neighbors=tuple(neighbors),
            supporters=told(supporters.astype(np.int32), -1),
            rejection=told(found.rejection, Outcome.TOO_SHORT),
            depth_ratios=told(found.depth_ratios, 0),
        )


def _split(scene: Scene, segments: Sequence[Segments], wide: Sequence[WideViews | None]) -> _Split:
    """Return the images as views; those that a plane holds stay as they are."""
    cameras, first_camera = _cameras(scene.cameras, wide)
    parts, image, camera, poses, rows = [], [], [], [], []
    observed: list[tuple[Any, ...]] = []
    seen, of_image = scene.point_observations, scene.images.camera_idx
    order = np.argsort(seen.image_idx, kind="stable")
    bounds = np.searchsorted(seen.image_idx[order], np.arange(scene.num_images + 1))
    for i, which in enumerate(of_image):
        mine, views = order[bounds[i] : bounds[i + 1]], wide[which]
        own, found = _in_views(views, segments[i]), _points_in_views(views, seen.pixel[mine])
        for view in range(1 if views is None else len(views)):
            rows.append(own[view][0])
            parts.append(own[view][1])
            kept, pixel = found[view]
            observed.append((np.full(len(kept), len(image)), seen.point_idx[mine[kept]], pixel))
            image.append(i)
            camera.append(first_camera[which] + view)
            poses.append(_turned(scene.cam_from_world[i], None if views is None else views.view_from_cam[view]))
    in_view, point, pixel = (np.concatenate(column) for column in zip(*observed, strict=True))
    table = PointObservations(in_view, point, pixel, np.arange(len(point)))
    names = [str(view) for view in range(len(image))]
    made = Scene.from_images(cameras, names, camera, np.array(poses), points=scene.points, point_observations=table)
    return _Split(made, parts, np.array(image, np.int64), rows)


def _cameras(cameras: Cameras, wide: Sequence[WideViews | None]) -> tuple[Cameras, list[int]]:
    """Cameras of the views, and the number of the first of each camera."""
    models, params, sizes, first = [], [], [], []
    for row, views in enumerate(wide):
        first.append(len(models))
        if views is None:
            models.append(cameras.models[row])
            params.append(cameras.params_of(row))
            sizes.append((cameras.width[row], cameras.height[row]))
            continue
        models += ["PINHOLE"] * len(views)
        params += list(views.pinhole)
        sizes += views.view_size.tolist()
    return Cameras.of(np.arange(len(models)) + 1, models, params, sizes), first


def _in_views(views: WideViews | None, segments: Segments) -> list[tuple[IntArray, Segments]]:
    """For each view, which segments of an image belong to it, and these in its pixels."""
    if views is None:
        return [(np.arange(len(segments)), segments)]
    first, second = (views.model.unproject(views.params, segments.ends[:, part]) for part in (slice(0, 2), slice(2, 4)))
    good = np.isfinite(first).all(axis=1) & np.isfinite(second).all(axis=1)
    middle = views.view_of(np.nan_to_num(unit(first + second)))
    found = []
    for view in range(len(views)):
        axis = views.view_from_cam[view, 2]
        # What reaches out of the view, as segments from elsewhere may, lies before it, at least.
        rows = np.flatnonzero(good & (middle == view) & (np.minimum(first @ axis, second @ axis) > 0.1))
        ends = np.hstack([views.to_view(view, first[rows]), views.to_view(view, second[rows])])
        sigma = segments.sigma[rows] / views.noise_ratio(view, first[rows], second[rows])
        found.append((rows, replace(segments.select(rows), ends=ends, sigma=sigma)))
    return found


def _points_in_views(views: WideViews | None, pixels: FloatArray) -> list[tuple[IntArray, FloatArray]]:
    """For each view, which points of an image it shows, and where."""
    if views is None:
        return [(np.arange(len(pixels)), pixels)]
    rays = np.nan_to_num(views.model.unproject(views.params, pixels))
    found = []
    for view in range(len(views)):
        rows = np.flatnonzero(rays @ views.view_from_cam[view, 2] > 0.1)
        places = views.to_view(view, rays[rows])
        inside = np.all((places >= 0.0) & (places <= views.view_size[view]), axis=1)
        found.append((rows[inside], places[inside]))
    return found


def _turned(pose: FloatArray, view_from_cam: FloatArray | None) -> FloatArray:
    if view_from_cam is None:
        return pose
    rotation = view_from_cam @ quaternion.to_matrix(pose[None, :4])[0]
    return np.concatenate([quaternion.from_matrix(rotation[None])[0], view_from_cam @ pose[4:]])

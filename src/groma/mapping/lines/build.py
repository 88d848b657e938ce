# SPDX-License-Identifier: BSD-3-Clause
"""3D lines from the segments of posed images.

Stages, each on all images before the next begins:

1. neighbours by the points that images share (:mod:`groma.mapping.lines.neighbors`);
2. segments without distortion, with the depths at which to look for them (:mod:`groma.mapping.lines.views`), and how
   vanishing points say that the depth changes along them (:mod:`groma.mapping.lines.hypotheses.directions`);
3. the place of every segment in space, on which most of its neighbours agree
   (:mod:`groma.mapping.lines.hypotheses.positions`);
4. lines: segments whose positions agree, and what else lies on them (:mod:`groma.mapping.lines.linking.growth`);
5. lines that were mapped more than once are joined (:mod:`groma.mapping.lines.linking.merge`);
6. filters: seen by enough images, well determined, no texture, no duplicate, long enough
   (:mod:`groma.mapping.lines.filtering.filters`).

Every segment ends with an :class:`Outcome` (:mod:`groma.mapping.lines.outcomes`), so that the question why a line is
missing has an answer.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from groma._typing import IntArray
from groma.errors import InputError, check_kind, given_or_default
from groma.execution import work_with
from groma.features.matches import LineMatches
from groma.features.segments import Segments
from groma.mapping.lines.by_clusters import map_lines_by_clusters
from groma.mapping.lines.collect import line_map_of
from groma.mapping.lines.filtering.filters import Evidence, filtered
from groma.mapping.lines.hypotheses.directions import depth_ratios
from groma.mapping.lines.hypotheses.earlier import EarlierMap
from groma.mapping.lines.hypotheses.positions import find_positions
from groma.mapping.lines.line_map import LineMap
from groma.mapping.lines.linking.growth import grow
from groma.mapping.lines.linking.merge import merge_agreeing
from groma.mapping.lines.linking.tracks import Tracks
from groma.mapping.lines.matches import MatchProvider
from groma.mapping.lines.neighbors import covisible_neighbors
from groma.mapping.lines.options import MapLinesOptions
from groma.mapping.lines.views import build_views
from groma.scene import Scene
from groma.scene.checks import check_scene_given


def map_lines(
    scene: Scene,
    segments: Sequence[Segments],
    matches: Mapping[tuple[int, int], LineMatches] | MatchProvider | None = None,
    options: MapLinesOptions | None = None,
    progress: Callable[[str, int, int], None] | None = None,
    neighbors: Callable[[Scene], list[IntArray]] | None = None,
    earlier: EarlierMap | None = None,
) -> LineMap:
    """Build 3D lines from the segments of posed images.

    Parameters
    ----------
    scene : Scene
        Images with cameras and poses. Points and their observations choose the neighbours and bound the depths.
    segments : sequence of C Segments
        By image of the scene; COLMAP pixels of the cameras as they are (with distortion, if they have one).
    matches : mapping or callable, optional
        LineMatches of images (i, j), pairs of segments of i and j; a pair that is missing or None is taken as
        unmatched. (j, i) is used where (i, j) is missing in a mapping. Without it every segment in the epipolar beam
        is a candidate.
    options : MapLinesOptions, optional
        Lengths, gates and counts.
    progress : callable, optional
        Called with stage, number done, number in all.
    neighbors : callable, optional
        Chooses for every image of a scene which others it is compared with, the best first, in place of
        :func:`~groma.mapping.lines.neighbors.covisible_neighbors`.
    earlier : EarlierMap, optional
        A map of the same segments at nearly the same poses: only what these poses change is searched again. Not used
        where matches are given.

    Returns
    -------
    LineMap
        Perhaps without lines: :func:`explain` then says why.

    Raises
    ------
    InputError
        If the number of segment sets is not the number of images, or an earlier map is of other segments.

    Notes
    -----
    Time and memory grow with images x neighbours x segments; proposals are kept for one image only.
    """
    options = given_or_default(options, MapLinesOptions)
    check_scene_given(scene)
    check_kind(segments, Sequence, "segments", "Pass a list with the Segments of each image.")
    if len(segments) != scene.num_images:
        raise InputError(
            f"segments must hold one set per image of the scene ({scene.num_images}); got {len(segments)}. "
            "Pass Segments.empty() for images without."
        )
    if earlier is not None and len(earlier.lines.rejection) != sum(len(one) for one in segments):
        raise InputError(
            f"The earlier map must be of the same segments ({sum(len(one) for one in segments)}); it is of "
            f"{len(earlier.lines.rejection)}. Pass none to map the lines from the beginning."
        )
    report = progress or (lambda stage, done, total: None)
    choose = neighbors or partial(
        covisible_neighbors, num_neighbors=options.num_neighbors, min_shared=options.min_shared
    )
    with work_with():
        compared = choose(scene)
        if matches is None and 0 < options.cluster_size < scene.num_images:
            return map_lines_by_clusters(scene, segments, compared, options, report, earlier)
        views = build_views(scene, segments, options.min_length, options.noise, options.depth_margin)
        known = None if earlier is None or matches is not None else earlier.known(scene, views, compared, options.noise)
        if earlier is not None and earlier.same_cameras(scene):
            ratios = earlier.lines.depth_ratios  # by the image alone, whatever its pose
        else:
            ratios = depth_ratios(scene, segments, views)
        proposing, linking = partial(report, "proposing lines"), partial(report, "linking segments")
        positions = find_positions(scene, views, ratios, compared, matches, options, proposing, known)
        unmerged = grow(Tracks.none(views, positions.rejection), positions, compared, options, linking)
        evidence = Evidence(
            options=options,
            neighbors=compared,
            strength=np.concatenate([np.zeros(0), *(one.strength for one in segments)]),
            size=np.column_stack([scene.cameras.width, scene.cameras.height])[scene.images.camera_idx],
            unmerged=unmerged,
        )
        tracks = filtered(merge_agreeing(unmerged), evidence)
        rows = np.arange(len(views.image_idx))
        return line_map_of(tracks, rows, views.pointers, tracks.outcomes(), compared, positions, ratios)

# SPDX-License-Identifier: BSD-3-Clause
"""The parts of a map that can be exchanged: detector, matcher and retrieval, by name or as objects.

In come options that name them and a folder of photographs; out come what :func:`groma.mapping.lines.build.map_lines`
takes: matches of pairs of images, and which images are compared.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from groma._typing import IntArray
from groma.errors import InputError
from groma.execution import map_work
from groma.features.contract import ImageRetrieval
from groma.features.external import ExternalMatches
from groma.features.registry import DETECTORS, MATCHERS, RETRIEVAL
from groma.features.retrieval import most_similar
from groma.features.segments import Segments
from groma.mapping.lines.matches import ImageReader, MatchProvider, given_matches, segment_matches
from groma.mapping.lines.neighbors import covisible_neighbors
from groma.mapping.options import MapOptions
from groma.mapping.photographs import image_reader
from groma.mapping.read_rows import check_read_rows
from groma.scene import Scene

#: Chooses for every image of a scene which others it is compared with, the best first.
NeighborChooser = Callable[[Scene], list[IntArray]]
_Options = TypeVar("_Options", bound="MapOptions")


def with_parts(options: _Options) -> _Options:
    """Return options with the parts themselves in place of their names, so that their settings are in them.

    Raises
    ------
    InputError
        If there is no part of a name, or an object is no such part.
    """
    check_read_rows(options)
    return dataclasses.replace(
        options,
        detector=DETECTORS.make(options.detector, min_length=options.min_segment_length, max_segments=0),
        matcher=None if options.matcher is None else MATCHERS.make(options.matcher),
        retrieval=None if options.retrieval is None else RETRIEVAL.make(options.retrieval),
    )


def matches_for(
    options: MapOptions, folder: Path, scene: Scene, segments: list[Segments], given: ExternalMatches | None
) -> MatchProvider | None:
    """Return the given matches, by index, or those of the chosen matcher; None for neither: geometry alone.

    Raises
    ------
    InputError
        If there are both.
    """
    names = scene.images.names
    if options.matcher is None:
        return None if given is None else given_matches(names, given)
    if given is not None:
        raise InputError("Matches are given, and a matcher is chosen. Leave one of them out.")
    return segment_matches(scene, segments, image_reader(folder, names), options.matcher)


def neighbors_for(options: MapOptions, folder: Path) -> NeighborChooser | None:
    """Return how neighbours are chosen with the chosen retrieval; None without one: by shared points alone."""
    if options.retrieval is None:
        return None
    retrieval, lines = RETRIEVAL.make(options.retrieval), options.lines

    def choose(scene: Scene) -> list[IntArray]:
        shared = covisible_neighbors(scene, lines.num_neighbors, lines.min_shared) if scene.num_points else []
        return similar_neighbors(
            scene, image_reader(folder, scene.images.names), retrieval, lines.num_neighbors, shared
        )

    return choose


def similar_neighbors(
    scene: Scene, image: ImageReader, retrieval: ImageRetrieval, num_neighbors: int, shared: list[IntArray]
) -> list[IntArray]:
    """Complete the neighbours of every image by those most similar to it.

    Parameters
    ----------
    scene : Scene
        Images.
    image : callable
        Gives the image of a number.
    retrieval : ImageRetrieval
        How images are compared.
    num_neighbors : int
        At most this many per image.
    shared : list of C arrays, or empty
        Neighbours known from elsewhere; they come first.
    """
    described = map_work(partial(_described, retrieval, image), range(scene.num_images))
    neighbors = []
    for i, query in enumerate(described):
        known = shared[i] if shared else np.zeros(0, np.int64)
        ranked = most_similar(retrieval, query, described, len(described))
        new = ranked[~np.isin(ranked, np.append(known, i))]
        neighbors.append(np.concatenate([known, new])[:num_neighbors].astype(np.int64))
    return neighbors


def _described(retrieval: ImageRetrieval, image: ImageReader, i: int) -> Any:
    return retrieval.describe(image(i))

# SPDX-License-Identifier: BSD-3-Clause
"""Detector, matcher and retrieval of a map: by name or as objects, and part of what finished stages depend on."""

from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from groma.errors import InputError
from groma.features import ExternalMatches, LsdDetector, Segments
from groma.features.registry import DETECTORS, RETRIEVAL
from groma.features.retrieval import GradientRetrieval, most_similar
from groma.mapping.checkpoints import digest
from groma.mapping.exchange import matches_for, neighbors_for, similar_neighbors, with_parts
from groma.mapping.lines.build import map_lines
from groma.mapping.lines.options import MapLinesOptions
from groma.mapping.map import map_images
from groma.mapping.options import MapOptions
from groma.scene import PointObservations, Points
from groma.testing import check_detector, check_matcher, check_retrieval
from groma.tracking import TrackOptions


@dataclass(frozen=True)
class Blind:
    """Finds nothing, and remembers in the class that it was asked."""

    setting: int = 0

    def detect(self, image):
        type(self).images = getattr(type(self), "images", 0) + 1
        return Segments.empty()


def test_names_become_parts_with_the_settings_of_the_map():
    parts = with_parts(MapOptions(min_segment_length=17.0, matcher="flow", retrieval="gradients"))
    assert parts.detector == LsdDetector(min_length=17.0)
    assert parts.matcher is not None and parts.retrieval == GradientRetrieval()
    assert with_parts(parts) == parts
    assert with_parts(MapOptions(detector=Blind())).detector == Blind()
    for wrong, said in ((MapOptions(detector="x"), "choose one of .*lsd"), (MapOptions(matcher="x"), "wide_baseline")):
        with pytest.raises(InputError, match=said):
            with_parts(wrong)
    with pytest.raises(InputError, match="needs the method detect; got object"):
        with_parts(MapOptions(detector=object()))
    assert TrackOptions(detector=Blind()).make_detector() == Blind()
    assert TrackOptions(num_lines=50).make_detector() == LsdDetector(min_length=30.0, max_segments=100)


def test_finished_stages_depend_on_the_parts():
    options = (MapOptions(), MapOptions(detector=Blind()), MapOptions(detector=Blind(1)), MapOptions(matcher="flow"))
    other = dataclass(frozen=True)(type("Blind", (), {"__annotations__": {"setting": int}, "detect": Blind.detect}))
    other.__module__ = "another.package"
    digests = [digest(with_parts(one)) for one in options] + [digest(MapOptions(detector=other(0)))]
    assert len(set(digests)) == len(digests)
    assert digests[1] == digest(with_parts(MapOptions(detector=Blind(0))))


def test_a_detector_of_ones_own_finds_the_segments(corner, tmp_path):
    folder, scene = corner
    Blind.images = 0
    result = map_images(folder, tmp_path / "work", scene, MapOptions(detector=Blind(), find_planes=False))
    assert Blind.images == 4
    assert result.scene.num_lines == 0


def test_a_matcher_and_given_matches_exclude_each_other(corner):
    folder, scene = corner
    none = [Segments.empty()] * scene.num_images
    with pytest.raises(InputError, match="Leave one of them out"):
        matches_for(MapOptions(matcher="flow"), folder, scene, none, ExternalMatches({}, {}))
    assert matches_for(MapOptions(), folder, scene, none, None) is None
    assert len(matches_for(MapOptions(matcher="flow"), folder, scene, none, None)(0, 1)) == 0


def test_similar_images_complete_neighbors_that_share_points(corner):
    folder, scene = corner
    bare = scene.replace(points=Points(), point_observations=PointObservations())
    chosen = neighbors_for(MapOptions(retrieval="gradients", lines=MapLinesOptions(num_neighbors=2)), folder)
    assert neighbors_for(MapOptions(), folder) is None
    alone = chosen(bare)
    assert [len(row) for row in alone] == [2, 2, 2, 2]
    assert all(i not in row for i, row in enumerate(alone))
    images = [cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE) for name in scene.images.names]
    known = [np.array([3]), np.array([0]), np.zeros(0, int), np.array([2, 1])]
    both = similar_neighbors(bare, lambda i: images[i], RETRIEVAL.make("gradients"), 2, known)
    assert both[0][0] == 3 and both[1][0] == 0 and both[3].tolist() == [2, 1]
    segments = [LsdDetector().detect(image) for image in images]
    result = map_lines(bare, segments, neighbors=chosen)
    assert [row.tolist() for row in result.neighbors] == [row.tolist() for row in alone]


def test_ranking_and_conformance_of_the_built_in_parts():
    check_detector(DETECTORS.make("lsd", min_length=20.0, max_segments=0))
    check_retrieval(GradientRetrieval())
    assert most_similar(GradientRetrieval(), np.ones(3), [], 5).tolist() == []


@pytest.mark.parametrize("name", ["flow", "wide_baseline"])
def test_built_in_matchers_conform(name):
    check_matcher(with_parts(MapOptions(matcher=name)).matcher)


class Shifted(LsdDetector):
    """Counts pixels from the centre of the first one."""

    def detect(self, image):
        found = super().detect(image)
        return Segments(found.ends - 1.5, found.sigma, found.strength)


class Undirected(LsdDetector):
    """Lets segments run from left to right."""

    def detect(self, image):
        found = super().detect(image)
        turned = found.ends[:, 0] > found.ends[:, 2]
        ends = np.where(turned[:, None], found.ends[:, [2, 3, 0, 1]], found.ends)
        return Segments(ends, found.sigma, found.strength)


@pytest.mark.parametrize(("detector", "said"), [(Shifted(), "edges are found"), (Undirected(), "darker side")])
def test_the_check_notices_a_wrong_detector(detector, said):
    with pytest.raises(AssertionError, match=said):
        check_detector(detector)

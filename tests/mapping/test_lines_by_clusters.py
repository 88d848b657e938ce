# SPDX-License-Identifier: BSD-3-Clause
"""Lines mapped cluster by cluster: each once, whoever does it; which versions are one line, and who gets a segment."""

import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from _wireframe import arc, distance_to_truth, random_lines, true_lines, wireframe

from groma.execution import work_with
from groma.mapping.lines.build import map_lines
from groma.mapping.lines.hypotheses.earlier import EarlierMap
from groma.mapping.lines.linking import borders as _borders
from groma.mapping.lines.linking.borders import Borders
from groma.mapping.lines.options import MapLinesOptions
from groma.mapping.lines.outcomes import Outcome

AT_ONCE = MapLinesOptions(num_neighbors=4)
IN_CLUSTERS = replace(AT_ONCE, cluster_size=6)


@pytest.fixture(scope="module")
def world():
    """Cameras all around forty lines, with clutter: every line runs across all borders."""
    rng = np.random.default_rng(7)
    return wireframe(arc(24, step=2.0 * np.pi / 24), random_lines(40, rng), rng, num_clutter=8)


@pytest.fixture(scope="module")
def found(world):
    with work_with(1):
        return {
            "at once": map_lines(world.scene, world.segments, None, AT_ONCE),
            "in clusters": map_lines(world.scene, world.segments, None, IN_CLUSTERS),
        }


def test_every_line_is_mapped_once_across_all_borders(world, found):
    """As at once: the same true lines, none twice, and all but one in a hundred of their segments.

    A hundredth: the gate of two degrees of freedom lets go 0.3 % of right observations, in either map.
    """
    lines = {name: true_lines(world, one) for name, one in found.items()}
    assert len(lines["at once"]) > 35
    assert sorted(lines["in clusters"]) == sorted(lines["at once"]) == sorted(set(lines["at once"]))
    assert len(found["in clusters"].image_idx) >= 0.99 * len(found["at once"].image_idx)
    assert found["in clusters"].num_images.max() > IN_CLUSTERS.cluster_size * 2
    for n, true in enumerate(lines["in clusters"]):
        assert distance_to_truth(world, found["in clusters"], n, true) < 4.0 * found["in clusters"].uncertainty[n]


def test_every_segment_has_the_outcome_of_its_line(world, found):
    one = found["in clusters"]
    pointers = np.concatenate([[0], np.cumsum([len(s) for s in world.segments])])
    outcomes, on_line = np.concatenate(one.outcomes), np.zeros(pointers[-1], bool)
    on_line[pointers[one.image_idx] + one.segment_idx] = True
    np.testing.assert_array_equal(outcomes <= Outcome.RECOVERED, on_line)
    assert len(np.unique(np.column_stack([one.image_idx, one.segment_idx]), axis=0)) == len(one.image_idx)
    assert [len(row) for row in one.outcomes] == [len(segments) for segments in world.segments]


def test_places_are_those_of_a_map_at_once(found):
    """A cluster and its ring hold all that the places of its segments depend on."""
    for column in ("supporters", "rejection", "depth_ratios"):
        np.testing.assert_array_equal(getattr(found["in clusters"], column), getattr(found["at once"], column))


def same(one, two):
    for name in ("lines", "segments", "image_idx", "segment_idx", "line_idx", "residual", "uncertainty", "supporters"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    np.testing.assert_array_equal(np.concatenate(one.outcomes), np.concatenate(two.outcomes))


def test_lines_do_not_depend_on_who_maps_clusters(world, found):
    for workers in (2, 3):
        with work_with(workers):
            same(map_lines(world.scene, world.segments, None, IN_CLUSTERS), found["in clusters"])
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool, work_with(pool):
        same(map_lines(world.scene, world.segments, None, IN_CLUSTERS), found["in clusters"])


def test_one_cluster_is_a_map_at_once(world, found):
    with work_with(1):
        same(map_lines(world.scene, world.segments, None, replace(AT_ONCE, cluster_size=24)), found["at once"])


def test_an_earlier_map_is_used_by_clusters(world, found):
    """At the same poses its places are found again by what supported them, as at once."""
    for name, options in (("at once", AT_ONCE), ("in clusters", IN_CLUSTERS)):
        with work_with(1):
            again = map_lines(world.scene, world.segments, None, options, earlier=EarlierMap(world.scene, found[name]))
        assert sorted(true_lines(world, again)) == sorted(true_lines(world, found[name]))


def test_clusters_without_lines(world):
    empty = [segments.select(np.zeros(0, np.int64)) for segments in world.segments]
    with work_with(1):
        none = map_lines(world.scene, empty, None, IN_CLUSTERS)
        assert none.num_lines == 0 and len(none.outcomes) == 24
        some = [*world.segments[:12], *empty[12:]]
        few, at_once = (map_lines(world.scene, some, None, options) for options in (IN_CLUSTERS, AT_ONCE))
    assert few.num_lines > 20 and set(few.image_idx) <= set(range(12))
    assert sorted(true_lines(world, few)) == sorted(true_lines(world, at_once))


# ------------------------------------------------------------------------------------------------------------- borders
#: Six images, two of them in each of three clusters; each knows one image of its neighbours. One segment an image.
LINKED = Borders(
    home=np.array([0, 0, 1, 1, 2, 2]),
    known=np.array([[1, 1, 1, 0, 0, 0], [0, 1, 1, 1, 1, 0], [0, 0, 0, 1, 1, 1]], bool),
    image_idx=np.repeat(np.arange(6), 2),
)


def versions(*lines):
    """Versions of lines: cluster and images of each, whose segments are the first of these images, or given rows."""
    cluster = np.array([one[0] for one in lines])
    rows = [np.array(one[1]) for one in lines]
    version = np.repeat(np.arange(len(lines)), [len(one) for one in rows])
    row = np.concatenate(rows)
    return _borders._Versions(cluster, version, row, LINKED.image_idx[row])


def test_versions_that_share_two_images_are_one_line():
    both = versions((0, [0, 2, 4]), (1, [2, 4, 6, 8]), (2, [6, 8, 10]))
    np.testing.assert_array_equal(_borders._groups(both, LINKED), [0, 0, 0])
    chosen, line = _borders._claimed(both, np.zeros(3, np.int64), LINKED)
    np.testing.assert_array_equal(both.row[chosen], [0, 2, 4, 6, 8, 10])
    np.testing.assert_array_equal(both.cluster[both.version[chosen]], LINKED.home[both.image[chosen]])
    assert set(line) == {0}


def test_versions_that_share_one_image_or_other_segments_are_two():
    np.testing.assert_array_equal(_borders._groups(versions((0, [0, 2]), (1, [2, 4, 6])), LINKED), [0, 1])
    np.testing.assert_array_equal(_borders._groups(versions((0, [0, 3, 5]), (1, [2, 4, 6])), LINKED), [0, 1])


def test_the_best_version_of_a_cluster_is_the_same_line():
    """The second of cluster 1 shares two images of three with that of cluster 0, the first all three."""
    wide = replace(LINKED, known=np.ones((3, 6), bool))
    lines = versions((0, [0, 2, 4]), (1, [0, 2, 4, 6]), (1, [1, 2, 4, 7]))
    assert list(_borders._groups(lines, wide)) == [0, 0, 2]


def test_a_segment_goes_to_the_line_of_its_own_cluster():
    lines = versions((0, [0, 2, 4]), (1, [4, 6, 8]))
    chosen, line = _borders._claimed(lines, np.arange(2), LINKED)
    assert dict(zip(lines.row[chosen].tolist(), line.tolist(), strict=True)) == {0: 0, 2: 0, 4: 1, 6: 1, 8: 1}


def test_a_line_that_the_cluster_of_most_of_its_images_has_not_is_left_out():
    lines = versions((0, [2, 4, 6]), (2, [6, 8, 10]))
    wide = replace(LINKED, known=np.ones((3, 6), bool))
    chosen, line = _borders._claimed(lines, np.arange(2), wide)
    assert set(line) == {1} and set(lines.row[chosen]) == {6, 8, 10}

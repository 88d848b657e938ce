# SPDX-License-Identifier: BSD-3-Clause
"""Structural factors: zero on perfect data, values against independent geometry, any scale of lines and planes.

Their derivatives are checked in test_all_factors.py.
"""

import numpy as np
import pytest

from groma.errors import ShapeError
from groma.factors.checks.check import ambients_of, compare_jacobians, linearized, residuals_of
from groma.factors.checks.world import WorldMotion, moved_world
from groma.factors.contract import Ref, registered
from groma.factors.relations.direction_pairs import (
    LineDirection,
    LineParallelToPlane,
    LinePerpendicularToPlane,
    OrthogonalLines,
    OrthogonalPlanes,
    ParallelLines,
    ParallelPlanes,
)
from groma.factors.relations.line_on_plane import LineOnPlane, SegmentOnPlane
from groma.factors.relations.point_on_line import PointOnLine
from groma.factors.relations.point_on_plane import PointOnPlane
from groma.geometry import so3

pytestmark = pytest.mark.kernels
N = 8
ALL = Ref("a", np.arange(N)), Ref("b", np.arange(N))
STRUCTURAL = [
    LineDirection, LineOnPlane, LineParallelToPlane, LinePerpendicularToPlane, OrthogonalLines, OrthogonalPlanes,
    ParallelLines, ParallelPlanes, PointOnLine, PointOnPlane, SegmentOnPlane,
]  # fmt: skip


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def line_through(p, d, scale=1.0):
    return scale * np.hstack([np.cross(p, d), d])


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def plane_through(p, n, scale=1.0):
    return scale * np.hstack([n, -np.sum(n * p, axis=1, keepdims=True)])


def test_point_on_line_is_the_distance(rng):
    p, d, q = rng.normal(size=(3, N, 3))
    factor = PointOnLine(point=ALL[0], line=ALL[1])
    np.testing.assert_allclose(residuals_of(factor, (p + 2.5 * d, line_through(p, d, -3.0))), 0.0, atol=1e-14)
    r = residuals_of(factor, (q, line_through(p, d, 4.0)))
    across = (q - p) - np.sum((q - p) * unit(d), axis=1, keepdims=True) * unit(d)
    np.testing.assert_allclose(np.linalg.norm(r, axis=1), np.linalg.norm(across, axis=1), rtol=1e-12)
    np.testing.assert_allclose(np.sum(r * d, axis=1), 0.0, atol=1e-13)


def test_point_on_line_has_rank_two(rng):
    p, d, q = rng.normal(size=(3, N, 3))
    record, _ = linearized(PointOnLine(point=ALL[0], line=ALL[1]), (q, line_through(p, d)), [3, 6])
    values = np.linalg.svd(record[:, :, :3], compute_uv=False)
    np.testing.assert_allclose(values, np.tile([1.0, 1.0, 0.0], (N, 1)), atol=1e-12)


def test_point_on_plane_is_the_signed_distance(rng):
    p, n = rng.normal(size=(2, N, 3))
    height = rng.normal(size=(N, 1))
    r = residuals_of(PointOnPlane(point=ALL[0], plane=ALL[1]), (p + height * unit(n), plane_through(p, n, 2.2)))
    np.testing.assert_allclose(r, height, atol=1e-13)


def test_line_on_plane_is_zero_for_lines_in_the_plane(rng):
    p, n, v = rng.normal(size=(3, N, 3))
    d = np.cross(n, v)
    ambients = (line_through(p, d, 0.3), plane_through(p, n, -7.0))
    for factor in (
        LineOnPlane(line=ALL[0], plane=ALL[1]),
        LineOnPlane(line=ALL[0], plane=ALL[1], anchor=rng.normal(size=(N, 3))),
        SegmentOnPlane(line=ALL[0], plane=ALL[1], ends=rng.normal(size=(N, 2, 3))),
    ):
        np.testing.assert_allclose(residuals_of(factor, ambients), 0.0, atol=1e-13)


@pytest.mark.parametrize("seed", range(3))
def test_ends_in_cameras_move_with_the_world(seed):
    example = SegmentOnPlane.in_cameras(np.random.default_rng(seed))
    for block in compare_jacobians(example):
        assert block.passed, block
    slots, ambients = [slot for slot, _ in example.factor.references()], ambients_of(example)
    motion = WorldMotion(
        "turned and shifted", True, so3.exp(np.array([[0.9, -1.3, 1.1]]))[0], np.array([0.3, -0.4, 0.5])
    )
    before, after = (residuals_of(example.factor, now) for now in (ambients, moved_world(slots, ambients, motion)))
    np.testing.assert_allclose(after, before, rtol=1e-9, atol=1e-12)


def test_line_on_plane_measures_at_the_anchor(rng):
    p, d, n, x, off = rng.normal(size=(5, N, 3))
    ends = np.stack([p - 1.5 * d, p + 0.5 * d], axis=1) + np.cross(d, off)[:, None]  # beside the line
    ambients = (line_through(p, d, 1.7), plane_through(x, n, 0.4))

    def height(point):
        return np.sum((point - x) * unit(n), axis=1)

    r = residuals_of(SegmentOnPlane(line=ALL[0], plane=ALL[1], ends=ends), ambients)
    np.testing.assert_allclose(r, np.stack([height(p - 1.5 * d), height(p + 0.5 * d)], axis=1), rtol=1e-10)
    r = residuals_of(LineOnPlane(line=ALL[0], plane=ALL[1], anchor=ends[:, 0]), ambients)
    np.testing.assert_allclose(r[:, 0], np.sum(unit(d) * unit(n), axis=1), rtol=1e-12)
    np.testing.assert_allclose(r[:, 1], height(p - 1.5 * d), rtol=1e-10)
    foot = np.cross(d, np.cross(p, d)) / np.sum(d * d, axis=1, keepdims=True)
    r = residuals_of(LineOnPlane(line=ALL[0], plane=ALL[1]), ambients)
    np.testing.assert_allclose(r[:, 1], height(foot), rtol=1e-10)


def test_anchor_near_the_segment_survives_a_far_world_origin(rng):
    """A line that leaves its plane by 1e-3 rad, 1000 units from the origin: the foot point is off by a whole unit."""
    p = np.array([[1000.0, 0.0, 0.0]]) + rng.normal(size=(N, 3)) * [1.0, 0.0, 1.0]
    d = np.tile([1.0, 1e-3, 0.0], (N, 1))
    ambients = (line_through(p, d), plane_through(p, np.tile([0.0, 1.0, 0.0], (N, 1))))
    assert np.abs(residuals_of(LineOnPlane(line=ALL[0], plane=ALL[1]), ambients)[:, 1]).min() > 0.9
    near = LineOnPlane(line=ALL[0], plane=ALL[1], anchor=p)
    np.testing.assert_allclose(residuals_of(near, ambients)[:, 1], 0.0, atol=1e-10)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_parallel_and_orthogonal(rng, sign):
    p, q, d, v = rng.normal(size=(4, N, 3))
    across = np.cross(d, v)
    first, second = ALL
    line, other, skew = line_through(p, d), line_through(q, sign * 2 * d), line_through(q, sign * across)
    plane, plane_across = plane_through(p, sign * 3 * d), plane_through(q, across)
    zero = [
        (ParallelLines, line, other),
        (ParallelPlanes, plane, plane_through(q, d)),
        (LinePerpendicularToPlane, line, plane),
        (OrthogonalLines, line, skew),
        (OrthogonalPlanes, plane, plane_across),
        (LineParallelToPlane, line, plane_across),
    ]
    for cls, a, b in zero:
        np.testing.assert_allclose(
            residuals_of(cls(first=first, second=second), (a, b)), 0.0, atol=1e-14, err_msg=str(cls)
        )
    r = residuals_of(LineDirection(line=first, direction=second), (line, sign * unit(d)))
    np.testing.assert_allclose(r, 0.0, atol=1e-14)
    one = residuals_of(ParallelLines(first=first, second=second), (line, skew))
    np.testing.assert_allclose(np.linalg.norm(one, axis=1), 1.0, rtol=1e-13)
    np.testing.assert_allclose(np.abs(residuals_of(OrthogonalLines(first=first, second=second), (line, other))), 1.0)


@pytest.mark.parametrize("cls", STRUCTURAL, ids=lambda cls: cls.type_name)
@pytest.mark.parametrize("scale", [37.0, 1e-3])
def test_scale_of_lines_and_planes_does_not_matter(cls, scale, rng):
    example = cls.example(rng)
    sizes = [example.variables[ref.group][0].factor_columns for _, ref in example.factor.references()]
    before, _ = linearized(example.factor, ambients_of(example), sizes)
    kinds = [slot.kind for slot, _ in example.factor.references()]
    scales = [scale if kind in ("line", "plane") else 1.0 for kind in kinds]
    scaled = tuple(a * s for a, s in zip(ambients_of(example), scales, strict=True))
    after, _ = linearized(example.factor, scaled, sizes)
    columns = np.concatenate([np.full(size, s) for size, s in zip(sizes, scales, strict=True)] + [[1.0]])
    np.testing.assert_allclose(after * columns, before, rtol=1e-9, atol=1e-12)


def test_objects_at_infinity_are_counted_and_zero(rng):
    p, d = rng.normal(size=(2, N, 3))
    lines = line_through(p, d)
    lines[2:4, 3:] = 0.0
    record, degenerate = linearized(PointOnLine(point=ALL[0], line=ALL[1]), (p, lines), [3, 6])
    assert degenerate == 2
    assert not record[2:4].any() and record[[0, 1, 4, 5, 6, 7], :, :9].any(axis=(1, 2)).all()


def test_wrong_shapes_are_refused():
    with pytest.raises(ShapeError, match=r"LineOnPlane.anchor must have shape \(8, 3\).* got \(3, 8\)"):
        LineOnPlane(line=ALL[0], plane=ALL[1], anchor=np.zeros((3, N)))
    with pytest.raises(ShapeError, match=r"SegmentOnPlane\.ends"):
        SegmentOnPlane(line=ALL[0], plane=ALL[1], ends=np.zeros((N, 3)))


def test_registered_under_their_geometric_names():
    assert {"point_on_line", "line_on_plane", "parallel_lines", "line_direction"} <= set(registered())

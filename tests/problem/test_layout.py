"""The layout of a problem: every factor once, landmarks in order, chunks, shared blocks, what is eliminated."""

import dataclasses
from dataclasses import dataclass

import numpy as np
import pytest

from groma.factors import PointReprojection
from groma.factors.contract import Ref
from groma.geometry.charts.pose_charts import PoseLeft
from groma.geometry.manifold import Euclidean
from groma.problem.lay_out import lay_out
from groma.problem.problem import Problem
from groma.problem.sorting import PairTable, argsort_by, distinct_pairs, first_and_last
from groma.problem.variables import Variables

pytestmark = pytest.mark.kernels


def problem_with(camera, point, num_cameras, num_points, intrinsics_of=None, free_intrinsics=False):
    count = len(camera)
    poses = np.tile([0.0, 0, 0, 1, 0, 0, 5], (num_cameras, 1))
    num_sets = 1 if intrinsics_of is None else int(np.max(intrinsics_of)) + 1
    variables = {
        "poses": Variables(PoseLeft(), poses),
        "points": Variables(Euclidean(3, "point"), np.zeros((num_points, 3))),
        "intrinsics": Variables(Euclidean(3, "intrinsics"), np.tile([500.0, 0, 0], (num_sets, 1)), not free_intrinsics),
    }
    factor = PointReprojection(
        pose=Ref("poses", camera),
        point=Ref("points", point),
        intrinsics=Ref("intrinsics", np.zeros(count, int) if intrinsics_of is None else intrinsics_of),
        camera_model="SIMPLE_PINHOLE",
        pixels=np.arange(2.0 * count).reshape(count, 2),
    )
    return Problem(variables, [factor])


def random_graph(seed=0, num_cameras=6, num_points=40, count=150):
    rng = np.random.default_rng(seed)
    pairs = rng.choice(num_cameras * num_points, count, replace=False)
    return pairs // num_points, pairs % num_points, num_cameras, num_points


def test_every_factor_is_in_one_chunk_and_keeps_its_measurement():
    camera, point, num_cameras, num_points = random_graph()
    layout = lay_out(problem_with(camera, point, num_cameras, num_points), chunk_size=7)
    (factor,) = layout.factors
    (eliminated,) = layout.eliminated
    covered = np.concatenate([np.arange(b, e) for chunk in layout.chunks for _, b, e in chunk.factors])
    np.testing.assert_array_equal(covered, np.arange(len(camera)))
    original = (factor.factor.pixels[:, 0] / 2).astype(int)
    np.testing.assert_array_equal(np.sort(original), np.arange(len(camera)))
    np.testing.assert_array_equal(eliminated.order[factor.landmark], point[original])
    np.testing.assert_array_equal(factor.kept[0].block, camera[original])
    assert (np.diff(factor.landmark) >= 0).all()


def test_landmarks_are_sorted_by_first_and_last_camera():
    camera, point, num_cameras, num_points = random_graph(1)
    layout = lay_out(problem_with(camera, point, num_cameras, num_points))
    keys = []
    for landmark in layout.eliminated[0].order:
        seen = camera[point == landmark]
        keys.append((seen.min(), seen.max()) if len(seen) else (num_cameras - 1, 0))
    assert keys == sorted(keys)


def test_blocks_are_the_pairs_of_cameras_that_share_a_point():
    camera, point, num_cameras, num_points = random_graph(2, count=60)
    layout = lay_out(problem_with(camera, point, num_cameras, num_points))
    rows, columns = layout.blocks[0, 0]
    expected = {(c, c) for c in range(num_cameras)}
    for p in range(num_points):
        seen = np.unique(camera[point == p])
        expected |= {(a, b) for a in seen for b in seen if a <= b}
    assert set(zip(rows.tolist(), columns.tolist(), strict=True)) == expected
    np.testing.assert_array_equal(rows[:num_cameras], np.arange(num_cameras))


def test_repeated_observations_share_an_incidence():
    layout = lay_out(problem_with(np.array([0, 0, 1]), np.array([0, 0, 0]), 2, 1))
    incidences = layout.eliminated[0].incidences[0]
    np.testing.assert_array_equal(incidences.block, [0, 1])
    np.testing.assert_array_equal(layout.factors[0].kept[0].incidence, [0, 0, 1])


@pytest.mark.parametrize(
    ("intrinsics_of_camera", "widths"),
    [
        ([0, 1, 2, 3, 4, 5], [9]),  # one each: merged
        ([5, 3, 4, 0, 1, 2], [9]),  # one each, in another order
        ([0, 0, 1, 1, 2, 2], [6, 3]),  # shared: a class of their own
    ],
)
def test_private_intrinsics_are_merged_with_their_pose(intrinsics_of_camera, widths):
    camera, point, num_cameras, num_points = random_graph(3)
    intrinsics_of = np.array(intrinsics_of_camera)[camera]
    layout = lay_out(problem_with(camera, point, num_cameras, num_points, intrinsics_of, free_intrinsics=True))
    assert [kept.width for kept in layout.kept] == widths
    if widths == [9]:
        member = layout.kept[0].members[1]
        np.testing.assert_array_equal(member.blocks(intrinsics_of), camera)
        blocks = layout.kept[0].blocks_of(np.arange(layout.num_kept_unknowns))
        np.testing.assert_array_equal(layout.unknowns["poses"], blocks[:, :6])
        np.testing.assert_array_equal(layout.unknowns[member.group], blocks[member.block_of, 6:])
    places = np.concatenate([part.ravel() for part in layout.unknowns.values()])
    np.testing.assert_array_equal(np.sort(places), np.arange(layout.num_kept_unknowns))


def test_uncoupled_variables_are_problems_of_their_own():
    camera, point, num_cameras, num_points = random_graph(4)
    problem = problem_with(camera, point, num_cameras, num_points)
    variables = dict(problem.variables)
    variables["points"] = Variables(Euclidean(3, "point"), np.zeros((num_points, 3)), True)
    layout = lay_out(Problem(variables, problem.factors))
    assert not layout.kept
    assert [e.group for e in layout.eliminated] == ["poses"]


def test_sorting_helpers():
    rng = np.random.default_rng(5)
    first, second = rng.integers(0, 4, 50).astype(np.int32), rng.integers(0, 6, 50).astype(np.int32)
    np.testing.assert_array_equal(argsort_by(((first, 4), (second, 6)), 50), np.lexsort((second, first)))
    low, high = first_and_last(first, second, 5, 6)
    for group in range(4):
        assert (low[group], high[group]) == (second[first == group].min(), second[first == group].max())
    assert (low[4], high[4]) == (5, 0)
    order = np.lexsort((second, first))
    slot, pointer, value = distinct_pairs(first[order], second[order], 4)
    pairs = sorted(set(zip(first.tolist(), second.tolist(), strict=True)))
    assert len(value) == len(pairs) == pointer[-1]
    np.testing.assert_array_equal(value[slot], second[order])


def test_pair_table_numbers_pairs_once():
    table = PairTable(3, 3)
    np.testing.assert_array_equal(table.add_list(np.array([0, 1, 0]), np.array([1, 2, 1])), [0, 1, 0])
    rows, columns = table.pairs()
    assert rows.tolist() == [0, 1]
    assert columns.tolist() == [1, 2]


def test_pair_table_grows():
    rng = np.random.default_rng(7)
    rows, columns = rng.integers(0, 300, 3000).astype(np.int32), rng.integers(0, 400, 3000).astype(np.int32)
    table = PairTable(2, 400)  # far too small at first
    slots = table.add_list(rows, columns)
    known = {}
    for pair in zip(rows.tolist(), columns.tolist(), strict=True):
        known.setdefault(pair, len(known))
    assert slots.tolist() == [known[pair] for pair in zip(rows.tolist(), columns.tolist(), strict=True)]
    np.testing.assert_array_equal(np.stack(table.pairs(), axis=1), list(known))
    pointer = np.array([0, 3, 3, 5])
    column = np.array([1, 4, 399, 0, 7], np.int32)
    slots, pair_pointer = table.add_pairs(pointer, column)
    found = np.stack(table.pairs(), axis=1)[slots].tolist()
    assert found == [[1, 1], [1, 4], [1, 399], [4, 4], [4, 399], [399, 399], [0, 0], [0, 7], [7, 7]]
    np.testing.assert_array_equal(pair_pointer, [0, 6, 6, 9])


@dataclass(frozen=True, kw_only=True)
class _Weighted(PointReprojection):
    """A factor that derives something from its rows when it is made."""

    def __post_init__(self):
        super().__post_init__()
        object.__setattr__(self, "total", self.pixels.sum(axis=1))


def test_sorted_factors_keep_what_belongs_to_their_rows():
    camera, point, num_cameras, num_points = random_graph(6)
    problem = problem_with(camera, point, num_cameras, num_points)
    rng = np.random.default_rng(6)
    (plain,) = problem.factors
    values = {field.name: getattr(plain, field.name) for field in dataclasses.fields(plain)}
    values["sqrt_information"] = rng.uniform(1.0, 2.0, len(camera))
    for factor in (PointReprojection(**values), _Weighted(**values)):
        (layout,) = lay_out(Problem(problem.variables, [factor])).factors
        original = (layout.factor.pixels[:, 0] / 2).astype(int)
        np.testing.assert_array_equal(layout.factor.sqrt_information, values["sqrt_information"][original])
        np.testing.assert_array_equal(layout.factor.pose.index, camera[original])
        if isinstance(factor, _Weighted):
            np.testing.assert_array_equal(layout.factor.total, layout.factor.pixels.sum(axis=1))

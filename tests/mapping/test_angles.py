# SPDX-License-Identifier: BSD-3-Clause
"""Parallel and perpendicular planes and directions: right angles are found, nearly right ones are left alone."""

from functools import cache

import numpy as np
import pytest

import groma
from groma.adjustment.terms.relations import ANGLES
from groma.estimators.directions import DirectionSet
from groma.estimators.plane_search import PlaneSet
from groma.gates import chi_square_gate
from groma.geometry import quaternion, se3
from groma.io import read_archive, write_archive
from groma.mapping.structure.angles import AngleGates, _consistent, angles_between, right_angles, vertical_of
from groma.mapping.structure.find import find_structure
from groma.mapping.structure.relations import Pairs
from groma.mapping.unused import without_unused
from groma.scene import Directions, KnownDirections, Planes, Relations
from groma.scene.survey import Kind
from groma.scene.synthetic.scenes import corridor

SIGMA = 8e-4
X, Y, Z = np.eye(3)
GATES = AngleGates()


def found(vectors, seed=0, sigma=SIGMA):
    """Angles among unit vectors that are seen with noise, with either sign, in a world that is turned."""
    sigma = np.broadcast_to(sigma, len(vectors))[:, None]
    rng = np.random.default_rng(seed)
    turn = quaternion.to_matrix(se3.exp(rng.normal(size=(1, 6)))[:, :4])[0]
    noisy = np.asarray(vectors) @ turn.T + rng.normal(0.0, sigma, (len(vectors), 3))
    noisy *= rng.choice([-1.0, 1.0], (len(vectors), 1)) / np.linalg.norm(noisy, axis=1, keepdims=True)
    kind = np.zeros(len(noisy), bool)
    return right_angles(noisy, sigma[:, None] ** 2 * (np.eye(3) - noisy[:, :, None] * noisy[:, None, :]), kind, 0.99)


def pairs(angles):
    """Pairs at right angles and parallel ones."""
    return (
        {tuple(pair) for pair in angles.pairs[angles.right].tolist()},
        {tuple(pair) for pair in angles.pairs[~angles.right].tolist()},
    )


def true_pairs(kinds):
    """The same of vectors along axes with these numbers."""
    every = [(a, b) for b in range(len(kinds)) for a in range(b)]
    return {p for p in every if kinds[p[0]] != kinds[p[1]]}, {p for p in every if kinds[p[0]] == kinds[p[1]]}


def aside(vectors, angle, rng):
    """Unit vectors turned by angles about axes across them."""
    across = np.cross(vectors, rng.normal(size=vectors.shape))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return np.cos(angle)[:, None] * vectors + np.sin(angle)[:, None] * across


@pytest.mark.parametrize("seed", range(5))
def test_a_room_has_all_its_right_angles(seed):
    kinds = [0, 0, 1, 1, 2, 2, 0, 1]
    angles = found(np.array([X, Y, Z])[kinds], seed)
    right, parallel = pairs(angles)
    true_right, true_parallel = true_pairs(kinds)
    assert len(right) >= len(true_right) - 1 and right <= true_right
    assert len(parallel) >= len(true_parallel) - 1 and parallel <= true_parallel
    assert (angles.pairs[:, 0] < angles.pairs[:, 1]).all() and (angles.probability > 0.9).all()
    # Seven pairs of a vector count as one deviation of it, which is at most about what vectors are uncertain by.
    assert (GATES.held < angles.sigma / np.sqrt(7 / 2)).all() and angles.sigma.max() / np.sqrt(7 / 2) < 3.0 * SIGMA
    assert angles.sigma[angles.right] == pytest.approx(np.full(len(right), angles.sigma[angles.right].mean()), rel=0.1)


@pytest.mark.parametrize("turned", [0.0, 3.0])
def test_what_no_pair_tells_all_of_them_may(turned):
    """Two boxes of eight faces each, turned by so many deviations of a face."""
    num, sigma, whole, apart = 8, 2e-3, 0, 0
    own = [(a, b) for k in (0, num) for b in range(k, k + num) for a in range(k, b)]
    pairs = np.array([*own, *((a, b) for a in range(num) for b in range(num, 2 * num))])
    for seed in range(20):
        vectors = np.repeat([X, np.cos(turned * sigma) * X + np.sin(turned * sigma) * Y], num, axis=0)
        vectors[:, 1:] += np.random.default_rng(seed).normal(0.0, sigma, (2 * num, 2))
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
        covariance = sigma**2 * (np.eye(3) - vectors[:, :, None] * vectors[:, None])
        agree = _consistent(vectors, covariance, pairs, np.zeros(len(pairs), bool), GATES)
        off = vectors[pairs[len(own) :, 0]] - vectors[pairs[len(own) :, 1]]
        alone = (off**2).sum(axis=1) < chi_square_gate(0.01, 2) * 2.0 * sigma**2
        assert alone.mean() > (0.5 if turned else 0.9)
        whole, apart = whole + agree.all(), apart + (agree[: len(own)].all() and not agree[len(own) :].any())
    # One draw of 20 may lose a right pair, and the means of the boxes are 6 deviations apart, for a gate of 3.9.
    assert (apart if turned else whole) >= 17


@pytest.mark.parametrize("degrees", [1.0, 3.0])
@pytest.mark.parametrize("seed", range(3))
def test_an_angle_that_is_a_little_off_is_not_right(degrees, seed):
    """A wing that stands askew: what belongs to the rest keeps its angles, and the wing its own."""
    angle = np.deg2rad(degrees)
    askew = np.cos(angle) * X + np.sin(angle) * Y
    right, parallel = pairs(found(np.array([X, X, Y, Y, Z, Z, askew, askew]), seed))
    true_right, true_parallel = true_pairs([0, 0, 1, 1, 2, 2])
    assert right <= true_right | {(4, 6), (4, 7), (5, 6), (5, 7)} and len(right) >= 14
    assert parallel <= true_parallel | {(6, 7)} and len(parallel) >= 3


@pytest.mark.parametrize("seed", range(3))
def test_half_a_degree_is_not_forced(seed):
    """What is related in spite of it has as much slack."""
    angle = np.deg2rad(0.5)
    askew = np.cos(angle) * X + np.sin(angle) * Y
    angles = found(np.array([X, X, Y, Y, Z, Z, askew, askew]), seed)
    wing = (angles.pairs >= 6).any(axis=1) & (angles.pairs < 4).any(axis=1)
    assert (angles.sigma[wing] > 0.5 * angle).all()


def test_a_house_that_is_nowhere_square_is_left_as_it_is():
    """Angles of one to three degrees off: among 20 houses hardly one pair is right by chance."""
    count = 0
    for seed in range(20):
        rng = np.random.default_rng(100 + seed)
        off = np.deg2rad(rng.uniform(1.0, 3.0, 8))
        count += len(found(aside(np.array([X, X, Y, Y, Z, Z, X, Y]), off, rng), seed).pairs)
    assert count <= 0.03 * 20 * 28


def test_directions_by_chance_have_no_right_angles():
    count = 0
    for seed in range(20):
        vectors = np.random.default_rng(200 + seed).normal(size=(12, 3))
        count += len(found(vectors / np.linalg.norm(vectors, axis=1, keepdims=True), seed).pairs)
    assert count <= 0.005 * 20 * 66


def test_how_right_angles_are_is_estimated():
    """Walls that deviate by a fifth of a degree are held by as much, not by what the most exact ones are."""
    rng, kinds = np.random.default_rng(5), [0, 0, 0, 1, 1, 1, 2, 2, 2, 0, 1, 2]
    off = np.abs(rng.normal(0.0, np.deg2rad(0.2), len(kinds)))
    angles = found(aside(np.array([X, Y, Z])[kinds], off, rng), 5, 1e-4)
    exact = found(np.array([X, Y, Z])[kinds], 5, 1e-4)
    assert len(angles.pairs) > 0.85 * 66 and len(exact.pairs) == 66
    assert np.deg2rad(0.15) < angles.sigma.mean() / np.sqrt(11 / 2) < np.deg2rad(0.4)
    assert exact.sigma.max() / np.sqrt(11 / 2) < 3e-4


def test_walls_that_deviate_by_almost_half_a_degree_keep_their_relations():
    """Whether one of ten walls stands a little more askew does not decide about the 45 pairs of them."""
    number, walls = [], np.array([X, Y])[[0] * 5 + [1] * 5]
    for seed in range(20):
        rng = np.random.default_rng(300 + seed)
        off = np.abs(rng.normal(0.0, np.deg2rad(0.4), len(walls)))
        number.append(len(found(aside(walls, off, rng), seed, 1e-4).pairs))
    assert min(number) > 0.9 * 45


def test_uncertain_vectors_and_few_say_nothing():
    assert len(found(np.array([X, X, Y, Y, Z, Z]), sigma=0.02).pairs) == 0
    assert len(found(np.zeros((0, 3))).pairs) == 0 and len(found(X[None]).pairs) == 0


@pytest.mark.parametrize(("sigma", "related"), [(0.02, True), (GATES.layer / 2.0, False)])
def test_an_uncertain_vector_among_certain_ones_is_as_they_are(sigma, related):
    """All others are at right angles or parallel, so it probably is: where noise hardly takes it out of the layer."""
    kinds = [0, 0, 1, 1, 2, 2, 2]
    number = [
        (found(np.array([X, Y, Z])[kinds], seed, [SIGMA] * 6 + [sigma]).pairs == 6).any(axis=1).sum()
        for seed in range(20)
    ]
    # Each draw has six such pairs; the chi-square test drops one of a hundred, and with it pairs that depend on it.
    assert (np.mean(number) > 0.9 * 6) if related else max(number) == 0


def test_an_uncertain_vector_among_those_that_are_a_little_off_stays_alone():
    number = 0
    for seed in range(20):
        rng = np.random.default_rng(400 + seed)
        off = np.append(np.deg2rad(rng.uniform(1.0, 3.0, 8)), 0.0)
        number += len(found(aside(np.array([X, X, Y, Y, Z, Z, X, Y, Z]), off, rng), seed, [SIGMA] * 8 + [0.02]).pairs)
    assert number <= 0.03 * 20 * 36


# ------------------------------------------------------------------------------------------------------------- Scenes
@cache
def walls():
    """A corridor measured with noise."""
    truth = corridor("small", seed=0).truth
    plain = truth.replace(planes=Planes(), relations=Relations(), directions=Directions())
    return groma.adjust(plain, groma.AdjustOptions(refine_poses=False, loss="none", max_iterations=15)).scene


@cache
def walls_related():
    """The same corridor with the structure that is found in it."""
    return find_structure(walls())


def gravity(scene, sigma):
    """The scene with the vertical of the world measured in its cameras."""
    poses, count = scene.cam_from_world, scene.num_images
    seen = quaternion.rotate(poses[:, :4], np.tile(Z, (count, 1)))
    table = KnownDirections(
        np.full(count, Kind.IMAGE), np.arange(count), np.tile(Z, (count, 1)), seen, np.full(count, sigma)
    )
    return scene.replace(known_directions=table)


def off(scene):
    """By relation: how far the angles of planes and directions are from right, radians."""
    normals, vectors = scene.planes.hesse[:, :3], scene.directions.vectors
    sides = {"planes": (normals, normals), "directions": (vectors, vectors), "plane": (normals, vectors)}
    result = {}
    for kind in ANGLES:
        first, second = sides["plane" if kind.startswith("plane_") else kind.split("_")[1]]
        one, other = getattr(scene.relations, kind).T
        cosine = np.einsum("ni,ni->n", first[one], second[other])
        is_right = kind.startswith("perpendicular") or kind == "plane_along_direction"
        result[kind] = np.abs(cosine) if is_right else np.linalg.norm(np.cross(first[one], second[other]), axis=1)
    return result


def test_a_corridor_is_square():
    related = walls_related()
    kinds = related.relations
    normals = np.abs(related.planes.hesse[:, :3]).argmax(axis=1)
    right, parallel = true_pairs(normals)
    assert {tuple(pair) for pair in kinds.perpendicular_planes.tolist()} <= right
    assert {tuple(pair) for pair in kinds.parallel_planes.tolist()} <= parallel
    assert len(kinds.perpendicular_planes) > 0.9 * len(right) and len(kinds.parallel_planes) > 0.9 * len(parallel)
    assert kinds.perpendicular_directions.tolist() == [[0, 1], [0, 2], [1, 2]]
    assert len(kinds.plane_across_direction) > 0.9 * related.num_planes
    assert len(kinds.plane_along_direction) > 0.9 * 2 * related.num_planes
    assert all((kinds.sigma(kind) >= GATES.held).all() for kind in ANGLES)


@pytest.mark.parametrize("form", ["metric", "pixels"])
def test_an_adjustment_holds_them_and_planes_come_nearer_to_the_truth(form):
    related = walls_related()
    options = groma.AdjustOptions(loss="none", structure_form=form)
    bare = related.replace(relations=related.relations.take(**{kind: [] for kind in ANGLES}))
    with_angles, without = (groma.adjust(one, options) for one in (related, bare))
    for kind, outcome in with_angles.report.relations.items():
        if kind in ANGLES:
            assert outcome == {"held": len(getattr(related.relations, kind)), "dropped": 0}
    tilt = [np.abs(np.sort(np.abs(one.scene.planes.hesse[:, :3]), axis=1)[:, :2]) for one in (with_angles, without)]
    assert np.sqrt((tilt[0] ** 2).mean()) < 0.8 * np.sqrt((tilt[1] ** 2).mean())
    before = off(without.scene.replace(relations=related.relations))
    for kind, angle in off(with_angles.scene).items():
        assert len(angle) == 0 or np.sqrt((angle**2).mean()) < 0.7 * np.sqrt((before[kind] ** 2).mean()), kind


def test_the_vertical_is_a_direction():
    """Gravity, measured in the cameras: floor and walls are related to it, and it keeps its place."""
    scene = walls()
    level = gravity(scene, 0.002)
    vector, covariance = vertical_of(level)
    assert vector.tolist() == [0.0, 0.0, 1.0]
    assert np.diag(covariance) == pytest.approx([0.002**2 / scene.num_images] * 2 + [0.0])
    related = find_structure(level)
    number = related.num_directions - 1
    assert related.directions.vectors[number].tolist() == [0.0, 0.0, 1.0]
    assert (related.held.kind.tolist(), related.held.idx.tolist()) == ([Kind.DIRECTION], [number])
    upright = np.abs(related.planes.hesse[:, :3]).argmax(axis=1) != 2
    along, across = related.relations.plane_along_direction, related.relations.plane_across_direction
    assert set(along[along[:, 1] == number, 0]) == set(np.flatnonzero(upright))
    assert set(across[across[:, 1] == number, 0]) == set(np.flatnonzero(~upright))
    adjusted = groma.adjust(related, groma.AdjustOptions(loss="none")).scene
    assert adjusted.directions.vectors[number] == pytest.approx(Z, abs=1e-12)
    assert without_unused(adjusted)[0].num_directions == related.num_directions  # no line is along it
    again = find_structure(related)
    assert len(again.held) == 1 and again.num_directions == related.num_directions
    # Where cameras disagree about what is known, it is not the vertical.
    table = level.known_directions
    mixed = level.replace(known_directions=table.replace(vector=np.where(np.arange(len(table))[:, None] % 2, X, Z)))
    assert vertical_of(mixed) is None and vertical_of(scene) is None


def test_files_and_selections_keep_them(tmp_path):
    related = walls_related()
    write_archive(related, tmp_path / "scene.npz")
    read = read_archive(tmp_path / "scene.npz").relations
    for kind in ANGLES:
        assert (getattr(read, kind) == getattr(related.relations, kind)).all()
        assert (read.sigma(kind) == related.relations.sigma(kind)).all()
    fewer = related.keep(directions=[1, 2], planes=np.arange(1, related.num_planes)).relations
    assert fewer.perpendicular_directions.tolist() == [[0, 1]]
    kept = related.relations.plane_across_direction
    kept = kept[(kept > 0).all(axis=1)] - 1
    assert (fewer.plane_across_direction == kept).all()


def treads(turned, both):
    """Two planes across Z, the second known badly about Y and turned so much, with lines along Y, and X if both are."""
    normals = np.array([Z, np.cos(turned) * Z + np.sin(turned) * X])
    sigma = np.array([[SIGMA, SIGMA], [0.02, SIGMA]])
    noise = np.zeros((2, 4, 4))
    noise[:, 0, 0], noise[:, 1, 1] = sigma.T**2
    none, planes = np.zeros(2), np.column_stack([normals, np.zeros(2)])
    plane_set = PlaneSet(planes, noise, none.astype(int), none, none, none, none.astype(int), none.astype(int))
    across = SIGMA**2 * np.array([np.eye(3) - np.outer(one, one) for one in (X, Y)])
    directions = DirectionSet(np.array([X, Y]), across, none.astype(int), none, none.astype(int))
    on = Pairs(np.array([[0, 1], [1, 1]]), np.ones(2), none)
    along = Pairs(np.array([[0, 1], [1, 0]])[: 1 + both], np.ones(1 + both), none[: 1 + both])
    return angles_between(plane_set, directions, (on, along), None, 0.99)


@pytest.mark.parametrize(("turned", "both", "sure"), [(0.06, True, True), (0.06, False, False), (0.1, True, False)])
def test_lines_along_two_directions_tell_a_normal(turned, both, sure):
    """A narrow plane is surely parallel to another one if two directions in it say so, and do not contradict it."""
    found = treads(turned, both)
    assert (found["parallel_planes"].probability.max(initial=0.0) > 0.99) == sure
    assert ([1, 0] in found["plane_along_direction"].pairs.tolist()) == sure

# SPDX-License-Identifier: BSD-3-Clause
"""Covers the probability that a line is right: what it is computed from, how it orders lines, where it is kept."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import expit, logit, stdtr, stdtrit

from groma.adjustment.adjust import AdjustOptions, adjust
from groma.io.archive import read_archive, write_archive
from groma.mapping.lines.confidence import (
    GATES,
    WEIGHTS,
    edge_probability,
    line_accuracy,
    line_confidence,
    line_evidence,
    usual_distance,
    with_confidence,
)
from groma.mapping.noise.landmarks import line_noise
from groma.mapping.options import MapOptions
from groma.scene import (
    Cameras,
    LineObservations,
    Lines,
    Planes,
    PointObservations,
    Points,
    Relations,
    Scene,
    Similarity,
)

FOCAL = 500.0


def scene_of(ends, centers, noise=0.3, seed=0, size=1000):
    """Cameras that look along z at lines, which all of them observe with some noise."""
    rng, ends, centers = np.random.default_rng(seed), np.asarray(ends, float), np.asarray(centers, float)
    image, line = (index.ravel() for index in np.meshgrid(np.arange(len(centers)), np.arange(len(ends)), indexing="ij"))
    local = ends[line] - centers[image, None]
    pixels = FOCAL * local[..., :2] / local[..., 2:] + size / 2
    poses = np.column_stack([np.tile([0.0, 0, 0, 1], (len(centers), 1)), -centers])
    return Scene.from_images(
        Cameras(ids=[1], models=("PINHOLE",), params=[[FOCAL, FOCAL, size / 2, size / 2]], width=[size], height=[size]),
        [f"{k}.png" for k in range(len(centers))],
        np.zeros(len(centers), int),
        poses,
        lines=Lines.through(ends),
        line_observations=LineObservations(
            image, line, (pixels + rng.normal(0, noise, pixels.shape)).reshape(len(line), 4)
        ),
    )


def within(limit):
    """Probability of an error within so many standard deviations, whose tails are heavy."""
    return 2.0 * stdtr(4.0, limit) - 1.0


def columns(scene):
    return dict(zip([*WEIGHTS, "contrast", "length"], line_evidence(scene).T, strict=True))


def rows_of(together, contrast, length=0.0):
    """Evidence of lines: log likelihood ratios that their segments belong together, log contrasts and lengths."""
    rows = np.zeros((len(contrast), len(WEIGHTS) + 2))
    rows[:, 0], rows[:, -2], rows[:, -1] = np.asarray(together) / WEIGHTS["constant"], contrast, length
    return rows


def texture_told(contrast, together=50.0, length=0.0):
    return edge_probability(rows_of(together, contrast, length), np.array(list(WEIGHTS.values())))


@pytest.fixture
def scene():
    rng = np.random.default_rng(3)
    middle = np.column_stack([rng.uniform(-2, 2, (40, 2)), rng.uniform(8, 12, 40)])
    along = rng.normal(size=(40, 3)) * [1, 1, 0.3]
    centers = np.column_stack([np.linspace(-2, 2, 6), rng.uniform(-1, 1, 6), np.zeros(6)])
    return scene_of(np.stack([middle - 0.5 * along, middle + 0.5 * along], axis=1), centers)


def test_evidence_by_hand():
    # Upright lines at depth 10, seen from 1 left and right: viewing planes 2 arctan(0.1) apart.
    ends = [[[0.0, -1, 10], [0, 1, 10]], [[0, -9, 10], [0, 12, 10]]]
    found = columns(scene_of(ends, [[-1.0, 0, 0], [1, 0, 0]], noise=0.0))
    np.testing.assert_allclose(np.exp(found["spread"]), np.sin(np.arctan(0.1)), rtol=1e-9)
    # Nothing is known of their contrast: it is the usual one.
    np.testing.assert_allclose(np.exp(found["contrast"]), GATES.usual_contrast, rtol=1e-9)
    np.testing.assert_allclose(np.exp(found["length"]), np.array([100.0, 1050.0]) / 575.0, rtol=1e-9)
    # Both are seen by all images; the second leaves the frame, so that no image is expected to show it.
    np.testing.assert_allclose(np.exp(found["support"]), [5.0, 5.0])
    fewer = scene_of(ends, [[-1.0, 0, 0], [1, 0, 0], [0, 0, 1]], noise=0.0)
    rows = fewer.line_observations.image_idx < 2
    support = columns(fewer.keep(line_observations=rows))["support"]
    np.testing.assert_allclose(np.exp(support), [2.5 / 1.5, 5.0])


def with_points(scene, xyz, image_idx, point_idx):
    pixel = np.zeros((len(image_idx), 2))
    return scene.replace(
        points=Points.at(np.asarray(xyz, float)),
        point_observations=PointObservations.numbered(image_idx, point_idx, pixel),
    )


def test_images_of_what_is_beside_a_line_must_show_it():
    # Two lines, one of which three images of six do not show; a point beside either.
    whole = scene_of([[[-1.0, -1, 10], [-1, 1, 10]], [[1.0, -1, 10], [1, 1, 10]]], np.eye(3)[np.zeros(6, int)], 0.0)
    seen, xyz = whole.line_observations, [[-1.1, 0, 10], [1.1, 0, 10]]
    scene = whole.keep(line_observations=(seen.line_idx == 1) | (seen.image_idx < 3))

    def beside(scene):
        return np.exp(columns(scene)["beside"])

    image, point = (index.ravel() for index in np.meshgrid(np.arange(6), [0, 1], indexing="ij"))
    every = [3.5 / 3.5, 6.5 / 0.5]
    np.testing.assert_allclose(beside(with_points(scene, xyz, image, point)), every)
    # What hides the line hides the point.
    rows = (point == 1) | (image < 3)
    np.testing.assert_allclose(beside(with_points(scene, xyz, image[rows], point[rows])), [3.5 / 0.5, 6.5 / 0.5])
    # Six of nine images of lines show the points beside them: one that does, but not the line, stands for 1.5.
    rows = np.isin(6 * point + image, [0, 3, 6, 7, 8, 9, 10])
    found = beside(with_points(scene, xyz, image[rows], point[rows]))
    np.testing.assert_allclose(found, [3.5 / (1.5 + 0.5), 6.5 / 0.5])
    # Without points, and with points that no image shows, every image counts in whose frame it lies.
    np.testing.assert_allclose(beside(scene), np.exp(columns(scene)["support"]))
    np.testing.assert_allclose(beside(with_points(scene, xyz, [], [])), every)


def test_outlines_of_cylinders_drift_and_edges_do_not():
    # Upright edges seen from 90 degrees around; of the last ten, the outlines of cylinders around them are seen.
    rng, radius = np.random.default_rng(5), np.repeat([0.0, 0.2], [60, 10])
    angle = np.radians(np.linspace(-45.0, 45.0, 9))
    x, z = rng.uniform(-1, 1, (2, 70))
    up = np.stack([np.column_stack([x, y * np.ones(70), z]) for y in (-1.0, 1.0)], axis=1)
    right, away = np.cos(angle)[:, None] * x + np.sin(angle)[:, None] * z, 10.0 - np.sin(angle)[:, None] * x
    away = away + np.cos(angle)[:, None] * z
    distance = np.hypot(right, away)
    column = 500.0 + FOCAL * np.tan(np.arctan2(right, away) + np.arcsin(radius / distance))
    rows = 500.0 + FOCAL * np.array([-1.0, 1.0])[:, None, None] / away
    pixels = np.stack([column, rows[0], column, rows[1]], axis=-1).reshape(-1, 4)
    image, line = (index.ravel() for index in np.meshgrid(np.arange(9), np.arange(70), indexing="ij"))
    half, poses = 0.5 * angle, np.zeros((9, 7))
    poses[:, 1], poses[:, 3], poses[:, 6] = np.sin(half), np.cos(half), 10.0
    scene = scene_of(up, np.zeros((9, 3))).with_poses(poses)
    seen = LineObservations(image, line, pixels + rng.normal(0, 0.5, pixels.shape))
    deviations = np.expm1(columns(scene.replace(line_observations=seen))["drift"])
    assert np.sqrt(np.mean(deviations[:60] ** 2)) == pytest.approx(1.0, abs=0.25)  # three deviations of 60 draws
    # The radius, 10 px, over what it is known to: it is what mean and cosine of the angles do not tell alike.
    cosine = np.cos(angle)
    sigma = 0.5 / np.sqrt(2.0 * (9.0 - cosine.sum() ** 2 / (cosine**2).sum()))
    np.testing.assert_allclose(deviations[60:].mean(), 10.0 / sigma, rtol=0.25)


def test_lines_that_do_not_stand_out_are_texture(scene):
    seen, stripes = scene.line_observations, np.arange(10)
    told = np.where(np.isin(seen.line_idx, stripes), 1.5, 200.0)
    before = line_confidence(scene.replace(line_observations=seen.replace(contrast=np.full(len(seen), 200.0))))
    after = line_confidence(scene.replace(line_observations=seen.replace(contrast=told)))
    assert (after[stripes] < 0.6 * before[stripes]).all()
    np.testing.assert_allclose(after[10:], before[10:], atol=0.01)  # they are surely none
    # Where it is known of some segments only, these tell; the mean is that of logarithms.
    some = np.where(seen.image_idx < 4, 0.0, np.where(seen.image_idx == 4, 2.0, 8.0))
    part = scene.replace(line_observations=seen.replace(contrast=some))
    whole = scene.replace(line_observations=seen.replace(contrast=np.full(len(seen), 4.0)))
    np.testing.assert_allclose(line_evidence(part), line_evidence(whole), rtol=1e-12)


def test_the_lines_of_a_scene_tell_the_share_that_has_an_edge():
    weights = np.array(list(WEIGHTS.values()))

    def probability(*likelihood):  # logarithms of ratios; no line is texture
        return edge_probability(rows_of(likelihood, np.full(len(likelihood), 50.0)), weights)

    for doubtful in ([0.5], [0.5] * 300, [0.5, *[9.0] * 100], [0.5, *[-9.0] * 100]):
        found = probability(*doubtful)
        share = (0.5 * GATES.prior_lines + found.sum()) / (GATES.prior_lines + len(found))
        np.testing.assert_allclose(found, expit(np.array(doubtful) + logit(share)), rtol=1e-9)
    alone, clean, few = (probability(0.5, *others)[0] for others in ((), [9.0] * 100, [-9.0] * 100))
    assert few < alone - 0.3 and alone == pytest.approx(expit(0.5), abs=0.01) and clean > alone + 0.2
    assert probability(*np.zeros(1000)) == pytest.approx(0.5)  # what says nothing moves nothing
    assert len(probability()) == 0
    assert np.isfinite(probability(*[800.0] * 5, *[-800.0] * 5)).all()


def test_the_lines_of_a_scene_tell_the_share_that_is_texture():
    (stripe, _), (edge, _), doubtful = GATES.stripe_contrast, GATES.edge_contrast, 2.0
    alone = texture_told([doubtful])[0]
    plain, striped = (texture_told([doubtful, *np.repeat([edge, stripe], n)])[0] for n in ([100, 5], [5, 100]))
    assert striped < alone - 0.1 and plain > alone + 0.1
    # Lines whose segments do not belong together tell nothing of texture.
    unrelated = texture_told([doubtful, *[stripe] * 100], [50.0, *[-50.0] * 100])[0]
    assert unrelated == pytest.approx(alone, abs=1e-9)


def test_the_lines_of_a_scene_tell_how_far_its_edges_stand_out():
    rng, (stripe, sigma) = np.random.default_rng(0), GATES.stripe_contrast
    draws, length = rng.normal(size=300), 0.75 * rng.normal(size=300)
    # Edges between rough stones stand out little. Lines like them are stripes where edges stand out on plain walls.
    stripes = stripe + sigma * draws
    assert np.median(texture_told(1.6 + 0.7 * draws, length=length)) > 0.7
    assert texture_told([1.6, *(3.8 + 0.7 * draws), *stripes])[0] < 0.5
    assert (texture_told(stripes, length=0.8 * length - 0.16) > 0.5).mean() < 0.1  # where all is texture


def test_long_lines_among_stripes_are_edges_though_others_lie_close_beside_them():
    (stripe, _), others = GATES.stripe_contrast, np.repeat([GATES.edge_contrast[0], GATES.stripe_contrast[0]], 100)
    length = np.zeros(201)
    doubtful = [stripe + 0.7, *others]
    usual, short, long = (texture_told(doubtful, length=np.r_[x, length[1:]])[0] for x in (0.0, -0.5, 1.8))
    assert long > 0.6 > 0.3 > usual > short


def test_a_little_less_contrast_does_not_turn_all_edges_to_texture():
    draws, length = np.random.default_rng(1).normal(size=(2, 500)) * [[0.7], [0.75]]
    expected = [texture_told(mean + draws, length=length).mean() for mean in np.arange(2.0, 0.7, -0.05)]
    assert expected[0] > 0.8 and expected[-1] < 0.3 and np.abs(np.diff(expected)).max() < 0.1


def test_less_contrast_never_makes_an_edge_likelier():
    for usual in (1.2, 2.5, 4.0):
        found = texture_told([*np.linspace(-6.0, 8.0, 141), *[usual] * 400])
        assert (np.diff(found[:141]) >= 0.0).all()
    found = texture_told(np.full(201, 1.6), length=np.linspace(-3.0, 4.0, 201))
    assert (np.diff(found) >= 0.0).all()


def test_residuals_are_told_in_pixels_whatever_the_standard_deviations_say(scene):
    rms = np.exp(columns(scene)["residual"])
    # Lines at their true places: twelve residuals count as eight degrees of freedom.
    assert np.sqrt(np.mean(rms**2)) == pytest.approx(0.3 * np.sqrt(12 / 8), rel=0.15)
    seen = scene.line_observations
    doubted = scene.replace(line_observations=seen.replace(sigma=seen.sigma * np.where(seen.line_idx < 20, 4.0, 1.0)))
    np.testing.assert_allclose(np.exp(columns(doubted)["residual"]), rms, rtol=0.02)


def test_evidence_has_no_unit_and_no_frame(scene):
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    moved = scene.transformed(Similarity(7.0, turn, np.array([3.0, -2, 5])))
    np.testing.assert_allclose(line_evidence(moved), line_evidence(scene), atol=2e-3)  # a weak prior has a unit


def test_accuracy_is_the_share_of_repetitions_of_which_half_is_within_the_tolerance():
    ends, centers = [[[0.0, -1, 10], [0, 1, 10]]], np.column_stack([np.linspace(-2, 2, 7), np.zeros((7, 2))])
    gates, x, stated, near = replace(GATES, edge_px=1e9, freedom=1e9), centers[:, 0], [], []  # normal noise
    for seed in range(150):  # upright lines: each end alone is x = f (X - c) / Z, solved for (X / Z, 1 / Z)
        scene = scene_of(ends, centers, noise=0.8, seed=seed)
        stated.append(line_accuracy(scene, gates=gates)[0])
        u = scene.line_observations.segment[:, [0, 2]] - 500.0
        depth = 1.0 / np.linalg.lstsq(np.column_stack([np.ones(7), -x]), u / FOCAL, rcond=None)[0][1]
        along = np.interp(np.linspace(0.0, 1.0, 99), [0.0, 1.0], depth)
        near.append(np.median(np.abs(along - 10.0)) < gates.tolerance * 10.0)
    assert 0.2 < np.mean(near) < 0.8
    assert np.mean(stated) == pytest.approx(np.mean(near), abs=0.12)  # three deviations of 150 draws


def test_half_of_a_line_decides_though_one_end_is_uncertain():
    # Observed from -1 to 1; the farther from there, the less is known, so that half of -1 .. 7 is known as at 3.
    centers = np.column_stack([np.linspace(-2, 2, 6), np.zeros((6, 2))])
    gates, scene = replace(GATES, edge_px=1e9), scene_of([[[0.0, -1, 10], [0, 1, 10]]], centers)
    longer = scene.replace(lines=Lines.through([[[0.0, -1, 10], [0, 7, 10]]]))
    noise, middle = line_noise(longer), np.array([0.5])
    deviation = np.sqrt(np.linalg.eigvalsh(noise.at(middle, middle, np.array([0])))[0, 1]) * max(noise.misfit[0], 1.0)
    expected = within(gates.tolerance * usual_distance(longer) / deviation)
    assert line_accuracy(longer, gates=gates)[0] == pytest.approx(expected)
    assert expected < 0.8 * line_accuracy(scene, gates=gates)[0]


def test_planes_of_a_line_tell_where_it_is():
    # Seen from a short base its depth is uncertain; the planes x = 0 and z = 10 meet in it.
    centers = np.column_stack([np.linspace(-0.1, 0.1, 5), np.zeros((5, 2))])
    gates, scene = replace(GATES, edge_px=1e9), scene_of([[[0.0, -1, 10], [0, 1, 10]]], centers)

    def accuracy(*hesse, **sigma):
        number = np.arange(len(hesse))
        on = Relations(line_on_plane=np.column_stack([np.zeros_like(number), number]), **sigma)
        planes = Planes(number, np.array(hesse, float).reshape(-1, 4))
        return line_accuracy(scene.replace(planes=planes, relations=on), gates=gates, surface_px=0.5)[0]

    alone, side, depth = accuracy(), [1, 0, 0, 0], [0, 0, 1, -10]
    nearly = [0.001, 0, np.sqrt(1 - 1e-6), -10]
    tolerance, flat = gates.tolerance * usual_distance(scene), 0.5 * usual_distance(scene) / FOCAL
    assert alone < 0.3
    # A plane that all images see edge-on tells no depth; one across their view does, alone or with another of its kind.
    assert accuracy(side) == pytest.approx(alone, rel=1e-3)
    rough = within(tolerance / 0.02)
    assert accuracy(depth, line_on_plane_sigma=[0.02]) == pytest.approx(rough, rel=0.02)
    twice = within(np.sqrt(2.0) * tolerance / 0.02)
    assert accuracy(depth, nearly, line_on_plane_sigma=[0.02, 0.02]) == pytest.approx(twice, rel=0.02)
    assert accuracy(side, depth) == pytest.approx(within(tolerance / flat), rel=0.02)
    # Segments and a plane that know as much as each other: half of the variance.
    equal = tolerance / stdtrit(GATES.freedom, 0.5 * (1.0 + alone))
    both = within(np.sqrt(2.0) * tolerance / equal)
    assert accuracy(depth, line_on_plane_sigma=[equal]) == pytest.approx(both, rel=0.02)


def test_contours_of_a_pillar_are_no_edges():
    # A pillar about the axis x = 0, z = 10 of radius 1; its left contour is where the sight touches it.
    centers = np.column_stack([np.linspace(-3.5, 3.5, 8), np.zeros((8, 2))])
    toward = np.array([0.0, 0, 10]) - centers
    away = np.linalg.norm(toward, axis=1)
    turn = np.arcsin(1.0 / away)
    u = FOCAL * np.tan(np.arctan2(toward[:, 0], toward[:, 2]) - turn)
    edge = scene_of([[[-1.0, -1.5, 10], [-1.0, 1.5, 10]]], centers, noise=0.1)
    seen = edge.line_observations
    measured = seen.segment.copy()
    noise = measured[:, [0, 2]] - (FOCAL * (-1.0 - centers[seen.image_idx, 0]) / 10.0 + 500.0)[:, None]
    measured[:, [0, 2]] = u[seen.image_idx, None] + 500.0 + noise
    contour = edge.replace(line_observations=seen.replace(segment=measured))
    both = [line_confidence(adjust(one, AdjustOptions(refine_poses=False)).scene)[0] for one in (edge, contour)]
    assert both[0] > 0.95 and both[1] < 0.5


def test_good_lines_are_more_probable_than_lines_of_unrelated_segments(scene):
    seen, wrong = scene.line_observations, np.arange(10)
    rng = np.random.default_rng(5)
    shift = np.where(np.isin(seen.line_idx, wrong)[:, None], rng.normal(0, 6.0, (len(seen), 4)), 0.0)
    spoiled = scene.replace(line_observations=seen.replace(segment=seen.segment + shift))
    before, after = line_confidence(scene), line_confidence(spoiled)
    assert (after[wrong] < 0.5 * before[wrong]).all()
    ranks = np.argsort(np.argsort(after))
    assert ranks[wrong].mean() < 7.0 and np.median(after[10:]) > 5.0 * np.median(after[wrong])
    fewer = line_confidence(scene.keep(line_observations=seen.image_idx < 3))
    assert (fewer < before).mean() > 0.9
    signs = {name: np.sign(WEIGHTS[name]) for name in ("spread", "support", "beside", "residual")}
    assert signs == {"spread": 1, "support": 1, "beside": 1, "residual": -1}


def test_kept_in_archives(scene, tmp_path):
    known = with_confidence(scene)
    assert ((known.lines.confidence > 0) & (known.lines.confidence < 1)).all()
    write_archive(known, tmp_path / "known.npz")
    np.testing.assert_array_equal(read_archive(tmp_path / "known.npz").lines.confidence, known.lines.confidence)
    write_archive(scene, tmp_path / "old.npz")
    with np.load(tmp_path / "old.npz") as saved:
        assert "lines.confidence" not in saved.files
    assert (read_archive(tmp_path / "old.npz").lines.confidence == -1).all()
    assert len(line_confidence(Scene())) == 0


def test_the_command_has_the_default_of_the_library():
    import typer.main

    from groma.cli.app import app

    command = typer.main.get_command(app).commands["map"]
    default = next(option.default for option in command.params if option.name == "min_confidence")
    assert default == MapOptions().min_confidence

# SPDX-License-Identifier: BSD-3-Clause
"""Trajectory errors: known errors of made trajectories, invariances, association by time, options, the program evo."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from groma.cli.app import app
from groma.errors import InputError
from groma.evaluation.alignment import align_points, pose_alignment
from groma.evaluation.trajectory import apply_similarity, associate, score_trajectory
from groma.geometry import quaternion, se3
from groma.io import Trajectory, read_trajectory, write_trajectory
from groma.scene import Similarity


def wander(count=60, seed=0):
    """Poses a metre apart that turn a little."""
    rng = np.random.default_rng(seed)
    steps = se3.exp(
        np.hstack([[1.0, 0, 0] + 0.2 * rng.standard_normal((count, 3)), 0.1 * rng.standard_normal((count, 3))])
    )
    poses = [np.array([0.0, 0, 0, 1, 0, 0, 0])]
    for step in steps[1:]:
        poses.append(se3.compose(poses[-1][None], step[None])[0])
    return Trajectory(np.arange(count) * 0.1, np.array(poses))


SOME = Similarity(1.7, quaternion.to_matrix(quaternion.exp(np.array([0.4, -1.0, 2.0]))), np.array([3.0, -4.0, 5.0]))


def test_equal_up_to_what_alignment_allows():
    truth = wander()
    moved = truth.replace(world_from_cam=apply_similarity(SOME, truth.world_from_cam))
    scores = score_trajectory(moved, truth, "sim3")
    assert scores.similarity.scale == pytest.approx(1 / 1.7, rel=1e-12)
    assert max(scores.ate.max, scores.rotation_deg.max, scores.rpe_translation.max) < 1e-10
    assert scores.drift_percent < 1e-9
    rigid = truth.replace(
        world_from_cam=apply_similarity(Similarity(1.0, SOME.rotation, SOME.translation), truth.world_from_cam)
    )
    assert score_trajectory(rigid, truth, "se3").ate.max < 1e-10
    assert score_trajectory(rigid, truth, "none").ate.rmse > 1.0
    assert score_trajectory(rigid, truth, "none").rpe_translation.max < 1e-12  # steps do not depend on the world
    assert score_trajectory(moved, truth, "se3").ate.rmse > 1.0


def test_errors_that_are_known():
    truth = wander(11)
    poses = truth.world_from_cam.copy()
    poses[3, 4:] += [0.3, 0.0, 0.4]
    scores = score_trajectory(truth.replace(world_from_cam=poses), truth, "none")
    assert scores.ate.max == pytest.approx(0.5)
    assert scores.ate.rmse == pytest.approx(0.5 / np.sqrt(11))
    assert (scores.ate.mean, scores.ate.median) == (pytest.approx(0.5 / 11), 0.0)
    # Two of ten steps see the displacement.
    assert scores.rpe_translation.rmse == pytest.approx(0.5 * np.sqrt(2 / 10))
    assert scores.num_pairs == 10
    # A turn of the camera about itself by 2 degrees at one pose.
    turn = quaternion.exp(np.radians([[0.0, 2.0, 0.0]]))
    poses = truth.world_from_cam.copy()
    poses[3, :4] = quaternion.multiply(poses[3:4, :4], turn)[0]
    scores = score_trajectory(truth.replace(world_from_cam=poses), truth, "none")
    assert scores.rotation_deg.max == pytest.approx(2.0)
    assert scores.rpe_rotation_deg.rmse == pytest.approx(2.0 * np.sqrt(2 / 10))
    assert scores.ate.max == 0.0


def test_drift_of_a_wrong_scale():
    truth = wander(400)
    longer = truth.replace(world_from_cam=np.hstack([truth.world_from_cam[:, :4], 1.02 * truth.world_from_cam[:, 4:]]))
    scores = score_trajectory(longer, truth, "none")
    assert scores.segment_lengths == (100.0, 200.0, 300.0, 400.0)[: len(scores.segment_lengths)]
    assert 0.5 < scores.drift_percent < 2.1  # of segments that are not straight
    assert scores.drift_deg_per_metre == pytest.approx(0.0, abs=1e-9)
    straight = Trajectory(
        np.arange(21.0), np.hstack([np.tile([0, 0, 0, 1.0], (21, 1)), np.arange(21.0)[:, None] * [[0, 0, 1]]])
    )
    longer = straight.replace(world_from_cam=straight.world_from_cam * [1, 1, 1, 1, 1, 1, 1.02])
    scores = score_trajectory(longer, straight, "none")
    # Segments end at the first pose beyond their length, up to a step later: 1, 2, ... in place of 1, 2, ...
    assert scores.drift_percent == pytest.approx(2.0, rel=0.35)
    assert scores.segment_lengths[0] == pytest.approx(2.0)


def test_a_camera_that_only_turns_has_no_drift():
    rng = np.random.default_rng(0)
    turns = quaternion.exp(np.outer(0.03 * np.arange(60), [0.0, 1.0, 0.0]))
    truth = Trajectory(np.arange(60) / 30, np.hstack([turns, rng.normal(0, 0.0005, (60, 3))]))
    noise = np.hstack([np.zeros((60, 4)), rng.normal(0, 0.002, (60, 3))])
    scores = score_trajectory(truth.replace(world_from_cam=truth.world_from_cam + noise), truth)
    assert (scores.drift_percent, scores.drift_deg_per_metre, scores.segment_lengths) == (None, None, ())
    less = score_trajectory(truth.replace(world_from_cam=truth.world_from_cam + 0.05 * noise), truth)
    assert less.drift_percent > 0.0


def test_steps_in_metres_and_seconds():
    straight = Trajectory(
        np.arange(21) * 0.1, np.hstack([np.tile([0, 0, 0, 1.0], (21, 1)), np.arange(21.0)[:, None] * [[0, 0, 1]]])
    )
    for delta, unit, pairs in (
        (1, "frames", 20),
        (6, "frames", 3),
        (2.5, "metres", 6),
        (0.3, "seconds", 6),
        (9, "seconds", 0),
    ):
        assert score_trajectory(straight, straight, "none", rpe_delta=delta, rpe_unit=unit).num_pairs == pairs
    assert score_trajectory(straight, straight, "none", rpe_delta=9, rpe_unit="seconds").rpe_translation is None


def test_association():
    i, j = associate([0.0, 1.0, 2.0, 3.0], [0.004, 0.5, 1.02, 2.9951, 7.0], 0.01)
    assert (i.tolist(), j.tolist()) == ([0, 3], [0, 3])
    j, i = associate([0.004, 0.5, 1.02, 2.9951, 7.0], [0.0, 1.0, 2.0, 3.0], 0.01)
    assert (i.tolist(), j.tolist()) == ([0, 3], [0, 3])
    assert [len(rows) for rows in associate([], [1.0])] == [0, 0]
    for wrong in (np.nan, -0.1):
        with pytest.raises(InputError, match="max_time_difference must be a number of seconds"):
            associate([0.0], [1.0], wrong)
    i, j = associate([1.0], [1.005], 0.01)
    assert (i.tolist(), j.tolist()) == ([0], [0])


def test_order_in_the_file_does_not_matter():
    truth, rng = wander(), np.random.default_rng(1)
    estimate = truth.replace(
        world_from_cam=se3.compose(truth.world_from_cam, se3.exp(0.05 * rng.standard_normal((60, 6))))
    )
    a = score_trajectory(estimate, truth).to_dict()
    b = score_trajectory(estimate.take(rng.permutation(60)), truth.take(rng.permutation(60))).to_dict()
    assert a == b


def test_few_poses():
    truth = wander(2)
    assert score_trajectory(truth, truth).ate.max < 1e-12
    one = score_trajectory(truth.take([0]), truth)
    assert (one.num_poses, one.num_pairs, one.rpe_translation, one.drift_percent) == (1, 0, None, None)
    json.dumps(one.to_dict(), allow_nan=False)


def test_what_is_refused():
    truth = wander(5)
    with pytest.raises(InputError, match=r"within 0\.01 s"):
        score_trajectory(truth.replace(timestamps=truth.timestamps + 100), truth)
    with pytest.raises(InputError, match="without poses"):
        score_trajectory(Trajectory(), truth)
    for options in ({"align": "so3"}, {"rpe_unit": "m"}, {"rpe_delta": 0}, {"rpe_delta": 1.5}):
        with pytest.raises(InputError, match="must be"):
            score_trajectory(truth, truth, **options)


def test_command(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    truth = wander()
    write_trajectory(truth, "truth.txt")
    write_trajectory(
        truth.replace(world_from_cam=apply_similarity(SOME, truth.world_from_cam)), "estimate.csv", "euroc"
    )
    command = ["evaluate", "trajectory", "estimate.csv", "truth.txt", "--align"]
    result = CliRunner().invoke(app, [*command, "sim3", "--json", "scores.json"])
    assert result.exit_code == 0, result.output
    scores = json.loads((tmp_path / "scores.json").read_text())
    assert scores["scale"] == pytest.approx(1 / 1.7)
    assert scores["ate_rmse"] < 1e-9
    assert {"rpe_translation_rmse", "rpe_rotation_deg_rmse", "num_poses", "drift_percent"} <= set(scores)
    result = CliRunner().invoke(app, [*command, "x"])
    assert result.exit_code == 2  # wrong usage, as with every option that has a choice of words
    assert "'se3', 'sim3', 'none'" in result.output


# What evo 1.38.1 prints for the files in shared/data/trajectories, unpacked, e.g.
#   evo_ape tum fr2_desk_groundtruth.txt fr2_desk_ORB.txt -as --save_results r.zip   (and unzip -p r.zip stats.json)
#   evo_rpe kitti KITTI_00_gt.txt KITTI_00_SPTAM.txt -r angle_deg -d 100 -u m -as --save_results r.zip
# (-a is align="se3", -as "sim3", neither "none"; for evo_rpe "none" or -as).
EVO_APE = [
    ("fr2_desk_ORB", "none", 3.17399354190223, 2.9496938875994747, 2.594642464975095, 5.066735062280106),
    ("fr2_desk_ORB", "se3", 0.008118977562044926, 0.0074917768702161495, 0.007414629829316952, 0.024299593694385276),
    ("fr2_desk_ORB", "sim3", 0.006123163030157264, 0.00558619731870614, 0.005305225075852613, 0.021476785562788304),
    ("KITTI_00_ORB", "none", 7.790288882656827, 7.01175040166684, 6.801631674560281, 13.45850880738189),
    ("KITTI_00_ORB", "se3", 1.3034497145650337, 1.1569971285389835, 1.0656247695557912, 3.587949120678975),
    ("KITTI_00_ORB", "sim3", 0.9377090736114023, 0.8726926319693107, 0.8446910134864141, 2.693499863613383),
    ("KITTI_00_SPTAM", "none", 9.224541737237876, 8.62370355518929, 8.28232140962514, 14.911823227678537),
    ("KITTI_00_SPTAM", "se3", 3.738487907582604, 3.4909766330848577, 3.6425846417432424, 7.768977406571304),
    ("KITTI_00_SPTAM", "sim3", 3.6352935643386006, 3.3573057786205687, 3.4798637552962988, 7.291831027981607),
]
EVO_RPE = [  # rmse of the translation, then of the rotation in degrees
    ("fr2_desk_ORB", "none", 1, "frames", 0.003490321374787292, 0.2805192262673266),
    ("fr2_desk_ORB", "sim3", 1, "frames", 0.003485016890888191, 0.28051922626732656),
    ("fr2_desk_ORB", "none", 10, "frames", 0.0062346494856550085, 0.42064470802404735),
    ("fr2_desk_ORB", "sim3", 10, "frames", 0.006247830509538613, 0.4206447080240474),
    ("fr2_desk_ORB", "none", 0.5, "metres", 0.009616655960823964, 0.5574720721534386),
    ("fr2_desk_ORB", "sim3", 0.5, "metres", 0.009446121683277726, 0.607134710706088),
    ("KITTI_00_ORB", "none", 1, "frames", 0.02812037701739386, 0.11497352125979224),
    ("KITTI_00_ORB", "sim3", 1, "frames", 0.0278224533435625, 0.11497352125979235),
    ("KITTI_00_SPTAM", "none", 100, "metres", 2.6114856788807708, 2.1825478572482453),
    ("KITTI_00_SPTAM", "sim3", 100, "metres", 2.9129178917245806, 2.4449107629871447),
]


def test_without_times_lines_belong_together():
    """KITTI has no times: the numbers of its lines must not be taken for seconds."""
    truth = wander(40)
    numbered = truth.replace(timestamps=np.arange(40.0))
    for ours, theirs in ((truth, numbered), (numbered, truth), (numbered, numbered)):
        scores = score_trajectory(ours, theirs, "none")
        assert scores.num_poses == 40 and scores.association == "line" and scores.warnings == ()
        assert scores.ate.max < 1e-12
    assert score_trajectory(truth, truth).association == "time"
    # 36 of 40 poses: nobody knows which lines they are
    few = score_trajectory(truth.take(np.arange(36)), numbered)
    assert few.num_poses == 4 and few.association == "time"
    assert "Only 4 of 36 and 40" in few.warnings[0] and "REF has no times" in few.warnings[0]
    assert few.to_dict()["warnings"] == list(few.warnings)
    shifted = truth.replace(timestamps=truth.timestamps + 3.0)
    assert "units of time" in score_trajectory(truth, shifted).warnings[0]
    assert score_trajectory(truth.take(np.arange(0, 40, 3)), truth).warnings == ()  # the shorter one counts


def test_an_error_of_scale_is_told():
    """And only where it is one: not of positions that err otherwise, and not where the scale was aligned."""
    truth = wander(60, seed=2)
    small = truth.replace(world_from_cam=truth.world_from_cam * ([1] * 4 + [0.2] * 3))
    (said,) = score_trajectory(small, truth, "se3").warnings
    assert "times 5 the position error would be" in said and "sim3" in said
    assert not score_trajectory(small, truth, "sim3").warnings
    noise = np.random.default_rng(0).normal(size=(60, 7)) * ([0] * 4 + [0.1] * 3)
    assert not score_trajectory(truth.replace(world_from_cam=truth.world_from_cam + noise), truth, "se3").warnings
    assert not score_trajectory(truth, truth, "se3").warnings


def test_unrelated_trajectories_are_noticed():
    """Others have other orientations, even where a path is like another; noise and a wrong scale are no other."""
    truth = wander(60, seed=1)
    assert any("unrelated" in text for text in score_trajectory(wander(60, seed=3), truth, "se3").warnings)
    rng = np.random.default_rng(0)
    turned = truth.world_from_cam.copy()
    turned[:, :4] = quaternion.normalize(rng.normal(size=(60, 4)))
    turned[:, 4:] = rng.normal(size=(60, 3))
    assert "unrelated" in score_trajectory(truth.replace(world_from_cam=turned), truth, "sim3").warnings[0]
    noisy = truth.world_from_cam.copy()
    noisy[:, 4:] += rng.normal(0, 2.0, (60, 3))
    assert score_trajectory(truth.replace(world_from_cam=noisy), truth).warnings == ()
    small = truth.replace(world_from_cam=apply_similarity(Similarity(0.1), truth.world_from_cam))
    assert not any("unrelated" in text for text in score_trajectory(small, truth, "se3").warnings)


def test_the_command_warns_and_finds_times_beside_the_reference(tmp_path):
    truth = wander(40)
    write_trajectory(truth.take(np.arange(36)), tmp_path / "est.txt")
    write_trajectory(truth, tmp_path / "poses.txt", "kitti")
    words = ["evaluate", "trajectory", str(tmp_path / "est.txt"), str(tmp_path / "poses.txt")]
    alone = CliRunner().invoke(app, words)
    assert alone.exit_code == 0 and "Only 4 of 36" in alone.stderr and "--times" in alone.stderr
    for name, more in (("clock.txt", ["--times", str(tmp_path / "clock.txt")]), ("times.txt", [])):
        (tmp_path / name).write_text("".join(f"{time!r}\n" for time in truth.timestamps.tolist()))
        found = CliRunner().invoke(app, words + more)
        assert found.exit_code == 0 and "36 poses associated by time of 36 and 40" in found.stdout
        assert "warning" not in found.stderr


@pytest.fixture(scope="module")
def published(shared_data):
    folder = shared_data / "trajectories"
    return {path.name.split(".")[0]: read_trajectory(path) for path in folder.glob("*.txt.gz")}


def reference_of(name):
    return "fr2_desk_groundtruth" if name.startswith("fr2") else "KITTI_00_gt"


@pytest.mark.shared
@pytest.mark.parametrize(("name", "align", "rmse", "mean", "median", "largest"), EVO_APE)
def test_absolute_errors_are_those_of_evo(published, name, align, rmse, mean, median, largest):
    ate = score_trajectory(published[name], published[reference_of(name)], align).ate
    np.testing.assert_allclose(
        [ate.rmse, ate.mean, ate.median, ate.max], [rmse, mean, median, largest], atol=1e-10, rtol=0
    )


@pytest.mark.shared
@pytest.mark.parametrize(("name", "align", "delta", "unit", "translation", "rotation"), EVO_RPE)
def test_relative_errors_are_those_of_evo(published, name, align, delta, unit, translation, rotation):
    scores = score_trajectory(published[name], published[reference_of(name)], align, rpe_delta=delta, rpe_unit=unit)
    # evo takes the matrices of KITTI files as they are, with rotations of six digits; groma the nearest rotations.
    np.testing.assert_allclose(
        [scores.rpe_translation.rmse, scores.rpe_rotation_deg.rmse], [translation, rotation], rtol=0, atol=1e-6
    )


def _turning(spread, noise, turn_noise, seed=3):
    """A camera that turns on the spot, within a spread of positions, and an estimate of it in another world."""
    rng, count = np.random.default_rng(seed), 80
    angle = np.linspace(0.0, 1.5, count)
    turns = quaternion.exp(np.stack([0.2 * np.sin(3 * angle), angle, 0.1 * np.cos(2 * angle)], axis=1))
    truth = Trajectory(np.arange(count) * 0.1, np.hstack([turns, spread * rng.standard_normal((count, 3))]))
    noisy = truth.world_from_cam.copy()
    noisy[:, 4:] += noise * rng.standard_normal((count, 3))
    noisy[:, :4] = quaternion.multiply(quaternion.exp(turn_noise * rng.standard_normal((count, 3))), noisy[:, :4])
    there = Similarity(1.0, SOME.rotation, SOME.translation)
    return truth.replace(world_from_cam=apply_similarity(there, noisy)), truth, there


def test_a_camera_that_turns_on_the_spot_is_aligned_by_its_orientations_too():
    estimate, truth, there = _turning(spread=0.002, noise=0.01, turn_noise=np.radians(0.3))
    scores = score_trajectory(estimate, truth, "se3")
    assert scores.by_orientations and scores.to_dict()["by_orientations"]
    # The mean of 80 orientations with 0.3 degrees of noise about each axis is good to 0.06 degrees.
    away = quaternion.log(quaternion.from_matrix((scores.similarity.rotation @ there.rotation)[None]))
    assert np.degrees(np.linalg.norm(away)) < 0.1
    assert scores.rotation_deg.rmse < 0.3 * np.sqrt(3) * 1.2
    # Positions are not worse for it than their noise.
    assert scores.ate.rmse < 0.01 * np.sqrt(3) * 1.2


def test_positions_that_determine_the_rotation_align_alone():
    estimate, truth, _ = _turning(spread=1.0, noise=0.01, turn_noise=np.radians(3.0))
    scores = score_trajectory(estimate, truth, "se3")
    assert not scores.by_orientations
    alone = align_points(estimate.world_from_cam[:, 4:], truth.world_from_cam[:, 4:], with_scale=False)
    np.testing.assert_allclose(scores.similarity.rotation, alone.rotation, atol=1e-12)


def test_alignment_by_both_is_at_the_minimum_of_what_it_minimises():
    estimate, truth, _ = _turning(spread=0.004, noise=0.01, turn_noise=np.radians(2.0))
    poses, others = se3.inverse(estimate.world_from_cam), se3.inverse(truth.world_from_cam)
    found = pose_alignment(poses, others, with_scale=False)
    assert found.by_orientations
    x, y = estimate.world_from_cam[:, 4:], truth.world_from_cam[:, 4:]
    alone = align_points(x, y, with_scale=False)
    votes = quaternion.to_matrix(truth.world_from_cam[:, :4]) @ quaternion.to_matrix(
        estimate.world_from_cam[:, :4]
    ).transpose(0, 2, 1)
    u, _, vt = np.linalg.svd(votes.sum(0))
    noise2 = np.sum((y - alone.points(x)) ** 2) / (3 * len(x) - 6)
    scatter2 = np.sum((votes - u @ vt) ** 2) / 2 / (3 * len(x) - 3)

    def cost(rotation):
        away = y - y.mean(0) - (x - x.mean(0)) @ rotation.T
        return np.sum(away**2) / noise2 + np.mean(np.sum((votes - rotation) ** 2, axis=(1, 2))) / (2 * scatter2)

    best = cost(found.similarity.rotation)
    for axis in np.vstack([np.eye(3), -np.eye(3)]):
        turn = quaternion.to_matrix(quaternion.exp(1e-3 * axis))
        assert cost(turn @ found.similarity.rotation) > best

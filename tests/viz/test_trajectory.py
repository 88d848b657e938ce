# SPDX-License-Identifier: BSD-3-Clause
"""The page of a track: paths from above and from the side, errors, counts and times; what is missing is left out."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
from _scene import exact_scene

from groma.evaluation.trajectory import score_trajectory
from groma.geometry import quaternion, se3
from groma.io.trajectories import Trajectory
from groma.scene import Scene
from groma.viz.report import trajectory as page
from groma.viz.report.path_charts import MAX_PLACES, Curve, over_time, path
from groma.viz.report.trajectory import write_track_report

TIMES = np.arange(30) / 10.0
#: A level drive along (1, 0, 1) with a swerve; y is down.
CENTERS = np.stack([TIMES, 0.001 * TIMES, TIMES + 0.2 * np.sin(2 * TIMES)], axis=1)


def _trajectory(centers=CENTERS, times=TIMES) -> Trajectory:
    turn = quaternion.exp(np.array([0.0, 0.3, 0.0])[None] * np.ones((len(centers), 1)))
    return Trajectory(times, np.hstack([turn, centers]))


def _track(**changes) -> SimpleNamespace:
    stages = {
        "points": {"median": 1.5, "p95": 2.0, "frames": 30},
        "total": {"median": 4.0, "p95": 1234.5, "frames": 30},
    }
    values = {
        "trajectory": _trajectory(),
        "scene": exact_scene(),
        "keyframes": TIMES[::10],
        "statistics": {"frames": {"tracked": 30, "lost": 2}, "loops": 1, "metric": True, "milliseconds": stages},
        "warnings": ("Mind the <gap>.",),
    }
    return SimpleNamespace(**values | changes)


def _frames() -> list[SimpleNamespace]:
    return [
        SimpleNamespace(
            timestamp=float(t),
            status="lost" if 5 <= k < 7 else "tracked",
            counts={} if 5 <= k < 7 else {"points": 100 + k, "lines": 20},
            timings={"total": 0.004, "points": 0.002},
        )
        for k, t in enumerate(TIMES)
    ]


def _write(tmp_path, *args, **kwargs) -> str:
    write_track_report(tmp_path / "page.html", *args, **kwargs)
    return (tmp_path / "page.html").read_text(encoding="utf-8")


def test_everything_is_there(tmp_path):
    world = se3.exp(np.array([1.0, 2.0, 3.0, 0.2, -0.5, 0.1]))
    reference = _trajectory()
    reference = Trajectory(TIMES, se3.compose(np.tile(world, (30, 1)), reference.world_from_cam))
    rng = np.random.default_rng(0)
    track = _track(trajectory=_trajectory(CENTERS + 0.01 * rng.normal(size=CENTERS.shape)))
    scores = score_trajectory(track.trajectory, reference)
    text = _write(tmp_path, track, _frames(), scores, title="A <drive>")
    for words in (
        "A &lt;drive&gt;", "Mind the &lt;gap&gt;.", "Path from above", "Path from the side", "Error over time",
        "Followed", "Time per frame", "Stages", "Against the reference", "reference</span>", "lost</span>",
        "30 <i>of</i> 32",
        f"{scores.ate.rmse:.3g}", "on a path of", "1,234</td>", "rotation and translation", "frames with a pose",
    ):  # fmt: skip
        assert words in text, words
    assert "planes</span>" not in text  # none were followed
    assert "nan" not in re.sub(r"<script.*", "", text, flags=re.DOTALL).lower()
    without_data = re.sub(r'<script type="application/json".*?</script>', "", text, flags=re.DOTALL)
    assert not re.search(r"https?:|[\"'(]//|@import|url\(", without_data)


def test_what_is_missing_is_left_out(tmp_path):
    text = _write(tmp_path, _track())
    assert "Path from above" in text
    for words in ("Error over time", "Followed", "Time per frame", "Against the reference", "reference</span>"):
        assert words not in text
    nothing = _track(
        trajectory=Trajectory(), scene=Scene(), keyframes=np.zeros(0), statistics={}, warnings=("Nothing was tracked.",)
    )
    text = _write(tmp_path, nothing)
    assert "Nothing was tracked." in text and "Path from above" not in text


def test_axes_lie_in_the_level_of_the_cameras():
    poses = _trajectory().world_from_cam
    up = -quaternion.to_matrix(poses[:, :4])[:, :, 1].mean(axis=0)
    along, across, upwards = page._axes(poses[:, 4:], up)
    np.testing.assert_allclose(upwards, [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(along, np.array([1, 0, 1]) / np.sqrt(2), atol=0.1)  # the way it goes
    np.testing.assert_allclose(
        np.stack([along, across, upwards]) @ np.stack([along, across, upwards]).T, np.eye(3), atol=1e-12
    )
    assert np.linalg.det(np.stack([along, across, upwards])) == pytest.approx(1)  # not mirrored


def test_a_path_is_interrupted_where_nothing_was_tracked():
    times = np.delete(TIMES, np.arange(10, 16))
    places = page._interrupted(times, np.delete(CENTERS[:, :2], np.arange(10, 16), axis=0))
    assert np.flatnonzero(np.isnan(places[:, 0])).tolist() == [10]
    drawn = path([Curve("estimate", "red", places)], np.zeros((0, 2)), "x", "y")
    assert re.search(r'd="([^"]*)"', drawn)[1].count("M") == 2


def test_paths_keep_their_shape():
    """A circle is as wide as high; the first place lies where its coordinates say."""
    angle = np.linspace(0, 2 * np.pi, 100)
    circle = 100 + np.stack([np.cos(angle), np.sin(angle)], axis=1)
    drawn = path([Curve("estimate", "red", circle)], circle[:3], "x", "y")
    places = np.array(
        [float(n) for n in re.search(r'd="([^"]*)"', drawn)[1].replace("M", " ").replace("L", " ").split()]
    )
    places = places.reshape(-1, 2)
    assert np.ptp(places[:, 0]) == pytest.approx(np.ptp(places[:, 1]), rel=1e-3)
    assert places[0, 0] == pytest.approx(places[:, 0].max(), abs=0.1)
    assert places[25, 1] == pytest.approx(places[:, 1].min(), abs=0.2)  # up is up
    assert drawn.count("<circle") == 3 + 2


def test_peaks_survive_thinning():
    values = np.zeros(10 * MAX_PLACES)
    values[777] = 5.0
    values[4000:5000] = np.nan
    times = np.arange(len(values)) / 30.0
    drawn = over_time(times, [Curve("error", "red", values)])
    places = re.search(r'd="([^"]*)"', drawn)[1]
    assert len(places) < 20 * MAX_PLACES and places.count("M") == 2
    heights = np.array([float(word.split()[1]) for word in re.split("[ML]", places)[1:]])
    assert (heights < heights.max() - 100).sum() == 1
    assert "nothing to show" in over_time(times, [Curve("error", "red", np.full(len(times), np.nan))])
    assert "nothing to show" in over_time(np.zeros(0), [])


@pytest.mark.parametrize("places", [np.zeros((1, 2)), np.ones((5, 2)), np.array([[0.0, 0.0], [1.0, 0.0]])])
def test_paths_without_extent(places):
    drawn = path([Curve("estimate", "red", places)], places, "x", "y")
    assert "nan" not in drawn and "inf" not in drawn

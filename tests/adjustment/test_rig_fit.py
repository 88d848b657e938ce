# SPDX-License-Identifier: BSD-3-Clause
"""Rigs that are held and do not fit the images: told, with numbers; rigs that fit: nothing is said."""

import re

import numpy as np
import pytest

from groma.adjustment.adjust import AdjustOptions, adjust
from groma.adjustment.uncertainty import pose_uncertainty
from groma.geometry import quaternion, se3
from groma.mapping.options import MapOptions
from groma.mapping.point_base import adjust_with_survey
from groma.mapping.result import MapResult
from groma.scene import Cameras, Scene
from groma.scene.camera import CAMERA, Rigs, Sensors
from groma.scene.image import Frames, Images
from groma.scene.landmarks import Points
from groma.scene.observations import PointObservations

FRAMES, FOCAL, SIZE = 10, 500.0, (640, 480)
MOUNTED = np.array([*quaternion.exp(np.array([[0.0, np.radians(25.0), 0.0]]))[0], -0.4, 0.02, 0.05])


def rig_scene(held, apart=0.0):
    """Two cameras on a rig that walk along a wall, held at a place; ``apart``: how far they move against each other."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-8.0, 8.0, 500), rng.uniform(-2.5, 2.5, 500), rng.uniform(5.0, 8.0, 500)])
    centers = np.column_stack([np.linspace(-3.0, 3.0, FRAMES), rng.normal(0.0, 0.2, (FRAMES, 2))])
    turn = quaternion.exp(rng.normal(0.0, 0.05, (FRAMES, 3)))
    frames = np.hstack([turn, -quaternion.rotate(turn, centers)])
    moved = np.hstack([quaternion.exp(apart * rng.normal(size=(FRAMES, 3))), np.zeros((FRAMES, 3))])
    right = se3.compose(moved, se3.compose(np.tile(MOUNTED, (FRAMES, 1)), frames))
    poses = np.stack([frames, right], axis=1).reshape(-1, 7)
    image, point, pixel = [], [], []
    for row, pose in enumerate(poses):
        inside = quaternion.rotate(np.tile(pose[:4], (len(points), 1)), points) + pose[4:]
        uv = FOCAL * inside[:, :2] / inside[:, 2:] + np.array(SIZE) / 2
        seen = np.flatnonzero((inside[:, 2] > 1.0) & (uv > 0.0).all(1) & (uv < SIZE).all(1))
        image.append(np.full(len(seen), row)), point.append(seen), pixel.append(uv[seen])
    pixel = np.concatenate(pixel) + rng.normal(0.0, 0.3, (sum(map(len, pixel)), 2))
    every = np.arange(2 * FRAMES)
    return Scene(
        cameras=Cameras(np.array([1]), ("SIMPLE_PINHOLE",), np.array([[FOCAL, 320.0, 240.0]]), *np.array([SIZE]).T),
        rigs=Rigs(np.array([1])),
        sensors=Sensors(
            [0, 0], [CAMERA] * 2, [1, 2], [0, 0], np.stack([[0, 0, 0, 1, 0, 0, 0.0], held]), [1, 0], [1, 1]
        ),
        frames=Frames(np.arange(FRAMES) + 1, np.zeros(FRAMES, int), frames),
        images=Images(every + 1, tuple(f"{k}.png" for k in every), np.zeros(len(every), int), every // 2, every % 2),
        points=Points(np.arange(500) + 1, points, np.zeros((500, 3), int), np.zeros(500)),
        point_observations=PointObservations(
            np.concatenate(image), np.concatenate(point), pixel, np.full(len(pixel), -1)
        ),
    )


TURNED = se3.compose(np.array([*quaternion.exp(np.radians([[1.5, 0.0, 0.0]]))[0], 0.0, 0.0, 0.0]), MOUNTED)


@pytest.mark.parametrize(
    ("held", "apart", "refined", "said"),
    [
        (MOUNTED, 0.0, False, None),
        (TURNED, 0.0, False, r"The rig does not fit .* to 0\.3\d px, and they would turn by up to 1\.5 degrees"),
        (TURNED, 0.0, True, None),
        (MOUNTED, 0.02, False, r"not fixed to each other, or .* not taken at the same moments.* to 0\.3\d px"),
        (MOUNTED, 0.02, True, r"not fixed to each other"),
    ],
)
def test_a_rig_that_the_images_contradict_is_told(held, apart, refined, said):
    told = adjust(rig_scene(held, apart), AdjustOptions(refine_rigs=refined)).report.warnings
    about_rigs = [sentence for sentence in told if "rig" in sentence.lower()]
    if said is None:
        assert about_rigs == []
    else:
        assert len(about_rigs) == 1
        assert re.search(said, about_rigs[0])


@pytest.mark.parametrize("refined", [False, True])
def test_rigs_of_a_map_with_measurements_are_estimated_where_that_is_asked(refined):
    def say(doing: str, done: int, total: int) -> None:
        assert doing == "adjusting with measurements" and done <= total

    found = adjust_with_survey(rig_scene(TURNED), MapOptions(refine_rigs=refined), say)
    off = 2.0 * np.degrees(np.arccos(min(abs(found.sensors.cam_from_rig[1, :4] @ MOUNTED[:4]), 1.0)))
    assert off < 0.1 if refined else off == pytest.approx(1.5)


def test_a_map_counts_its_rig_among_what_was_estimated():
    """Its cameras are known as the last adjustment knows them."""
    for refined in (False, True):
        told = AdjustOptions(refine_rigs=refined, loss="cauchy", loss_scale=4.0)
        found = adjust(rig_scene(MOUNTED), told)
        scenes = [found.scene] * 4
        known = MapResult(*scenes, found.report, told, {}, "", {}, ()).pose_uncertainty()
        expected = pose_uncertainty(found.scene, found.problem, found.report.sigma0, by_landmarks=True)
        # Written to a scene and read again, poses differ in their last digits.
        assert known["center"]["median"] == pytest.approx(expected["center"]["median"], rel=1e-6)

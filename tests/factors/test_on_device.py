# SPDX-License-Identifier: BSD-3-Clause
"""Records written by the CUDA loops equal those of the processor to 1e-9, in the simulator or on a device.

The simulator is chosen before Numba is imported, so the comparison runs in a process of its own.
"""

import os
import subprocess
import sys

import pytest

pytest.importorskip("numba.cuda", reason="this Numba has no CUDA target, not even its simulator")

COMPARE = """
import numpy as np
from groma.factors._on_device import linearize_on_device
from groma.factors.line_reprojection import LineReprojection
from groma.factors.point_reprojection import PointReprojection
from groma.factors._factor import Ref
from groma.geometry import se3

rng = np.random.default_rng(7)
M, L, N = 3, 9, 40
tangents = rng.normal(0, 0.2, (M, 6))
poses = se3.to_matrix(se3.exp(tangents))[:, :3].reshape(M, 12)
points = rng.uniform([-2, -2, 3], [2, 2, 9], (L, 3))
points[0] = [0.3, 0.2, -4.0]  # behind: degenerate for perspective models
ends = rng.uniform([-2, -2, 3], [2, 2, 9], (L, 2, 3))
lines = np.concatenate([np.cross(ends[:, 0], ends[:, 1]), ends[:, 1] - ends[:, 0]], axis=1)
intrinsics = {
    "SIMPLE_PINHOLE": [500, 320, 240],
    "PINHOLE": [500, 480, 320, 240],
    "BAL": [500, -0.1, 0.02],
    "RADIAL": [500, 320, 240, -0.1, 0.02],
    "OPENCV": [500, 480, 320, 240, -0.1, 0.02, 1e-3, -2e-3],
    "OPENCV_FISHEYE": [500, 480, 320, 240, -0.02, 0.01, 1e-3, -2e-3],
}
pose, landmark, camera = (Ref("g", rng.integers(0, n, N)) for n in (M, L, 1))

def compare(name, factor, landmarks, params):
    ambients = (poses, landmarks, params)
    width = 6 + landmarks.shape[1] + params.shape[1] + 1
    expected = np.full((N, 2, width), np.nan)
    columns = (0, 6, 6 + landmarks.shape[1])
    degenerate = factor.linearize(factor.prepare(ambients), 0, N, columns, expected)
    found = linearize_on_device(factor, ambients)
    worst = np.max(np.abs(found - expected) / np.maximum(1.0, np.abs(expected)))
    empty = int((found == 0.0).all(axis=(1, 2)).sum())
    print("ROW", name, worst, degenerate, empty)

for name, params in intrinsics.items():
    params = np.array([params], dtype=float)
    pixels = rng.uniform(0, 500, (N, 2))
    shared = dict(pose=pose, intrinsics=camera, camera_model=name)
    compare("point " + name, PointReprojection(point=landmark, pixels=pixels, **shared), points, params)
    if name.endswith("PINHOLE"):
        segments = rng.uniform(0, 500, (N, 4))
        compare("line " + name, LineReprojection(line=landmark, segments=segments, **shared), lines, params)
"""


def _rows(**environment: str) -> list[list[str]]:
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", COMPARE],
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, **environment},
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return [line.split() for line in done.stdout.splitlines() if line.startswith("ROW")]


def _check(rows: list[list[str]]) -> None:
    assert len(rows) == 8
    for _, kind, name, worst, degenerate, empty in rows:
        assert float(worst) < 1e-9, (kind, name)
        assert int(degenerate) == int(empty), (kind, name)
    assert any(int(row[4]) > 0 for row in rows), "no degenerate factor was among them"


@pytest.mark.kernels
def test_the_simulator_writes_the_records_of_the_processor():
    _check(_rows(NUMBA_ENABLE_CUDASIM="1"))


def test_a_device_writes_the_records_of_the_processor():
    from numba import cuda

    if os.environ.get("NUMBA_ENABLE_CUDASIM") == "1" or not cuda.is_available():
        pytest.skip("there is no CUDA device")
    _check(_rows())


def test_without_a_device_an_error_says_what_to_install():
    from numba import cuda

    from groma._cuda import cuda as module
    from groma.errors import InputError

    if cuda.is_available():
        pytest.skip("there is a CUDA device")
    with pytest.raises(InputError, match="numba-cuda"):
        module()

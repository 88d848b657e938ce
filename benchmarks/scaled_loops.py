# SPDX-License-Identifier: BSD-3-Clause
"""A single camera goes around a rendered room and a fifth of it again: with and without loops and joined maps.

    python benchmarks/scaled_loops.py --seeds 0 1

Walls are printed (:mod:`_turning_worlds`). Told are the maps, the frames in the longest, and its position error (RMS,
metres) after the best similarity; then the same over the frames that both have.
"""

from __future__ import annotations

import argparse

import numpy as np
from _turning import Film, Renderer, _exposed
from _turning_worlds import make_room

from groma.evaluation.trajectory import score_trajectory
from groma.geometry import quaternion, se3, so3
from groma.io.sequences.frame import Frame, SequenceCamera
from groma.io.trajectories import Trajectory
from groma.tracking import Tracker, TrackOptions

FRAMES, LAPS, RATE = 220, 1.2, 30.0
#: Half axes of the path, metres, and where the camera looks from outward, radians.
AXES, LOOK = (1.3, 1.0), 0.4


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    for seed in parser.parse_args().seeds:
        camera, frames, truth = rendered(seed)
        found: list[Trajectory] = []
        for close_loops in (False, True):
            tracker = Tracker(camera, TrackOptions(close_loops=close_loops))
            for frame in frames:
                tracker.process(frame)
            result = tracker.finish()
            found.append(result.trajectory)
            maps, loops = 1 + len(result.submaps), result.statistics["loops"]
            print(
                f"room {seed}, {'with' if close_loops else 'without'} loops: {maps} maps, {loops} loops, "
                f"{len(result.trajectory)} frames in the longest, error {_error(result.trajectory, truth):.4f} m",
                flush=True,
            )
        # A longer map has more frames to be wrong in: both once more, over the frames that both have.
        both = np.isin(found[0].timestamps, found[1].timestamps)
        one, two = (
            Trajectory(track.timestamps[rows], track.world_from_cam[rows])
            for track, rows in zip(found, (both, np.isin(found[1].timestamps, found[0].timestamps)), strict=True)
        )
        if len(one) > 3:
            print(f"room {seed}, {len(one)} frames of both: {_error(one, truth):.4f} m, {_error(two, truth):.4f} m")


def _error(trajectory: Trajectory, truth: Trajectory) -> float:
    return score_trajectory(trajectory, truth, "sim3", max_time_difference=0.01).ate.rmse


def path() -> np.ndarray:
    """(FRAMES, 7) cam_from_world."""
    angle = 2 * np.pi * LAPS * np.arange(FRAMES) / (FRAMES - 1)
    center = np.stack([AXES[0] * np.sin(angle), 0.12 * np.sin(3 * angle), AXES[1] * np.cos(angle)], axis=1)
    nod = so3.exp(np.outer(0.06 * np.sin(5 * angle), [1.0, 0, 0]))
    R = so3.exp(np.outer(angle + LOOK, [0, 1.0, 0])) @ nod
    return se3.inverse(np.hstack([quaternion.from_matrix(R), center]))


def rendered(seed: int) -> tuple[SequenceCamera, list[Frame], Trajectory]:
    """Camera, frames and true poses."""
    camera = SequenceCamera("PINHOLE", np.array([393.75, 393.75, 240.0, 180.0]), 480, 360)
    renderer, film, rng = Renderer(make_room(seed), camera), Film(0.02, 1), np.random.default_rng(seed)
    frames, poses = [], path()
    for k, pose in enumerate(poses):
        gray = _exposed(renderer.picture(pose, pose, film)[0], film.noise, rng)
        frames.append(Frame(k / RATE, gray, None, None, f"{k:04d}.png"))
    return camera, frames, Trajectory(np.arange(FRAMES) / RATE, se3.inverse(poses))


if __name__ == "__main__":
    main()

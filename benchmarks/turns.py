# SPDX-License-Identifier: BSD-3-Clause
"""How the tracker holds when the camera turns fast: rendered sequences with exact poses, and real ones turned further.

    python benchmarks/turns.py [--seeds N] [--harder] [--only WORD] [--real FOLDER] [--write FILE]

Rooms with a depth camera that swings by up to 5, 10, 15 and 25 degrees from frame to frame, with printed and with plain
walls; street corners with a stereo pair, 5 to 10 degrees a frame, windows that repeat and a brightness that changes.
``--harder`` renders others: blur of up to 25 pixels, dim light, rows exposed one after the other and depth that comes
later (``real``), large rooms whose walls have no depth, turns in one place; streets with a car that crosses, wide and
empty, or seen by two cameras of different brightness.
``--real`` adds a depth sequence (TUM or 7-Scenes) whose images are cut smaller and turned about the camera, back and
forth. Printed are frames with a pose, frames lost, the position error after alignment, and the worst pose as it was
said in its frame, against the truth. ``--write`` keeps the table.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
from _turning import corner_sequence, room_sequence

from groma.evaluation.trajectory import score_trajectory
from groma.geometry import quaternion, se3, so3
from groma.io.sequences import Frame, SequenceCamera, open_sequence
from groma.io.trajectories import Trajectory
from groma.tracking import Tracker

HEAD = (
    "| sequence | frames with a pose | lost | position error, cm | worst pose when it was said, cm and degrees "
    "| median, 95 % of the frames below, ms |\n|---|--:|--:|--:|--:|--:|"
)


class TurnedFurther:
    """A real depth sequence seen by a smaller camera that turns about the same centre."""

    def __init__(self, folder: Path, degrees: float, stride: int = 1) -> None:
        self._frames = open_sequence(folder, stride=stride)
        if self._frames.kind != "rgbd" or self._frames.reference is None:
            raise SystemExit(f"{folder} must be a sequence of a depth camera with reference poses.")
        self.name = f"{folder.name}, turned by up to {degrees:g} degrees"
        old = self._frames.camera
        width, height = int(0.62 * old.width) // 2 * 2, int(0.62 * old.height) // 2 * 2
        params = np.array([old.params[0], old.params[1], width / 2, height / 2])
        self.camera = SequenceCamera("PINHOLE", params, width, height)
        self.degrees = degrees
        self.reference = self._frames.reference

    def turn(self, k: int) -> np.ndarray:
        """Rotation (3, 3) of the smaller camera in frame k: new_from_old."""
        a = np.radians(self.degrees) * min(k / 6.0, 1.0)
        yaw, pitch, roll = 0.45 * np.sin(0.9 * k), 0.3 * np.sin(0.7 * k + 1.0), 0.5 * np.sin(0.8 * k)
        return so3.exp(np.array([[a * pitch, a * yaw, a * roll]]))[0]

    def __iter__(self) -> Iterator[Frame]:
        old = self._frames.camera
        size = self.camera.width, self.camera.height
        K, new = (
            np.array([[p[0], 0, p[2] - 0.5], [0, p[1], p[3] - 0.5], [0, 0, 1]])
            for p in (old.params, self.camera.params)
        )
        for k, frame in enumerate(self._frames):
            R = self.turn(k)
            H = new @ R @ np.linalg.inv(K)
            gray = cv2.warpPerspective(frame.gray, H, size, flags=cv2.INTER_LINEAR)
            depth = cv2.warpPerspective(frame.depth, H, size, flags=cv2.INTER_NEAREST)
            u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
            rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(new).T
            # The old depth is along the old axis.
            depth = (depth / (rays @ R)[..., 2]).astype(np.float32)
            yield Frame(frame.timestamp, gray, depth, None, frame.name)

    def truth(self, timestamps: np.ndarray) -> np.ndarray:
        """world_from_cam (N, 7) of frames."""
        rows = [int(np.abs(self.reference.timestamps - t).argmin()) for t in timestamps]
        turns = np.array([self.turn(k) for k in range(len(timestamps))])
        back = np.hstack([quaternion.from_matrix(turns.transpose(0, 2, 1)), np.zeros((len(rows), 3))])
        return se3.compose(self.reference.world_from_cam[rows], back)


def row(name: str, camera: SequenceCamera, frames: Iterable[Frame], truth) -> str:
    """Track a sequence; return its row of the table. ``truth`` gives world_from_cam at time stamps."""
    tracker, tracked, took = Tracker(camera), [], []
    for frame in frames:
        begin = time.perf_counter()
        tracked.append(tracker.process(frame))
        took.append(1e3 * (time.perf_counter() - begin))
    result = tracker.finish()
    stamps = np.array([one.timestamp for one in tracked])
    exact = truth(stamps)
    worst = np.zeros(2)
    for part in {one.submap for one in tracked if one.pose is not None}:
        rows = [k for k, one in enumerate(tracked) if one.pose is not None and one.submap == part]
        poses = np.array([tracked[k].pose for k in rows])
        # The world of a map is its first frame.
        expected = se3.compose(se3.inverse(exact[rows]), np.tile(exact[rows[0]], (len(rows), 1)))
        first = se3.compose(se3.inverse(poses[:1]), np.array([[0, 0, 0, 1, 0, 0, 0.0]]))
        poses = se3.compose(poses, np.tile(first, (len(rows), 1)))
        away = se3.inverse(poses)[:, 4:] - se3.inverse(expected)[:, 4:]
        turn = se3.log(se3.compose(poses, se3.inverse(expected)))[:, 3:]
        far = np.linalg.norm(away, axis=1).max(), np.degrees(np.linalg.norm(turn, axis=1).max())
        worst = np.maximum(worst, far)
    lost = sum(one.status == "lost" for one in tracked)
    scores = score_trajectory(result.trajectory, Trajectory(stamps, exact), max_time_difference=0.002)
    took = took[1:]
    return (
        f"| {name} | {len(result.trajectory)} of {len(stamps)} | {lost} | {100 * scores.ate.rmse:.1f} "
        f"| {100 * worst[0]:.0f}, {worst[1]:.1f} | {np.median(took):.0f}, {np.percentile(took, 95):.0f} |"
    )


def rendered(seeds: int):
    """All rendered sequences."""
    for plain in (False, True):
        for degrees in (5, 10, 15, 25):
            for seed in range(seeds):
                yield room_sequence(degrees, seed, plain)
    for degrees in (5, 7.5, 10):
        for seed in range(seeds):
            yield corner_sequence(degrees, seed, right=seed % 2 == 0)


def harder(seeds: int):
    """Rendered sequences with the traits of cameras in the hand, and streets that show little."""
    for seed in range(seeds):
        for film in ("blurred", "dim", "real"):
            for plain in (False, True):
                for degrees in (4, 7):
                    yield room_sequence(degrees, seed, plain, 45, film)
        for plain in (False, True):
            yield room_sequence(7, seed, plain, film="real", size=1.8)
            yield room_sequence(7, seed, plain, film="real", pure=True)
        for degrees in (5, 10):
            right = seed % 2 == 0
            yield corner_sequence(degrees, seed, right, traffic=True)
            yield corner_sequence(degrees, seed, right, wide=True)
            yield corner_sequence(degrees, seed, right, uneven=True)
            yield corner_sequence(degrees, seed, right, traffic=True, wide=True, uneven=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=2, help="worlds and paths of each kind")
    parser.add_argument(
        "--harder", action="store_true", help="sequences with longer exposures, less light, less to see"
    )
    parser.add_argument("--only", default="", metavar="WORD", help="sequences whose name holds this word")
    parser.add_argument("--real", type=Path, action="append", default=[], metavar="FOLDER")
    parser.add_argument("--write", type=Path, metavar="FILE", help="write the table here too")
    arguments = parser.parse_args()
    lines = HEAD.splitlines()
    print(HEAD, flush=True)
    for one in (harder if arguments.harder else rendered)(arguments.seeds):
        if arguments.only in one.name:
            world_from_cam = se3.inverse(one.poses)
            lines.append(row(one.name, one.renderer.camera, one, lambda stamps, exact=world_from_cam: exact))
            print(lines[-1], flush=True)
    for folder in arguments.real:
        for degrees in (10, 20):
            turned = TurnedFurther(folder, degrees)
            lines.append(row(turned.name, turned.camera, turned, turned.truth))
            print(lines[-1], flush=True)
    if arguments.write:
        arguments.write.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    sys.exit(main())

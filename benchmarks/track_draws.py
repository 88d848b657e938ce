# SPDX-License-Identifier: BSD-3-Clause
"""How much a track depends on where it begins and ends, and whether a camera is found again in the right place.

    python benchmarks/track_draws.py SEQUENCE [SEQUENCE ...] [--draws 4] [--kind KIND]
    python benchmarks/track_draws.py SEQUENCE [SEQUENCE ...] --drop 6 20 [--every 5] [--within 3] [--at 14]
    python benchmarks/track_draws.py SEQUENCE [SEQUENCE ...] --stride 3 4 5 [--draws 2]

SEQUENCE is one with a reference. The tracker runs without threads, so CPU times are those of the work itself.

Draws begin at the first, second, ... frame. Printed are frames with a pose, position errors after alignment, and CPU
milliseconds a frame: median, 95th percentile and mean.

With --drop, the process forks (Linux, macOS) at every n-th frame that was tracked, or after the frames given by --at;
the copy goes on after so many frames, with their time stamps. Its first frame in the earlier map, within some frames
after the gap, is right if its motion since the frame before the gap is that of the reference to 10 cm or 10 % of the
way, and 10 degrees. Otherwise it is not found.

With --stride, every n-th frame is tracked, from the first, second, ... one (all n, or as many as --draws). A frame is
right if its motion from a frame of its map is right in the same sense: from that one for which most are.
"""

import argparse
import os
import time
from functools import partial
from pathlib import Path

import numpy as np

from groma.evaluation.trajectory import score_trajectory
from groma.execution import work_with
from groma.features.images import one_opencv_thread
from groma.geometry import se3
from groma.io.sequences import open_sequence
from groma.tracking import Tracker, TrackOptions

#: A pose is right within this distance (metres), share of the way, and angle.
SHIFT, SHARE, ANGLE = 0.1, 0.1, np.radians(10.0)
RIGHT, WRONG, NOT_FOUND = range(3)


def draw(sequence, frames: list) -> str:
    """Track some frames; return the cells of a row."""
    tracker, seconds = Tracker(sequence.camera, TrackOptions(threaded=False)), []
    for frame in frames:
        began = time.process_time()
        tracker.process(frame)
        seconds.append(time.process_time() - began)
    trajectory = tracker.finish().trajectory
    error = 100.0 * score_trajectory(trajectory, sequence.reference, "se3").ate.rmse
    spent = 1e3 * np.array([np.median(seconds), np.percentile(seconds, 95), np.mean(seconds)])
    times = " | ".join(f"{milliseconds:.1f}" for milliseconds in spent)
    return f"{len(trajectory)} of {len(frames)} | {error:.2f} | {times}"


def print_draws(paths: list[Path], kind: str | None, count: int) -> None:
    """Print a row for each draw."""
    print("| sequence | first frame | frames with a pose | position error, cm | CPU ms, median | 95 % | mean |")
    print("|---|--:|--:|--:|--:|--:|--:|")
    for path in paths:
        sequence = open_sequence(path, kind=kind)
        frames = list(sequence)
        for first in range(count):
            print(f"| {path.name} | {first} | {draw(sequence, frames[first:])} |", flush=True)


def motion(after, before):
    """Return how far and which way the camera went, and how it turned, from one pose (7,) to another."""
    moved = se3.compose(after[None], se3.inverse(before[None]))
    return se3.inverse(moved)[0, 4:], moved


def is_right(found, last, reference, reference_last) -> bool:
    """Whether the motion between two poses is that of the reference."""
    (way, moved), (true_way, truly_moved) = motion(found, last), motion(reference, reference_last)
    turn = np.linalg.norm(se3.log(se3.compose(moved, se3.inverse(truly_moved)))[0, 3:])
    return np.linalg.norm(way - true_way) < max(SHIFT, SHARE * np.linalg.norm(true_way)) and turn < ANGLE


def found_again(tracker: Tracker, frames: list, poses, last: int, pose, gap: int, within: int) -> int:
    """Go on after a gap; return what became of the first frame that was found in the same map."""
    for number in range(last + gap + 1, min(last + gap + 1 + within, len(frames))):
        tracked = tracker.process(frames[number])
        if tracked.pose is not None and tracked.submap == 0:
            return RIGHT if is_right(tracked.pose, pose, poses[number], poses[last]) else WRONG
    return NOT_FOUND


def judged(camera, frames: list, poses) -> tuple[int, int, int]:
    """Track frames; return how many were right, wrong, or had no pose when they were answered."""
    tracker = Tracker(camera, TrackOptions(threaded=False))
    maps: dict[int, list] = {}
    for frame, reference in zip(frames, poses, strict=True):
        tracked = tracker.process(frame)
        if tracked.pose is not None:
            maps.setdefault(tracked.submap, []).append((tracked.pose, reference))
    right = sum(
        max(sum(is_right(pose, other, reference, of_other) for pose, reference in own) for other, of_other in own)
        for own in maps.values()
    )
    posed = sum(map(len, maps.values()))
    return right, posed - right, len(frames) - posed


def with_reference(path: Path, kind: str | None):
    """Return the camera of a sequence, its frames, and the reference pose of each (n, 7), cam_from_world."""
    sequence = open_sequence(path, kind=kind)
    frames = list(sequence)
    rows = [int(np.abs(sequence.reference.timestamps - frame.timestamp).argmin()) for frame in frames]
    return sequence.camera, frames, se3.inverse(sequence.reference.world_from_cam[rows])


def print_strides(paths: list[Path], arguments: argparse.Namespace) -> None:
    """Print a row for each sequence and stride."""
    print("| sequence | every | right / wrong / lost | by the first frame |")
    print("|---|--:|---|---|")
    for path in paths:
        camera, frames, poses = with_reference(path, arguments.kind)
        for stride in arguments.stride:
            firsts = range(min(stride, arguments.draws or stride))
            counts = [judged(camera, frames[first::stride], poses[first::stride]) for first in firsts]
            total, *each = (" / ".join(map(str, count)) for count in [np.sum(counts, axis=0), *counts])
            print(f"| {path.name} | {stride} | {total} | {', '.join(each)} |", flush=True)


def in_a_copy(work) -> int:
    """Return the small number that some work gives in a copy of this process."""
    child = os.fork()
    if child == 0:
        code = 255
        try:
            code = work()
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def print_drops(paths: list[Path], arguments: argparse.Namespace) -> None:
    """Print a row for each sequence and gap."""
    print("| sequence | dropped | gaps | right / wrong / not found | last frames before wrong ones |")
    print("|---|--:|--:|---|---|")
    for path in paths:
        camera, frames, poses = with_reference(path, arguments.kind)
        outcomes: dict[int, list[tuple[int, int]]] = {gap: [] for gap in arguments.drop}
        tracker = Tracker(camera, TrackOptions(threaded=False))
        for number, frame in enumerate(frames):
            tracked = tracker.process(frame)
            wanted = number in arguments.at if arguments.at else number >= 3 and number % arguments.every == 0
            if not wanted or tracked.pose is None or tracked.submap:
                continue
            for gap in arguments.drop:
                if number + gap + 1 < len(frames):
                    left = frames, poses, number, tracked.pose, gap, arguments.within
                    outcomes[gap].append((number, in_a_copy(partial(found_again, tracker, *left))))
        for gap, found in outcomes.items():
            count = [sum(outcome == kind for _, outcome in found) for kind in (RIGHT, WRONG, NOT_FOUND)]
            wrong = ", ".join(str(number) for number, outcome in found if outcome == WRONG)
            cells = f"{path.name} | {gap} | {len(found)} | {' / '.join(map(str, count))} | {wrong}"
            print(f"| {cells} |", flush=True)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequences", type=Path, nargs="+", metavar="SEQUENCE")
    parser.add_argument("--kind", choices=("rgbd", "stereo", "mono"), help="what the frames hold, if not all")
    parser.add_argument("--draws", type=int, help="tracks of each sequence (default: 4) or stride")
    parser.add_argument("--drop", type=int, nargs="+", help="frames dropped instead")
    parser.add_argument("--every", type=int, default=5, help="a gap after every n-th frame")
    parser.add_argument("--at", type=int, nargs="+", help="or after these frames, counted from 0")
    parser.add_argument("--stride", type=int, nargs="+", help="every n-th frame instead")
    parser.add_argument("--within", type=int, default=3, help="frames looked at after a gap")
    arguments = parser.parse_args()
    one_opencv_thread()
    with work_with(1):
        if arguments.drop:
            print_drops(arguments.sequences, arguments)
        elif arguments.stride:
            print_strides(arguments.sequences, arguments)
        else:
            print_draws(arguments.sequences, arguments.kind, arguments.draws or 4)


if __name__ == "__main__":
    main()

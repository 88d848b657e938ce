# SPDX-License-Identifier: BSD-3-Clause
"""The end of a track: last keyframe, joints of its maps, the adjustment of all keyframes, and what is returned.

A step that fails, or that Ctrl-C interrupts, is left out and named in a warning. The maps are then as they were before
it, so that nothing that was found is lost to a failure at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TypeVar

import numpy as np

from groma._stopwatch import Stopwatch
from groma.errors import is_interrupt
from groma.io.trajectories import Trajectory
from groma.solver.report import SolveReport
from groma.tracking.backend.depth_calibration import depths_that_do_not_fit
from groma.tracking.backend.focal_length import focal_length_that_does_not_fit
from groma.tracking.backend.mapper import Mapper, Present
from groma.tracking.backend.plane_outcome import PlaneOutcome
from groma.tracking.backend.rival_motions import motion_that_does_not_fit
from groma.tracking.backend.submaps import Joint, PlacedMaps, Submap, best_joint
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.frame.rectification import RightTurn
from groma.tracking.map.track_map import TrackMap
from groma.tracking.outcome import History
from groma.tracking.result import map_to_scene

T = TypeVar("T")


@dataclass(frozen=True)
class Adjusted:
    """The final adjustment of a map."""

    #: Report of the last adjustment of all keyframes, if any.
    report: SolveReport | None
    right_turn: RightTurn
    #: None if planes were not searched in points and lines.
    planes: PlaneOutcome | None

    def numbers(self, camera: TrackCamera) -> dict:
        """Return it as plain values."""
        out: dict = {"right_camera": self.right_turn.numbers(camera)} if camera.baseline > 0 else {}
        if self.planes is not None:
            out["landmark_planes"] = self.planes.numbers()
        if self.report is not None:
            seconds = dict(self.report.seconds)
            out["final_adjustment"] = {"iterations": self.report.iterations, "seconds": seconds}
        return out


class Ending:
    """The steps at the end of a track, and warnings about those that failed."""

    def __init__(self, mapper: Mapper, history: History) -> None:
        self._mapper, self._history = mapper, history
        self._interrupted = False
        #: Steps that were left out.
        self.warnings: list[str] = []

    def attempt(self, what: str, step: Callable[[], T], otherwise: T, changes: Sequence[int] | None = None) -> T:
        """Return the result of a step; if it fails, restore the maps and return ``otherwise``.

        ``changes`` are the numbers of the maps that the step may change, which are copied before it; None: all.
        """
        if self._interrupted:
            return otherwise
        mapper = self._mapper
        kept, current = list(mapper.maps), mapper.current
        for number in range(len(kept)) if changes is None else changes:
            kept[number] = kept[number].copy()
        try:
            return step()
        except (KeyboardInterrupt, Exception) as error:
            self._interrupted = is_interrupt(error)
            interrupted = f"Interrupted at the end of the track: {what}. This and what follows was left out."
            self.warnings.append(interrupted if self._interrupted else _left_out(what, error))
        mapper.abandon()
        mapper.maps, mapper.current = kept, current
        return otherwise

    def settle(self, present: Present) -> None:
        """Make the last chosen keyframe, apply the results of threads, and end them."""
        mapper = self._mapper
        if mapper.due is not None:
            self.attempt("the last keyframe", lambda: mapper.make_keyframe(present, Stopwatch()), None)
        self.attempt("the last adjustment of a window", lambda: mapper.take_up(present, now=True), None)
        self._built("the end of the threads", mapper.close, None)

    def join(self) -> tuple[tuple[int, int], ...]:
        """Merge submaps of the same place; return for each the map that holds it, and the offset of its keyframes."""
        mapper = self._mapper
        places = PlacedMaps.apart(mapper.maps)
        for joint in mapper.joints.values():
            places = self._joined(places, joint)
        if mapper.options.close_loops:
            for one, two in combinations(range(len(mapper.maps)), 2):
                if places.where[one][0] != places.where[two][0]:
                    places = self._searched(places, one, two)
        mapper.maps = list(places.maps)
        self._history.joined(places.where)
        return places.where

    def _searched(self, places: PlacedMaps, one: int, two: int) -> PlacedMaps:
        """Search for places common to two maps."""
        mapper = self._mapper
        joint = self.attempt(
            f"the search for places common to maps {one + 1} and {two + 1}",
            lambda: best_joint(mapper.maps, mapper.camera, one, two, mapper.options),
            None,
            changes=(),
        )
        return places if joint is None else self._joined(places, joint)

    def _joined(self, places: PlacedMaps, joint: Joint) -> PlacedMaps:
        what = f"joining maps {joint.older + 1} and {joint.newer + 1}"
        return self.attempt(what, lambda: places.joined(joint), places, changes=())

    def adjust(self, number: int) -> Adjusted:
        """Adjust all keyframes of a map together, then with planes found in its points and lines."""
        mapper, turn = self._mapper, self._mapper.right.turn
        if mapper.options.close_loops and not mapper.metric:
            self.attempt("the loops of one camera", lambda: mapper.close_scaled_loops(number), None, changes=(number,))
        report, turn = self.attempt(
            "the adjustment of all keyframes", lambda: mapper.adjust_at_end(number), (None, turn), changes=(number,)
        )
        told, gates = [] if mapper.depth_offset is None else mapper.depth_offset.warnings(), mapper.options.gates
        if not mapper.metric:
            told = self.attempt(
                "whether another motion fits",
                lambda: motion_that_does_not_fit(mapper.map, mapper.camera, gates, mapper.options.point_sigma_px),
                [], changes=(),
            )  # fmt: skip
        if mapper.camera.baseline > 0 or not (told or mapper.metric):
            told = self.attempt(
                "whether the focal length fits",
                lambda: focal_length_that_does_not_fit(mapper.map, mapper.camera, gates.rectification), [], changes=(),
            )  # fmt: skip
        elif not told and mapper.map.living():
            told = self.attempt(
                "whether depths fit", lambda: depths_that_do_not_fit(mapper.map, gates.depth), [], changes=()
            )
        self.warnings += [one for one in told if one not in self.warnings]
        what = "the planes of the map's points and lines"
        again, planes = self.attempt(what, lambda: mapper.adjust_with_planes(number), (None, None), (number,))
        report = again or report
        if report is not None and not report.converged:
            self.warnings.append(
                f"The adjustment of all keyframes did not converge in {report.iterations} steps "
                f"({report.termination.key}). groma adjust on scene.npz continues it."
            )
        return Adjusted(report, turn, planes)

    def submap(self, root: int) -> Submap:
        """Return the trajectory and the scene of a map."""
        mapper = self._mapper
        track_map, relations = mapper.maps[root], mapper.options.relations
        stamps = np.array([keyframe.timestamp for keyframe in track_map.living()])
        trajectory = self._built("the trajectory", lambda: self._history.trajectory(track_map, root), Trajectory())
        nothing = map_to_scene(TrackMap(), mapper.camera)
        scene = self._built("the scene", lambda: map_to_scene(track_map, mapper.camera, relations), nothing)
        return Submap(trajectory, scene, stamps[: scene.num_images])

    def _built(self, what: str, step: Callable[[], T], otherwise: T) -> T:
        """Return the result of a step that is needed even after an interruption."""
        try:
            return step()
        except (KeyboardInterrupt, Exception) as error:
            if is_interrupt(error):
                return step()
            self.warnings.append(_left_out(what, error))
            return otherwise


def _left_out(what: str, error: BaseException) -> str:
    return (
        f"Left out at the end of the track: {what}, which failed ({type(error).__name__}: {error}). Please report it."
    )

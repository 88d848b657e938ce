# SPDX-License-Identifier: BSD-3-Clause
"""The state of an adjustment in parts, on disk after every accepted step, so that a killed run resumes.

In the folder ``.checkpoint`` of the result lie ``state.npz``, written by rank 0 (cameras, damping, history), and of
every part two files of its landmarks, written by its owner. A step writes the older of the two; then, when all
processes have written theirs, ``state.npz``, which says which of the two is valid. So whenever the run is killed, what
``state.npz`` says is complete. Every file is replaced in one go. There are never more than these, and none depends on
the number of processes, so that a run may resume with more or fewer of them.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from groma._typing import BoolArray, FloatArray
from groma.adjustment.parts.communication import agreed
from groma.adjustment.parts.opened import LANDMARKS, OpenParts
from groma.bounded.arrays import opened_arrays
from groma.errors import FileFormatError
from groma.io.atomic import atomic_output
from groma.io.reading import reading
from groma.solver.reduce.contract import Reducer
from groma.solver.reduce.journal import Waypoint
from groma.solver.report import Iteration, SolveReport
from groma.solver.standing import Standing
from groma.solver.steps import States
from groma.solver.termination import Termination

FOLDER = ".checkpoint"


@dataclass
class Progressed:
    """How far an adjustment came before the stage it is in."""

    #: Number of the stage, and the scale of its loss if it was widened.
    stage: int = 0
    scale: float | None = None
    #: Reports of the stages before: initial cost and history of each.
    earlier: list[tuple[float, list[Iteration]]] = field(default_factory=list)


class Checkpoint:
    """Keeps where an adjustment stands; a :class:`groma.solver.reduce.journal.Journal`.

    Parameters
    ----------
    folder : Path
        Where; made by the first step.
    key : str
        Identifies parts and options: a checkpoint with another one is not used.
    opened : OpenParts
        The parts of this process.
    reducer : Reducer
        All processes.
    """

    def __init__(self, folder: Path, key: str, opened: OpenParts, reducer: Reducer) -> None:
        self._folder, self._key, self._opened, self._reducer = folder, key, opened, reducer
        self._slot = 0
        self.begin: Waypoint | None = None
        self.progressed = Progressed()
        #: Lines of this process that were moved from one minimum to another.
        self.moved: BoolArray = np.zeros(len(opened.variables.get("lines", ())), bool)

    def load(self) -> States | None:
        """Return the states of an earlier run and take over where it stood; None where there was none."""
        path = self._folder / "state.npz"
        if not path.exists():
            return None
        with _reading(path):
            arrays = _load(path)
            told = json.loads(str(arrays.pop("told")))
            if told["key"] != self._key:
                return None
            self._slot = int(told["slot"])
            self.progressed = Progressed(told["stage"], told["scale"], [(a, _history(b)) for a, b in told["earlier"]])
            history = tuple(_history(told["history"]))
            standing = Standing(told["initial_cost"], told["fell"], history, _ended(told["ended"]))
            self.begin = Waypoint(standing, told["damping"], told["last_ratio"], told["curvature"])
            states: dict[str, FloatArray] = {name: group.state.copy() for name, group in self._opened.variables.items()}
            for name in states.keys() - set(LANDMARKS):
                states[name][:] = _like(arrays[name], states[name])
        for part in self._opened.parts:
            path = self._file(part.path, self._slot)
            with _reading(path):
                arrays = _load(path)
                for name, rows in part.rows.items():
                    states[name][rows] = _like(arrays[name], states[name][rows])
                if "lines" in part.rows:
                    moved = self.moved[part.rows["lines"]]
                    self.moved[part.rows["lines"]] = _like(arrays["moved"], moved)
        return states

    def enter(self, progressed: Progressed) -> None:
        """Begin a stage."""
        self.progressed, self.begin = progressed, None

    def keep(self, states: States, waypoint: Waypoint) -> None:
        """Write where the adjustment stands."""
        slot = 1 - self._slot
        with agreed(self._reducer):
            self._folder.mkdir(exist_ok=True)
            for part in self._opened.parts:
                arrays: dict[str, np.ndarray] = {name: states[name][rows] for name, rows in part.rows.items()}
                if "lines" in part.rows:
                    arrays["moved"] = self.moved[part.rows["lines"]]
                _save(self._file(part.path, slot), arrays)
        with agreed(self._reducer):
            if self._reducer.rank == 0:
                kept = {name: state for name, state in states.items() if name not in LANDMARKS}
                _save(self._folder / "state.npz", {**kept, "told": np.array(json.dumps(self._told(slot, waypoint)))})
        self._slot = slot

    def _told(self, slot: int, waypoint: Waypoint) -> dict[str, Any]:
        standing = waypoint.standing
        return {
            "key": self._key,
            "slot": slot,
            **asdict(self.progressed),
            "initial_cost": standing.initial_cost,
            "fell": standing.fell,
            "history": [asdict(record) for record in standing.history],
            "ended": standing.ended and standing.ended.key,
            **{name: getattr(waypoint, name) for name in ("damping", "last_ratio", "curvature")},
        }

    def _file(self, part: Path, slot: int) -> Path:
        return self._folder / f"{part.stem}.{slot}.npz"

    def remove(self) -> None:
        """Forget it: the adjustment is written."""
        shutil.rmtree(self._folder, ignore_errors=True)


def key_of(paths: Sequence[Path], *options: object) -> str:
    """Return a hash of files, by name, size and time, and of options."""
    files = [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in paths]
    return hashlib.sha256(repr((files, options)).encode()).hexdigest()


def reports_of(progressed: Progressed) -> list[SolveReport]:
    """Return the reports of the stages before, as far as they are known."""
    return [
        SolveReport(initial_cost=cost, history=history, iterations=len(history)) for cost, history in progressed.earlier
    ]


def _save(path: Path, arrays: dict[str, np.ndarray]) -> None:
    with atomic_output(path, force=True) as draft, draft.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Turn any error into one with a remedy."""
    try:
        with reading(path, "checkpoint"):
            yield
    except FileFormatError as error:
        raise FileFormatError(f"{path} is damaged. Pass --force to begin anew.") from error


def _load(path: Path) -> dict[str, np.ndarray]:
    with opened_arrays(path) as members:
        return {name: members.read(name) for name in members.names}


def _like(array: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Return an array that takes the place of another one; ValueError if it is of another form, or not finite."""
    if array.shape != own.shape or array.dtype != own.dtype or not np.isfinite(array).all():
        raise ValueError("other variables")
    return array


def _history(records: list[dict[str, Any]]) -> list[Iteration]:
    return [Iteration(**record) for record in records]


def _ended(key: str | None) -> Termination | None:
    return next((reason for reason in Termination if reason.key == key), None)

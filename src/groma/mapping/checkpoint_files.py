# SPDX-License-Identifier: BSD-3-Clause
"""How the results of stages are kept in files: scenes, segments, line maps, adjusted scenes with their reports."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.adjustment.report import AdjustReport, AdjustResult
from groma.bounded.arrays import opened_arrays
from groma.features.segments import Segments
from groma.io import atomic_output, read_archive, write_archive
from groma.io.reading import reading
from groma.mapping.depth.points import MeasuredDepths
from groma.mapping.lines.line_map import LineMap
from groma.mapping.posed.registered import RegisteredPhotographs
from groma.solver.report import Iteration, SolveReport
from groma.solver.termination import Termination

_T = TypeVar("_T")


@dataclass(frozen=True)
class FileKind(Generic[_T]):
    """How results of one type are written and read. A file is there whole or not at all."""

    write: Callable[[_T, Path], None]
    read: Callable[[Path], _T]


def _write_arrays(path: Path, arrays: dict[str, Any]) -> None:
    with atomic_output(path, force=True) as draft, draft.open("wb") as file:
        np.savez(file, **arrays)


def _read_arrays(path: Path) -> dict[str, Any]:
    with reading(path, "finished stage"), opened_arrays(path) as saved:
        return {name: saved.read(name) for name in saved.names}


def _write_segments(segments: list[Segments], path: Path) -> None:
    arrays = {item.name: _concatenated([getattr(s, item.name) for s in segments]) for item in fields(Segments)}
    _write_arrays(path, {"counts": np.array([len(s) for s in segments], np.int64), **arrays})


def _read_segments(path: Path) -> list[Segments]:
    saved = _read_arrays(path)
    with reading(path, "finished stage"):
        columns = (_parted(saved[item.name], saved["counts"]) for item in fields(Segments))
        return [Segments(*parts) for parts in zip(*columns, strict=True)]


_LISTS = ("outcomes", "neighbors")


def _write_line_map(line_map: LineMap, path: Path) -> None:
    arrays: dict[str, Any] = {}
    for item in fields(line_map):
        value = getattr(line_map, item.name)
        if item.name in _LISTS:
            arrays[item.name] = _concatenated(list(value)).astype(np.int64)
            arrays[f"{item.name}.counts"] = np.array([len(part) for part in value], np.int64)
        else:
            arrays[item.name] = value
    _write_arrays(path, arrays)


def _read_line_map(path: Path) -> LineMap:
    saved = _read_arrays(path)
    with reading(path, "finished stage"):
        for name in _LISTS:
            saved[name] = tuple(_parted(saved[name], saved.pop(f"{name}.counts")))
        return LineMap(**saved)


def _write_report(report: AdjustReport, path: Path) -> None:
    content = asdict(replace(report, solve=replace(report.solve, termination=report.termination.key)))  # type: ignore[arg-type]
    _write_arrays(path, {"report": np.array(json.dumps(content, default=_number))})


def _read_report(path: Path) -> AdjustReport:
    saved = _read_arrays(path)
    with reading(path, "finished stage"):
        content = json.loads(str(saved["report"]))
        solve = content.pop("solve")
        solve["termination"] = next(end for end in Termination if end.key == solve["termination"])
        solve["history"] = [Iteration(**step) for step in solve["history"]]
        for name in ("warnings", "stages"):
            content[name] = tuple(content[name])
        return AdjustReport(**content, solve=SolveReport(**solve))


def _number(value: Any) -> Any:
    return value.tolist()


def _concatenated(parts: list[Any]) -> Any:
    return np.concatenate(parts) if parts else np.zeros(0)


def _parted(array: Any, counts: IntArray) -> list[Any]:
    return np.split(array, np.cumsum(counts)[:-1]) if len(counts) else []


def _write_adjusted(result: AdjustResult, path: Path) -> None:
    # The scene comes last: where it is, the report is.
    _write_report(result.report, path.with_suffix(".report.npz"))
    write_archive(result.scene, path)


def _read_adjusted(path: Path) -> AdjustResult:
    return AdjustResult(read_archive(path), _read_report(path.with_suffix(".report.npz")))


def _write_registered(registered: RegisteredPhotographs, path: Path) -> None:
    # The scene comes last: where it is, the words are.
    _write_arrays(
        path.with_suffix(".words.npz"), {"words": np.array(json.dumps([registered.notes, registered.warnings]))}
    )
    write_archive(registered.scene, path)


def _read_registered(path: Path) -> RegisteredPhotographs:
    words = path.with_suffix(".words.npz")
    saved = _read_arrays(words)
    with reading(words, "finished stage"):
        notes, warnings = json.loads(str(saved["words"]))
        return RegisteredPhotographs(read_archive(path), tuple(notes), tuple(warnings))


def _write_depths(measured: MeasuredDepths, path: Path) -> None:
    # The scene comes last: where it is, the rest is.
    told = {"units": measured.units, "header": np.array(measured.header())}
    _write_arrays(path.with_suffix(".units.npz"), told)
    write_archive(measured.scene, path)


def _read_depths(path: Path) -> MeasuredDepths:
    units = path.with_suffix(".units.npz")
    saved = _read_arrays(units)
    with reading(units, "finished stage"):
        return MeasuredDepths.of(read_archive(path), saved["units"], str(saved["header"]))


def _write_array(array: FloatArray, path: Path) -> None:
    _write_arrays(path, {"array": array})


def _read_array(path: Path) -> FloatArray:
    saved = _read_arrays(path)
    with reading(path, "finished stage"):
        return saved["array"]


SCENE = FileKind(write_archive, read_archive)
SEGMENTS = FileKind(_write_segments, _read_segments)
LINE_MAP = FileKind(_write_line_map, _read_line_map)
ADJUSTED = FileKind(_write_adjusted, _read_adjusted)
REGISTERED = FileKind(_write_registered, _read_registered)
DEPTHS = FileKind(_write_depths, _read_depths)
ARRAY = FileKind(_write_array, _read_array)

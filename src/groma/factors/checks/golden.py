# SPDX-License-Identifier: BSD-3-Clause
r"""Comparison of factors with reference values from a folder.

The folder holds four JSON files, ``point.json``, ``line_endpoint.json``, ``line_normal.json`` and
``plane_quaternion.json``. Each is an object with ``schema`` = "golden-factor-1", ``factor`` and ``cases``; a case has
``id``, ``inputs`` (name to numbers), ``residual``, ``jacobians`` (block name to matrix) and ``noise`` (block name to
number). Numbers are strings holding the shortest decimal that gives the float64.

A block x_left or x_right is the derivative by an increment from the left or from the right: each tests a factor
together with a chart. A deviation is allowed up to

.. math:: 10^{-9} \max(\max|\mathrm{ref}|,\ \mathrm{floor}) + 100\ \mathrm{noise},

with the floor :math:`10^{-6}` for residuals and 0 for Jacobians; the noise is what rounding of the inputs alone can do.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from groma._typing import FloatArray
from groma.errors import FileFormatError, InputError
from groma.factors.contract import Factor, Ref
from groma.factors.observations.line_normal import LineNormal
from groma.factors.observations.line_reprojection import LineReprojection
from groma.factors.observations.plane_quaternion import PlaneQuaternion
from groma.factors.observations.point_reprojection import PointReprojection
from groma.geometry.charts.line_charts import LINE_CHARTS
from groma.geometry.charts.plane_charts import PLANE_CHARTS
from groma.geometry.charts.pose_charts import POSE_CHARTS
from groma.geometry.manifold import Manifold

SCHEMA = "golden-factor-1"
RELATIVE = 1e-9
RESIDUAL_FLOOR = 1e-6
NOISE_FACTOR = 100.0

Blocks = dict[str, FloatArray]


@dataclass(frozen=True)
class GoldenRow:
    """How well one block of one factor agrees with its reference values."""

    #: Name of the file without its ending.
    factor: str
    #: ``residual``, or the name of the Jacobian block.
    block: str
    #: Largest deviation divided by the allowed one.
    worst: float
    #: Cases that list this block.
    cases: int
    #: Case with the largest deviation.
    worst_case: str

    @property
    def passed(self) -> bool:
        """Whether the deviation is allowed; NaN is not."""
        return bool(self.worst <= 1.0)


# --------------------------------------------------------------------------------------------------------- The factors
def _evaluate(factor: Factor, ambients: tuple[FloatArray, ...], sizes: tuple[int, ...]) -> list[FloatArray]:
    """Return the Jacobian blocks (N, m, size), and last the residual (N, m)."""
    starts = np.cumsum((0, *sizes))
    record = np.full((len(factor), factor.residual_size, starts[-1] + 1), np.nan)
    factor.linearize(factor.prepare(ambients), 0, len(factor), tuple(int(s) for s in starts[:-1]), record)
    return [record[:, :, a:b] for a, b in pairwise(starts)] + [record[:, :, -1]]


def _chain(block: FloatArray, chart: Manifold, state: FloatArray) -> FloatArray:
    basis = chart.basis(state)
    return block if basis is None else block @ basis


def _pose(q: FloatArray, t: FloatArray) -> FloatArray:
    return np.hstack([q / np.linalg.norm(q, axis=1, keepdims=True), t])


def _refs(count: int, *names: str) -> dict[str, Any]:
    return {name: Ref(name, np.arange(count)) for name in names}


def _point(x: Blocks) -> Blocks:
    pose = _pose(x["q_CW"], x["t_CW"])
    factor = PointReprojection(
        **_refs(len(pose), "pose", "point", "intrinsics"),
        camera_model="PINHOLE",
        pixels=x["uv"],
        require_in_front=False,
    )
    ambients = (POSE_CHARTS["left"].ambient(pose), x["X_W"], x["K"])
    by_pose, by_point, by_intrinsics, residual = _evaluate(factor, ambients, (6, 3, 4))
    return {
        "residual": residual,
        "pose_left": _chain(by_pose, POSE_CHARTS["left"], pose),
        "pose_right": _chain(by_pose, POSE_CHARTS["right"], pose),
        "point": by_point,
        "intrinsics": by_intrinsics,
    }


def _line_endpoint(x: Blocks) -> Blocks:
    pose, plucker = _pose(x["q_CW"], x["t_CW"]), np.hstack([x["m_W"], x["d_W"]])
    factor = LineReprojection(
        **_refs(len(pose), "pose", "line", "intrinsics"),
        camera_model="PINHOLE",
        segments=np.hstack([x["x_s"], x["x_e"]]),
    )
    poses = POSE_CHARTS["left"].ambient(pose)
    by_pose, by_line, by_intrinsics, residual = _evaluate(factor, (poses, plucker, x["K"]), (6, 6, 4))
    blocks = {
        "residual": residual,
        "pose_left": _chain(by_pose, POSE_CHARTS["left"], pose),
        "pose_right": _chain(by_pose, POSE_CHARTS["right"], pose),
        "line_plucker": by_line,
        "intrinsics": by_intrinsics,
    }
    for side in ("left", "right"):
        chart = LINE_CHARTS[f"orthonormal_{side}"]
        state = chart.from_ambient(plucker)
        by_line = _evaluate(factor, (poses, chart.ambient(state), x["K"]), (6, 6, 4))[1]
        blocks[f"line_{side}"] = _chain(by_line, chart, state)
    return blocks


def _line_normal(x: Blocks) -> Blocks:
    body, extrinsics = _pose(x["q_BW"], x["t_BW"]), _pose(x["q_CB"], x["t_CB"])
    line = np.hstack([x["q_WL"] / np.linalg.norm(x["q_WL"], axis=1, keepdims=True), x["d_L"]])
    factor = LineNormal(**_refs(len(body), "pose", "line", "extrinsics"), normals=x["n_C"])
    to_ambient = POSE_CHARTS["left"].ambient
    blocks: Blocks = {}
    for side in ("left", "right"):
        chart = LINE_CHARTS[f"free_{side}"]
        ambients = (to_ambient(body), chart.ambient(line), to_ambient(extrinsics))
        by_body, by_line, by_extrinsics, residual = _evaluate(factor, ambients, (6, 6, 6))
        blocks["residual"] = residual
        blocks[f"line_{side}"] = _chain(by_line, chart, line)
        blocks[f"body_{side}"] = _chain(by_body, POSE_CHARTS["left" if side == "left" else "body"], body)
        blocks[f"extrinsics_{side}"] = _chain(by_extrinsics, POSE_CHARTS[side], extrinsics)
    return blocks


def _plane_quaternion(x: Blocks) -> Blocks:
    pose = _pose(x["q_CW"], x["t_CW"])
    factor = PlaneQuaternion(**_refs(len(pose), "pose", "plane"), planes_in_cam=x["pi_C"])
    blocks: Blocks = {}
    for side in ("left", "right"):
        chart = PLANE_CHARTS[f"quaternion_{side}"]
        state = chart.from_ambient(x["pi_W"])
        ambients = (POSE_CHARTS["left"].ambient(pose), chart.ambient(state))
        by_pose, by_plane, blocks["residual"] = _evaluate(factor, ambients, (6, 4))
        blocks[f"plane_{side}"] = _chain(by_plane, chart, state)
        blocks[f"pose_{side}"] = _chain(by_pose, POSE_CHARTS[side], pose)
    return blocks


#: For each file: what evaluates it, and the lengths of its inputs.
FILES = {
    "point": (_point, {"q_CW": 4, "t_CW": 3, "K": 4, "X_W": 3, "uv": 2}),
    "line_endpoint": (_line_endpoint, {"q_CW": 4, "t_CW": 3, "K": 4, "m_W": 3, "d_W": 3, "x_s": 2, "x_e": 2}),
    "line_normal": (_line_normal, {"n_C": 3, "q_CB": 4, "t_CB": 3, "q_BW": 4, "t_BW": 3, "q_WL": 4, "d_L": 1}),
    "plane_quaternion": (_plane_quaternion, {"q_CW": 4, "t_CW": 3, "pi_C": 4, "pi_W": 4}),
}


# ------------------------------------------------------------------------------------------------------------- Reading
def _field(path: Path, where: str, owner: Any, name: str, kind: type) -> Any:
    value = owner.get(name) if isinstance(owner, dict) else None
    if not isinstance(value, kind):
        found = "nothing" if value is None else f"a {type(value).__name__}"
        raise FileFormatError(
            f"{path}: {where} must have a field {name!r} of type {kind.__name__}; got {found}. "
            f"Take the reference values from an undamaged copy."
        )
    return value


def _numbers(path: Path, where: str, value: Any, shape: tuple[int, ...]) -> FloatArray:
    try:
        array = np.array(value, dtype=object)
        if array.shape != shape:
            raise ValueError(f"shape {array.shape}")
        array = np.array([float(entry) for entry in array.ravel()]).reshape(shape)
        if not np.isfinite(array).all():
            raise ValueError("a number that is not finite")
    except (TypeError, ValueError, OverflowError) as error:
        raise FileFormatError(
            f"{path}: {where} must hold finite numbers of shape {shape}; got {error}. "
            f"Take the reference values from an undamaged copy."
        ) from None
    return array


def _read_cases(path: Path) -> list[dict[str, Any]]:
    try:
        content = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise FileFormatError(
            f"{path} must be a JSON file of reference values; it cannot be parsed ({error}). "
            f"Take it from an undamaged copy."
        ) from None
    except OSError as error:
        raise InputError(f"{path} must be readable; got {error.strerror}. Check the folder.") from None
    if _field(path, "the file", content, "schema", str) != SCHEMA:
        raise FileFormatError(f"{path}: schema must be {SCHEMA!r}; got {content['schema']!r}.")
    if _field(path, "the file", content, "factor", str) != path.stem:
        raise FileFormatError(f"{path}: factor must be {path.stem!r}, as the file name; got {content['factor']!r}.")
    cases = _field(path, "the file", content, "cases", list)
    if not cases:
        raise FileFormatError(f"{path} must hold at least one case; got none.")
    return cases


def _check_file(path: Path) -> list[GoldenRow]:
    evaluate, sizes = FILES[path.stem]
    cases = _read_cases(path)
    names = [_field(path, f"case {k}", case, "id", str) for k, case in enumerate(cases)]
    inputs = {name: np.empty((len(cases), size)) for name, size in sizes.items()}
    for k, case in enumerate(cases):
        given = _field(path, names[k], case, "inputs", dict)
        for name, size in sizes.items():
            inputs[name][k] = _numbers(path, f"{names[k]}: {name}", given.get(name), (size,))
    got = evaluate(inputs)
    ratios: dict[str, list[tuple[float, str]]] = {}
    for k, case in enumerate(cases):
        expected = {"residual": case.get("residual"), **_field(path, names[k], case, "jacobians", dict)}
        noise = _field(path, names[k], case, "noise", dict)
        for block, value in expected.items():
            if block not in got:
                raise FileFormatError(
                    f"{path}: {names[k]} lists the block {block!r}; known are {', '.join(got)}. Update groma."
                )
            reference = _numbers(path, f"{names[k]}: {block}", value, got[block][k].shape)
            rounding = float(_numbers(path, f"{names[k]}: noise of {block}", noise.get(block, "0"), ()))
            floor = RESIDUAL_FLOOR if block == "residual" else 0.0
            allowed = RELATIVE * max(float(np.abs(reference).max()), floor) + NOISE_FACTOR * rounding
            deviation = float(np.abs(got[block][k] - reference).max())
            ratio = deviation / allowed if allowed > 0.0 else (0.0 if deviation == 0.0 else np.inf)
            ratios.setdefault(block, []).append((ratio if ratio == ratio else np.inf, names[k]))
    rows = []
    for block, entries in ratios.items():
        worst, case_name = max(entries)
        rows.append(GoldenRow(path.stem, block, worst, len(entries), case_name))
    return rows


def check_golden(folder: Path | str) -> list[GoldenRow]:
    """Compare the four basic factors with the reference values in a folder.

    Parameters
    ----------
    folder : Path
        Folder with the four files named at the top of this module.

    Returns
    -------
    list of GoldenRow
        One row for the residual and for each Jacobian block of each file.

    Raises
    ------
    InputError
        If a file is missing or cannot be read.
    FileFormatError
        If a file is not of the format.
    """
    folder = Path(folder)
    missing = [f"{name}.json" for name in FILES if not (folder / f"{name}.json").is_file()]
    if missing:
        raise InputError(
            f"The folder {folder} must hold {', '.join(f'{name}.json' for name in FILES)}; missing: "
            f"{', '.join(missing)}. Check the path."
        )
    return [row for name in FILES for row in _check_file(folder / f"{name}.json")]

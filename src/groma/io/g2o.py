# SPDX-License-Identifier: BSD-3-Clause
r"""Pose graphs in the text formats of g2o and TORO, plain or compressed by gzip.

====================  =============================================================================================
``VERTEX_SE3:QUAT``   id, x y z, qx qy qz qw: world_from_body
``EDGE_SE3:QUAT``     two ids, the same seven numbers: first_from_second, and the upper triangle (21) of its information
``VERTEX_SE2``        id, x y angle
``EDGE_SE2``          two ids, x y angle, and the upper triangle (6) of its information
``FIX``               ids of poses that are held
``VERTEX2``           TORO: as ``VERTEX_SE2``
``EDGE2``             TORO: two ids, x y angle, and the information as xx xy yy aa xa ya
``VERTEX3``           TORO: id, x y z, roll pitch yaw
``EDGE3``             TORO: two ids, x y z, roll pitch yaw, and perhaps the upper triangle of the information (else 1)
``EQUIV``             TORO: two ids of one and the same pose, which is read once, under the first id that it has
====================  =============================================================================================

g2o states the rotation error of ``EDGE_SE3:QUAT`` as the vector part of a quaternion, which is half the angle. Here
errors are in radians, so the information is

.. math:: \Sigma^{-1} = S\, \Sigma_{file}^{-1}\, S, \qquad S = \mathrm{diag}(1, 1, 1, \tfrac12, \tfrac12, \tfrac12) .

Other readers take the numbers as they are, and thereby rotations for twice as certain as they were written. TORO's
angles are whole angles. Roll, pitch and yaw turn about x, then y, then z of the first body: ``R = R_z R_y R_x``.
Lines with ``#`` and parameters of sensors (``PARAMS_...``) are passed over; other vertices and edges are refused, those
of landmarks (``VERTEX_XY``, ``VERTEX_TRACKXYZ``) too: without them the poses would end elsewhere.

Reference: R. Kuemmerle, G. Grisetti, H. Strasdat, K. Konolige, W. Burgard, *g2o: a general framework for graph
optimization*, ICRA 2011, and its ``EdgeSE3::computeError``. G. Grisetti, C. Stachniss, S. Grzonka, W. Burgard, *TORO*,
openslam.org.
"""

from __future__ import annotations

import gzip
import io
import os
import zlib
from array import array
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from groma._counted import counted
from groma._typing import FloatArray, IntArray
from groma.bounded.names import existing
from groma.bounded.text import finite, read_words
from groma.errors import FileFormatError
from groma.geometry import quaternion
from groma.io.atomic import atomic_output
from groma.io.pose_conventions import G2O
from groma.io.reading import reading
from groma.scene.pose_graph import GraphPoses, Motions, PoseGraph

#: Numbers after the tag.
_NUMBERS = {"VERTEX_SE3:QUAT": 8, "EDGE_SE3:QUAT": 30, "VERTEX_SE2": 4, "EDGE_SE2": 11}
#: The same of TORO, and the tag of g2o that holds the same.
_TORO = {
    "VERTEX2": (4, "VERTEX_SE2"),
    "EDGE2": (11, "EDGE_SE2"),
    "VERTEX3": (7, "VERTEX_SE3:QUAT"),
    "EDGE3": (29, "EDGE_SE3:QUAT"),
}
#: Prefixes of tags of landmarks and of their measurements, and the suffix of a pose with a landmark.
_LANDMARKS = ("VERTEX_XY", "VERTEX_TRACKXYZ", "EDGE_SE2_XY", "EDGE_SE3_TRACKXYZ", "EDGE_SE3_XYZ", "EDGE_BEARING_SE2_XY")
#: Numbers of an edge of TORO in space that states no information (file format).
_BARE_EDGE3 = 8
#: Larger numbers are not exact as floating point (derived from the precision of doubles).
_ID_LIMIT = 2.0**53
_HALF_ANGLES = np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])
#: What they do to each number of an upper triangle, and an upper triangle of the identity.
_HALF_ANGLE_PAIRS = np.outer(_HALF_ANGLES, _HALF_ANGLES)[np.triu_indices(6)]
_ONE = ["1" if row == column else "0" for row, column in zip(*np.triu_indices(6), strict=True)]
#: First bytes by which a file is recognised (cost: time only).
_HEAD_BYTES = 4096
#: Coordinates of a planar motion within (rho, omega) (file format).
_PLANAR = np.array([0, 1, 5])


def read_g2o(path: str | os.PathLike[str]) -> PoseGraph:
    """Read a pose graph; poses that only motions name are composed from these.

    Raises
    ------
    InputError
        If there is no such file.
    FileFormatError
        If a line does not fit its tag, refers to a missing pose, or has an unknown tag.
    """
    place = existing(path)
    with reading(place, "g2o file"):
        return _graph(_rows_by_tag(place), place)


def write_g2o(graph: PoseGraph, path: str | os.PathLike[str], force: bool = False) -> None:
    """Write a pose graph, compressed if the name ends in .gz; numbers keep all their digits."""
    text = io.StringIO()
    ids = graph.poses.ids
    firsts, seconds = ids[graph.motions.first_idx].tolist(), ids[graph.motions.second_idx].tolist()
    if graph.planar:
        tags, size = ("VERTEX_SE2", "EDGE_SE2"), 3
        poses, motions = (_planar(pose) for pose in (graph.poses.world_from_body, graph.motions.first_from_second))
        information = graph.motions.information[:, _PLANAR[:, None], _PLANAR]
    else:
        tags, size = ("VERTEX_SE3:QUAT", "EDGE_SE3:QUAT"), 6
        poses, motions = (_file_order(pose) for pose in (graph.poses.world_from_body, graph.motions.first_from_second))
        information = graph.motions.information / (_HALF_ANGLES[:, None] * _HALF_ANGLES)
    upper = information[:, *np.triu_indices(size)]
    for name, pose in zip(ids.tolist(), poses.tolist(), strict=True):
        text.write(f"{tags[0]} {name} {_join(pose)}\n")
    text.writelines(f"FIX {name}\n" for name in ids[graph.poses.held].tolist())
    for first, second, motion, weights in zip(firsts, seconds, motions.tolist(), upper.tolist(), strict=True):
        text.write(f"{tags[1]} {first} {second} {_join(motion)} {_join(weights)}\n")
    content = text.getvalue().encode()
    with atomic_output(path, force) as draft:
        draft.write_bytes(gzip.compress(content, mtime=0) if Path(path).suffix.lower() == ".gz" else content)


def looks_like_g2o(head: bytes) -> bool:
    """Whether the first bytes of a file, decompressed if necessary, are those of a pose graph."""
    lines = (line.split(None, 1) for line in head.splitlines())
    tag = next((words[0].decode("ascii", "replace") for words in lines if words and words[0][:1] != b"#"), "")
    return tag in (*_NUMBERS, *_TORO, "FIX") or tag.startswith("PARAMS_SE")


def is_g2o(path: Path) -> bool:
    """Whether a file holds a pose graph, by its name (.g2o, .g2o.gz) or its first bytes."""
    if path.name.lower().endswith((".g2o", ".g2o.gz")):
        return True
    if not path.is_file():
        return False
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
        if head[:2] == b"\x1f\x8b":
            head = zlib.decompressobj(zlib.MAX_WBITS | 16).decompress(head, _HEAD_BYTES)
    except (OSError, zlib.error):
        return False
    return looks_like_g2o(head)


def _rows_by_tag(path: Path) -> dict[str, array[float]]:
    """Return the numbers after each tag, one row after the other, by tag."""
    rows: dict[str, array[float]] = {}
    for number, (tag, *words) in read_words(path):
        if tag.startswith("PARAMS_"):
            continue
        place = f"{path}, line {number}"
        if tag == "FIX":
            rows.setdefault(tag, array("d")).extend(finite(words, place, "ids of poses"))
            continue
        expected = _NUMBERS.get(tag) or _TORO.get(tag, (0, ""))[0]
        if tag == "EQUIV":
            expected = 2
        if not expected:
            raise FileFormatError(f"{place}: {_why_not(tag)}")
        if tag == "EDGE3" and len(words) == _BARE_EDGE3:
            words = [*words, *_ONE]
        if len(words) != expected:
            raise FileFormatError(f"{place}: {tag} takes {expected} numbers; got {len(words)}. Is it cut off?")
        rows.setdefault(tag, array("d")).extend(finite(words, place, f"{expected} finite numbers after {tag}"))
    return rows


def _why_not(tag: str) -> str:
    if tag in _LANDMARKS:
        return (
            f"{tag} is of a graph with landmarks; groma adjusts graphs of poses. To adjust the poses by the motions "
            f"between them alone, remove all lines of landmarks: {', '.join(_LANDMARKS)}."
        )
    return f"{tag[:40]!r} is not read; a pose graph has {', '.join((*_NUMBERS, *_TORO))}, EQUIV and FIX."


def _without_equivalents(rows: dict[str, array[float]], path: Path) -> dict[str, array[float]]:
    """Return rows of g2o with every pose that EQUIV gives several ids under the first of them alone."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if "EQUIV" not in rows:
        return rows
    ids, ends = np.unique(_integers(np.array(rows["EQUIV"]), path), return_inverse=True)
    graph = coo_matrix((np.ones(len(ends) // 2), (ends[0::2], ends[1::2])), shape=(len(ids), len(ids)))
    part = connected_components(graph, directed=False)[1]
    first = ids[np.unique(part, return_index=True)[1][part]]
    result, named = {"FIX": rows.get("FIX", array("d"))}, [np.zeros(0)]
    for tag in ("FIX", *(rows.keys() & _NUMBERS.keys())):
        ends_of, width = (2, _NUMBERS[tag]) if tag.startswith("EDGE") else (1, _NUMBERS.get(tag, 1))
        table = np.array(rows.get(tag, [])).reshape(-1, width)
        named.append(table[:, :ends_of].reshape(-1))
        at = np.minimum(np.searchsorted(ids, table[:, :ends_of]), len(ids) - 1)
        names = np.where(ids[at] == table[:, :ends_of], first[at], table[:, :ends_of])
        kept = names[:, 0] != names[:, 1] if ends_of == 2 else (names[:, 0] == table[:, 0]) | (tag == "FIX")
        result[tag] = array("d", np.hstack([names, table[:, ends_of:]])[kept].ravel())
    missing = ids[~np.isin(ids, np.concatenate(named))]
    if len(missing):
        raise FileFormatError(f"{path}: EQUIV names pose {missing[0]}, which is not there.")
    return result


def _without_toro(rows: dict[str, array[float]]) -> dict[str, array[float]]:
    """Return rows with those of TORO as g2o writes them, behind g2o's own."""
    result = {tag: values for tag, values in rows.items() if tag not in _TORO}
    for tag, (width, same) in _TORO.items():
        if tag not in rows:
            continue
        table = np.array(rows[tag]).reshape(-1, width)
        if tag == "EDGE2":
            table = table[:, [0, 1, 2, 3, 4, 5, 6, 9, 7, 10, 8]]
        elif tag in ("VERTEX3", "EDGE3"):
            angle = 4 if tag == "VERTEX3" else 5  # behind one id or two, and x y z
            roll, pitch, yaw = (quaternion.exp(table[:, angle + k, None] * np.eye(3)[k]) for k in range(3))
            turned = quaternion.multiply(yaw, quaternion.multiply(pitch, roll))
            information = table[:, angle + 3 :] / (_HALF_ANGLE_PAIRS if tag == "EDGE3" else 1.0)
            table = np.hstack([table[:, :angle], turned, information])
        result.setdefault(same, array("d")).extend(table.ravel())
    return result


def _graph(rows: dict[str, array[float]], path: Path) -> PoseGraph:
    rows = _without_equivalents(_without_toro(rows), path)
    planar = "VERTEX_SE2" in rows or "EDGE_SE2" in rows
    if planar and ("VERTEX_SE3:QUAT" in rows or "EDGE_SE3:QUAT" in rows):
        raise FileFormatError(f"{path} mixes poses of the plane (SE2) and of space (SE3); write two graphs.")
    vertex, edge = ("VERTEX_SE2", "EDGE_SE2") if planar else ("VERTEX_SE3:QUAT", "EDGE_SE3:QUAT")
    vertices, edges = (np.array(rows.get(tag, array("d"))).reshape(-1, _NUMBERS[tag]) for tag in (vertex, edge))
    if not len(vertices) and not len(edges):
        raise FileFormatError(f"{path} holds no poses and no motions; expected lines such as {vertex} and {edge}.")
    width = 3 if planar else 7
    known = _integers(vertices[:, 0], path)
    named = _integers(edges[:, :2].reshape(-1), path)
    chained = len(known) == 0
    ids = np.unique(named) if chained else known
    row_of = {int(name): row for row, name in enumerate(ids)}
    if not chained and not np.isin(named, known).all():
        missing = int(named[~np.isin(named, known)][0])
        raise FileFormatError(f"{path}: a motion names pose {missing}, which has no {vertex} line. Add one.")
    held = np.zeros(len(ids), dtype=bool)
    for name in _integers(np.unique(rows.get("FIX", [])), path).tolist():
        if name not in row_of:
            raise FileFormatError(f"{path}: FIX names pose {name}, which is not there.")
        held[row_of[name]] = True
    if chained:
        poses = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (len(ids), 1))
    else:
        poses = _from_planar(vertices[:, 1:]) if planar else _from_file_order(vertices[:, 1:], vertex, path)
    order = np.argsort(ids, kind="stable")
    index = order[np.searchsorted(ids[order], named)].reshape(-1, 2)
    motion = edges[:, 2 : 2 + width]
    graph = PoseGraph(
        GraphPoses(ids, poses, held),
        Motions(
            index[:, 0],
            index[:, 1],
            _from_planar(motion) if planar else _from_file_order(motion, edge, path),
            _information(edges[:, 2 + width :], planar, named.reshape(-1, 2), path),
        ),
        planar,
    )
    return graph.chained() if chained else graph


def _integers(values: FloatArray, path: Path) -> IntArray:
    wrong = (values != np.floor(values)) | (np.abs(values) >= _ID_LIMIT)
    if wrong.any():
        raise FileFormatError(f"{path}: {values[wrong][0]:g} is not the id of a pose; ids are whole numbers.")
    return values.astype(np.int64)


def _information(upper: FloatArray, planar: bool, between: IntArray, path: Path) -> FloatArray:
    """Return the information (E, 6, 6) in radians from the upper triangles of the file; ``between`` are ids (E, 2)."""
    size = 3 if planar else 6
    small = np.zeros((len(upper), size, size))
    rows, columns = np.triu_indices(size)
    small[:, rows, columns] = small[:, columns, rows] = upper
    eigenvalues = np.linalg.eigvalsh(small)
    indefinite = np.flatnonzero(eigenvalues[:, 0] < -1e-9 * np.abs(eigenvalues).max(axis=1))
    if len(indefinite):
        first, second = between[indefinite[0]].tolist()
        raise FileFormatError(
            f"{path}: the information of {len(indefinite):,} of {counted(len(small), 'motions')} is not positive "
            f"semidefinite, the first from {first} to {second}; no noise is like that. Were rows and columns put in "
            "another order than x, y, z and then the turns, or covariances written? Correct them."
        )
    if not planar:
        return small * (_HALF_ANGLES[:, None] * _HALF_ANGLES)
    full = np.zeros((len(upper), 6, 6))
    full[:, _PLANAR[:, None], _PLANAR] = small
    return full


def _from_file_order(values: FloatArray, tag: str, path: Path) -> FloatArray:
    length = np.linalg.norm(values[:, 3:], axis=1)
    if (length < 1e-3).any():
        raise FileFormatError(f"{path}: {tag} number {int(length.argmin())} has a quaternion of length 0.")
    return np.hstack([G2O.quaternions(values[:, 3:] / length[:, None]), values[:, :3]])


def _file_order(poses: FloatArray) -> FloatArray:
    return poses[:, [4, 5, 6, 0, 1, 2, 3]]


def _from_planar(values: FloatArray) -> FloatArray:
    turn = np.zeros((len(values), 3))
    turn[:, 2] = values[:, 2]
    return np.hstack([quaternion.exp(turn), values[:, :2], np.zeros((len(values), 1))])


def _planar(poses: FloatArray) -> FloatArray:
    return np.column_stack([poses[:, 4], poses[:, 5], 2.0 * np.arctan2(poses[:, 2], poses[:, 3])])


def _join(numbers: Iterable[float]) -> str:
    return " ".join(map(repr, numbers))

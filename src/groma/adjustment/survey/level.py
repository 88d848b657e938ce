# SPDX-License-Identifier: BSD-3-Clause
r"""A scene turned and lifted by known directions and planes.

With directions u of the scene that are v in the world, the rotation of least :math:`\sum \lVert R u_i - v_i\rVert`
(reweighted least squares, so that wrong ones do not count). Where all v are the same, as those of gravity, the turn
about it stays as it is. Of planes alone, three places or more that are on the same one turn the scene, so that most
cameras are on the side of its normal.
"""

from __future__ import annotations

import numpy as np

from groma._typing import FloatArray
from groma.adjustment.survey.similarity import GATES as SIMILARITY
from groma.adjustment.survey.similarity import turn_between
from groma.adjustment.survey.triangulate import triangulated
from groma.errors import InputError
from groma.gates import NORMAL
from groma.geometry import quaternion
from groma.geometry.algebra import unit
from groma.scene import Scene, Similarity
from groma.scene.survey import Kind

#: Axes that files have by mistake, and messages about them.
_OTHER_AXES = {
    "the axes of OpenGL (y up, looking along -z)": np.diag([1.0, -1.0, -1.0]),
    "axes turned by 90 degrees (photographs stored turned?)": np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]),
    "axes turned by -90 degrees (photographs stored turned?)": np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
    "axes turned by 180 degrees (photographs stored upside down?)": np.diag([-1.0, -1.0, 1.0]),
    "x forward, y left, z up (a vehicle or a robot)": np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]),
    "the signs turned (accelerometers measure up)": -np.eye(3),
}


def level(scene: Scene, notes: list[str]) -> Similarity:
    """Return where known directions and planes put a scene; the identity where it holds none.

    Raises
    ------
    InputError
        If directions measured in cameras contradict the poses.
    """
    turned = _by_directions(scene, notes)
    planes = scene.known_planes
    if not len(planes):
        return turned
    places = turned.points(_places(scene))
    usable = np.flatnonzero(np.isfinite(places).all(axis=1))
    if not len(usable):
        return turned
    same = usable[planes.hesse[usable, :3] @ planes.hesse[usable[0], :3] > 1.0 - 1e-9]
    if not len(scene.known_directions) and len(same) >= 3:
        turned = _by_plane(scene, places[same], planes.hesse[same[0], :3], notes).after(turned)
        places = turned.points(_places(scene))
    off = np.einsum("ni,ni->n", places[usable], planes.hesse[usable, :3]) + planes.hesse[usable, 3]
    shift = np.linalg.lstsq(planes.hesse[usable, :3], -off, rcond=1e-9)[0]
    return Similarity(translation=shift).after(turned)


def _by_directions(scene: Scene, notes: list[str]) -> Similarity:
    table = scene.known_directions
    of_images = np.flatnonzero(table.kind == Kind.IMAGE)
    if not len(table):
        return Similarity()
    if len(of_images):
        wanted, seen = table.vector[of_images], _in_world(scene, of_images, np.eye(3))
        rotation = _rotation(seen, wanted)
        _check_axes(scene, of_images, wanted, _median_angle(rotation, seen, wanted))
        down = table.in_camera[of_images][wanted[:, 2] < -0.99, 1:]
        if len(down) and np.median(down, axis=0).min() < -0.5:
            notes.append(
                "In most photographs gravity points to their top, or behind the camera. Accelerometers measure up, and "
                "y is up in OpenGL: turn the signs of the file, unless the cameras hang upside down or look at the sky."
            )
    else:
        wanted, seen = table.vector, _of_landmarks(scene)
        seen = seen * np.sign(np.einsum("ni,ni->n", seen, wanted) + 1e-300)[:, None]
        rotation = _rotation(seen, wanted)
    angle = np.degrees(np.arccos(np.clip((np.trace(rotation) - 1.0) / 2.0, -1.0, 1.0)))
    middle = np.median(scene.cam_centers_in_world, axis=0)
    notes.append(f"The scene was turned by {angle:.3g} degrees to its known directions.")
    return Similarity(1.0, rotation, middle - rotation @ middle)


def _in_world(scene: Scene, rows: np.ndarray, axes: FloatArray) -> FloatArray:
    """Return directions measured in cameras as they are in the world, the cameras' axes being others."""
    table = scene.known_directions
    turn = quaternion.conjugate(scene.cam_from_world[table.idx[rows], :4])
    return quaternion.rotate(turn, table.in_camera[rows] @ axes.T)


def _of_landmarks(scene: Scene) -> FloatArray:
    table = scene.known_directions
    vectors = {
        Kind.LINE: scene.lines.plucker[:, 3:],
        Kind.PLANE: scene.planes.hesse[:, :3],
        Kind.DIRECTION: scene.directions.vectors,
    }
    return np.array([vectors[Kind(kind)][idx] for kind, idx in zip(table.kind, table.idx, strict=True)])


def _rotation(seen: FloatArray, wanted: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) that takes unit vectors (N, 3) to others, as most of them agree."""
    rotation, new, weight = np.eye(3), np.eye(3), np.ones(len(seen))
    for _ in range(50):
        cross = np.einsum("n,ni,nj->ij", weight, wanted, seen)
        U, size, Vt = np.linalg.svd(cross)
        if size[1] <= 1e-6 * size[0] or np.linalg.matrix_rank(wanted, 1e-6) == 1:
            first = unit((weight[:, None] * seen).sum(axis=0))
            new = turn_between(first, unit((weight[:, None] * wanted).sum(axis=0)))
        else:
            new = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        away = np.linalg.norm(seen @ new.T - wanted, axis=1)
        weight = 1.0 / np.maximum(away, 1e-3)
        if np.abs(new - rotation).max() < 1e-9:
            break
        rotation = new
    return new


def _median_angle(rotation: FloatArray, seen: FloatArray, wanted: FloatArray) -> float:
    return float(np.degrees(np.median(np.arccos(np.clip(np.einsum("ni,ni->n", seen @ rotation.T, wanted), -1, 1)))))


def check_directions(scene: Scene, rotation: FloatArray) -> None:
    """Refuse directions measured in cameras that contradict the poses of a scene which places turn.

    Raises
    ------
    InputError
        With the axes that fit, if there are some.
    """
    table = scene.known_directions
    rows = np.flatnonzero(table.kind == Kind.IMAGE)
    if len(rows):
        seen = _in_world(scene, rows, np.eye(3))
        _check_axes(scene, rows, table.vector[rows], _median_angle(rotation, seen, table.vector[rows]), rotation)


def _check_axes(
    scene: Scene, rows: np.ndarray, wanted: FloatArray, apart: float, rotation: FloatArray | None = None
) -> None:
    """Refuse directions in cameras that contradict each other at the poses of the scene, turned freely or as given."""
    noise = float(np.degrees(np.median(scene.known_directions.sigma[rows])))
    if apart <= max(SIMILARITY.apart_deg, NORMAL.far * noise):
        return
    angles = {}
    for words, axes in _OTHER_AXES.items():
        seen = _in_world(scene, rows, axes)
        angles[words] = _median_angle(_rotation(seen, wanted) if rotation is None else rotation, seen, wanted)
    best = min(angles, key=lambda words: angles[words])
    fitting = " or ".join(words for words, angle in angles.items() if angle <= angles[best] + noise)
    hint = f" With {fitting} it is {angles[best]:.2g}." if angles[best] * SIMILARITY.better < apart else ""
    raise InputError(
        f"The directions measured in the photographs contradict their poses: most are off by {apart:.0f} degrees or "
        f"more.{hint} Expected are the axes of the camera: x right, y down, z forward."
    )


def _by_plane(scene: Scene, places: FloatArray, normal: FloatArray, notes: list[str]) -> Similarity:
    """Return the turn that brings places on one plane into it, most cameras on the side of its normal."""
    middle = places.mean(axis=0)
    sizes, axes = np.linalg.svd(places - middle)[1:]
    if sizes[1] <= 1e-6 * sizes[0]:
        return Similarity()
    side = np.median((scene.cam_centers_in_world - middle) @ axes[2])
    rotation = turn_between(axes[2] if side >= 0.0 else -axes[2], normal)
    notes.append("The scene was turned into its known plane, most cameras on the side of its normal.")
    return Similarity(1.0, rotation, middle - rotation @ middle)


def _places(scene: Scene) -> FloatArray:
    """Return the places (N, 3) that are on known planes, NaN where two marks do not meet."""
    table = scene.known_planes
    points, _ = triangulated(scene, scene.marks, len(scene.control_points))
    found = table.anchor.copy()
    for kind, places in ((Kind.IMAGE, scene.cam_centers_in_world), (Kind.CONTROL_POINT, points)):
        rows = np.flatnonzero(table.kind == kind)
        found[rows] = places[table.idx[rows]]
    return found

# SPDX-License-Identifier: BSD-3-Clause
r"""What happens to a factor when the whole world moves, :math:`X \mapsto s\,R\,X + t`, and measurements stay."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray
from groma.factors.contract import Invariance, Slot
from groma.geometry import quaternion, sim3, so3
from groma.geometry.manifold import AMBIENT_SIZE

Ambients = tuple[FloatArray, ...]


@dataclass(frozen=True)
class WorldMotion:
    """A motion of the world, and whether a factor promises not to notice."""

    name: str
    promised: bool
    rotation: FloatArray
    translation: FloatArray
    scale: float = 1.0


def motions_of(invariance: Invariance, rng: np.random.Generator) -> Iterator[WorldMotion]:
    """Yield a motion of each kind; a scaling only where it is promised to go unnoticed."""
    still, nowhere = np.eye(3), np.zeros(3)
    turned = invariance.rotation
    yield WorldMotion("a translation", invariance.translation, still, rng.uniform(0.3, 0.6, 3))
    yield WorldMotion("a rotation", turned is True, so3.exp(rng.uniform(0.4, 0.8, (1, 3)))[0], nowhere)
    if not isinstance(turned, bool):
        axis = np.asarray(turned, np.float64) / np.linalg.norm(turned)
        yield WorldMotion(f"a rotation about {turned}", True, so3.exp(0.7 * axis[None])[0], nowhere)
    if invariance.scale:
        yield WorldMotion("a scaling", True, still, nowhere, 1.7)


def moved_world(slots: list[Slot], ambients: Ambients, motion: WorldMotion) -> Ambients:
    """Return what factors read after the world has moved."""
    return tuple(_moved(slot, ambient, motion) for slot, ambient in zip(slots, ambients, strict=True))


def _moved(slot: Slot, ambient: FloatArray, motion: WorldMotion) -> FloatArray:
    R, t, s = motion.rotation, motion.translation, motion.scale
    if slot.kind == "pose":
        pose = ambient.reshape(-1, 3, 4).copy()
        pose[:, :, 3] *= s
        if slot.in_world:
            pose[:, :, :3] = pose[:, :, :3] @ R.T
            pose[:, :, 3] -= pose[:, :, :3] @ t
        return pose.reshape(-1, 12)
    if slot.kind == "similarity":
        back = sim3.inverse(np.concatenate([quaternion.from_matrix(R), t, [s]]))
        return sim3.compose(ambient, back) if slot.in_world else ambient
    if slot.kind not in AMBIENT_SIZE or not slot.in_world:
        return ambient
    first = ambient[:, :3] @ R.T
    if slot.kind == "point":
        return s * first + t
    if slot.kind == "line":
        direction = ambient[:, 3:] @ R.T
        return np.hstack([s * first + np.cross(t, direction), direction])
    if slot.kind == "plane":
        return np.column_stack([first, s * ambient[:, 3] - first @ t])
    return first  # a direction


def lives_in_the_world(slots: list[Slot]) -> bool:
    """Whether any variable moves with the world."""
    return any(slot.in_world and slot.kind in AMBIENT_SIZE for slot in slots)


def check_invariance(
    name: str,
    invariance: Invariance,
    slots: list[Slot],
    ambients: Ambients,
    residuals: Callable[[Ambients], FloatArray],
    rng: np.random.Generator,
) -> None:
    """Check that residuals stay the same under the motions that a factor declares, and change under the others.

    Without a camera among the variables a residual may be a vector in the world, which turns with it and scales: then
    lengths are compared.

    Raises
    ------
    AssertionError
        If the declaration is wrong.
    """
    if not lives_in_the_world(slots):
        return
    in_camera = any(slot.kind in ("pose", "similarity") for slot in slots)
    before = residuals(ambients)
    for motion in motions_of(invariance, rng):
        after = residuals(moved_world(slots, ambients, motion))
        pair = (before, after) if in_camera else (np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1))
        same = bool(np.allclose(*pair, rtol=1e-9, atol=1e-10 * max(1.0, np.abs(pair[0]).max(initial=0.0))))
        if same != motion.promised:
            raise AssertionError(
                f"Factor {name!r} declares {invariance}, but {motion.name} of the world "
                f"{'leaves its residuals as they are' if same else 'changes its residuals'}:\n{before}\n{after}\n"
                "Correct the class variable `invariance`, or mark slots that do not move with the world "
                "(Slot(..., in_world=False))."
            )

# SPDX-License-Identifier: BSD-3-Clause
"""Numbers that no solve can use, refused where a problem is made: the message names factor, row and slot.

A factor with a measurement that is not a number cannot be evaluated; it would be left out in silence, and a problem of
such factors alone would have no cost and seem solved. A camera with a focal length of zero or less has no image.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from groma._typing import BoolArray, FloatArray
from groma.cameras import CameraModel
from groma.errors import ProblemError
from groma.factors.contract import Factor
from groma.problem.variables import Variables


def refuse_unusable_numbers(factor: Factor, variables: Mapping[str, Variables]) -> None:
    """Raise ProblemError if a measurement or its noise is not finite, or a focal length or size not positive."""
    for field in dataclasses.fields(factor):
        value = getattr(factor, field.name)
        if isinstance(value, np.ndarray | float) and np.asarray(value).dtype.kind == "f":
            _refuse_infinite(factor, field.name, np.asarray(value))
    for slot, ref in factor.references():
        if slot.kind == "intrinsics" and len(ref.index):
            _refuse_focal_lengths(factor, slot.name, ref.group, variables[ref.group].ambient())


def _refuse_infinite(factor: Factor, field: str, values: FloatArray) -> None:
    if np.isfinite(values.sum()):  # a sum is not finite if a part is not; large parts may overflow, so check again
        return
    bad: BoolArray = ~np.isfinite(values)
    if not bad.any():
        return
    name = factor.type_name or type(factor).__name__
    row = 0 if values.ndim == 0 else int(np.argwhere(bad)[0, 0])
    number = values if values.ndim == 0 else values[row]
    slots = ", ".join(f"{slot.name} -> {ref.group} {ref.index[row]}" for slot, ref in factor.references())
    raise ProblemError(
        f"Factor {row} of {name!r} needs finite numbers; its {field} is {number.tolist()} ({slots}). "
        "Drop the factor, or repair the measurement."
    )


def _refuse_focal_lengths(factor: Factor, slot: str, group: str, parameters: FloatArray) -> None:
    model = getattr(factor, "camera_model", None)
    if not isinstance(model, CameraModel):
        return
    focals = parameters[:, [*model.focal_indices, *model.known_indices]]
    if (focals > 0.0).all():
        return
    bad = int(np.argwhere(~(focals > 0.0))[0, 0])
    row = int(np.argmax({s.name: r for s, r in factor.references()}[slot].index == bad))
    what, whole = ("focal lengths", "focal length") if model.is_planar else ("width and height", "size")
    raise ProblemError(
        f"Slot {slot!r} of factor {factor.type_name!r} needs positive {what}; those of variable {bad} of group "
        f"{group!r} ({model.name}) are {focals[bad].tolist()} (factor {row}). "
        f"Give the camera its {whole} in pixels."
    )

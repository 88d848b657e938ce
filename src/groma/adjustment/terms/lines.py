# SPDX-License-Identifier: BSD-3-Clause
r"""Lines seen as segments, compared in one of three ways.

``endpoints``: the distances of the segment's ends from the image of the line, pixels. It needs an image without
distortion; in other images segments are compared as ``bearing`` does.

``bearing``: the sines of the angles between the rays of the two ends and the plane through camera and line.

``normal``: the normal of the plane through camera and segment against the line's direction, and against the ray to its
*anchor*, its point nearest to the origin of the world (:mod:`groma.factors.observations.line_normal`). What these two
sines say depends on where the anchor is. So that the noise stays that of the ends, they are multiplied by the inverse
of the matrix that takes errors :math:`e_1, e_2` of the ends across the segment into them, at the start: with rays
:math:`f_1, f_2` at the angle :math:`\theta`, the unit normal n of their plane, the line's direction x and the direction
v from its anchor to the camera,

.. math:: \frac{1}{\sin\theta} \begin{bmatrix} (n \times f_2)\cdot x & (f_1 \times n)\cdot x \\
          (n \times f_2)\cdot v & (f_1 \times n)\cdot v \end{bmatrix}
          \begin{bmatrix} 1/s_1 & 0 \\ 0 & 1/s_2 \end{bmatrix}

where :math:`s_i` pixels across the segment are a radian at its ends: by these ``bearing`` is weighted, too.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from groma._counted import counted
from groma._typing import BoolArray, FloatArray, IntArray
from groma.adjustment.terms.contract import Draft, Group, Term
from groma.adjustment.terms.readout import line_refs
from groma.cameras import model as camera_model
from groma.cameras.across import pixels_across
from groma.errors import InputError
from groma.factors.contract import Ref
from groma.factors.observations.line_bearing import LineBearing
from groma.factors.observations.line_normal import LineNormal
from groma.factors.observations.line_reprojection import LineReprojection
from groma.factors.observations.line_unprojection import LineUnprojection
from groma.geometry import quaternion
from groma.geometry.algebra import unit

#: Segments for which the sine of the angle between their line and the ray to its anchor is smaller are left out of
#: ``normal``: both parts of the residual are then the same.
MIN_SINE = 1e-3
#: Types of the factors of segments.
LINE_FACTORS = ("line_reprojection", "line_bearing", "line_unprojection", "line_normal")


def line_sigma_px(draft: Draft) -> FloatArray:
    """Standard deviations (N,) of the places at which segments are measured, across them, pixels."""
    options = draft.options
    return options.line_sigma_px * np.sqrt(1.0 + options.line_end_correlation) * draft.scene.line_observations.sigma


def _factors(draft: Draft) -> Iterator[Group]:
    table, options = draft.scene.line_observations, draft.options
    sigma, lines = line_sigma_px(draft), draft.scene.lines.plucker
    for name, rows, camera in draft.by_camera(table.image_idx):
        if options.line_residual == "endpoints" and camera_model(name).has_pinhole_parameters:
            places = _nearer(table.segment[rows, :2], table.segment[rows, 2:], options.reach)
            factor = LineReprojection(
                line=Ref("lines", table.line_idx[rows]),
                segments=np.hstack(places),
                sqrt_information=1.0 / sigma[rows],
                loss=draft.line_loss,
                **camera,
                **line_refs(draft, name, table.image_idx[rows], lines[table.line_idx[rows]], places),
            )
            yield Group(factor, observes="lines")
            continue
        rays = _rays(draft, name, rows)
        make = _normals if options.line_residual == "normal" else _sines
        yield make(draft, rays, sigma[rays.rows])


@dataclass(frozen=True)
class _Rays:
    """The rays (n, 3) of the two places where segments are measured, their rows, and the pixels of a radian across."""

    #: Name of their camera model.
    model: str
    rows: IntArray
    first: FloatArray
    second: FloatArray
    #: (n,) focal lengths, or (n, 2) at the two places.
    pixels: FloatArray


def _rays(draft: Draft, name: str, rows: IntArray) -> _Rays:
    table, model, reach = draft.scene.line_observations, camera_model(name), draft.options.reach
    params = draft.params(name, table.image_idx[rows])
    first = model.unproject(params, table.segment[rows, :2])
    second = model.unproject(params, table.segment[rows, 2:])
    good = np.isfinite(first).all(axis=1) & np.isfinite(second).all(axis=1)
    if not good.all():
        outside = counted(int((~good).sum()), "segments")
        draft.notes.append(f"Left out: {outside} outside the range of the {name} model.")
    first, second = _nearer(first[good], second[good], reach)
    if reach != 1.0:
        first, second = unit(first), unit(second)
    pixels = model.focal_length(params[good])
    if draft.options.line_residual != "endpoints" or model.sees_behind:
        pixels = pixels_across(model, params[good], first, second)
    return _Rays(name, rows[good], first, second, pixels)


def _sines(draft: Draft, rays: _Rays, sigma: FloatArray) -> Group:
    table, lines, places = draft.scene.line_observations, draft.scene.lines.plucker, _places(draft, rays.rows)
    both = rays.pixels.ndim == 2
    pixels = rays.pixels[:, :, None] * np.eye(2) if both else rays.pixels
    image_idx, line_idx = table.image_idx[rays.rows], table.line_idx[rays.rows]
    follows = len(rays.rows) > 0 and not draft.variables[f"intrinsics/{rays.model}"].is_constant
    if follows and camera_model(rays.model).is_planar:
        focal = camera_model(rays.model).focal_length(draft.params(rays.model, image_idx))
        pixels = pixels / (focal[:, None, None] if both else focal)
    common: dict[str, Any] = {
        "line": Ref("lines", line_idx),
        "sqrt_information": pixels / (sigma[:, None, None] if both else sigma),
        "loss": draft.line_loss,
        **line_refs(draft, rays.model, image_idx, lines[line_idx], places),
    }
    factor: LineBearing | LineUnprojection
    if follows:
        camera = next(camera for _, _, camera in draft.by_camera(image_idx))
        factor = LineUnprojection(segments=np.hstack(places), **camera, **common)
    else:
        refs = draft.camera_refs(image_idx)
        factor = LineBearing(start_bearings=rays.first, end_bearings=rays.second, **refs, **common)
    return Group(factor, observes="lines", pixels_of_residual=pixels)


def _places(draft: Draft, rows: IntArray) -> tuple[FloatArray, FloatArray]:
    """The two places (n, 2) in the image at which segments are measured."""
    segments = draft.scene.line_observations.segment[rows]
    return _nearer(segments[:, :2], segments[:, 2:], draft.options.reach)


def _normals(draft: Draft, rays: _Rays, sigma: FloatArray) -> Group:
    scene, table = draft.scene, draft.scene.line_observations
    if not draft.variables[f"intrinsics/{rays.model}"].is_constant:
        draft.notes.append(
            "With line_residual='normal' segments are rays of the calibration at the start: they hold it, and standard "
            "deviations come out too small. Use endpoints or bearing."
        )
    if len(scene.camera_motions):
        raise InputError("line_residual='normal' knows no rolling shutter. Use endpoints or bearing.")
    first, second = unit(rays.first), unit(rays.second)
    across = np.cross(first, second)
    sine = np.linalg.norm(across, axis=1)
    normal = across / np.maximum(sine, 1e-300)[:, None]
    poses, plucker = scene.cam_from_world[table.image_idx[rays.rows]], scene.lines.plucker[table.line_idx[rays.rows]]
    direction = quaternion.rotate(poses[:, :4], plucker[:, 3:])
    anchor = quaternion.rotate(poses[:, :4], np.cross(plucker[:, 3:], plucker[:, :3])) + poses[:, 4:]
    good: BoolArray = np.abs(np.einsum("ni,ni->n", np.cross(direction, unit(anchor)), normal)) > MIN_SINE
    if not good.all():
        draft.notes.append(f"Left out: {counted(int((~good).sum()), 'segments')} seen along the ray to their anchor.")
    ends = np.stack([np.cross(normal, second), np.cross(first, normal)], axis=-1)
    against = np.stack([direction, -unit(anchor)], axis=1)
    residual_of_ends = (against @ ends) / (sine[:, None] * rays.pixels)[:, None, :]
    ends_of_residual = np.linalg.inv(residual_of_ends[good])
    rows = rays.rows[good]
    factor = LineNormal(
        line=Ref("lines", table.line_idx[rows]),
        normals=normal[good],
        sqrt_information=ends_of_residual / sigma[good, None, None],
        loss=draft.line_loss,
        **draft.camera_refs(table.image_idx[rows]),
    )
    return Group(factor, observes="lines", pixels_of_residual=ends_of_residual)


def _nearer(first: FloatArray, second: FloatArray, reach: float) -> tuple[FloatArray, FloatArray]:
    """The two places on segments that are so far from their middles, in half lengths."""
    if reach == 1.0:
        return first, second
    middle, half = 0.5 * (first + second), 0.5 * reach * (second - first)
    return middle - half, middle + half


TERM = Term("line observations", ("line_observations",), ("lines",), _factors)

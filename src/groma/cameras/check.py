# SPDX-License-Identifier: BSD-3-Clause
"""The conformance check of camera models, public as :func:`groma.testing.check_camera`."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from groma._typing import FloatArray
from groma.cameras.contract import CameraModel

#: Step of the central differences, relative to the size of what is moved. The error of the difference itself is of
#: the order of the step squared plus rounding over the step: about 1e-10 of the function's size.
STEP = 1e-5
#: Largest allowed difference of a derivative, relative to the largest entry of its row.
DERIVATIVE_TOLERANCE = 1e-7
#: Largest allowed distance after going there and back, in pixels.
ROUND_TRIP_TOLERANCE = 1e-9


def check_camera(
    model: CameraModel, params: FloatArray, rng: np.random.Generator, half_angle: float = 0.6, count: int = 50
) -> None:
    r"""Check that a camera model keeps its promises at random points.

    1. :math:`\mathrm{project}(\lambda X) = \mathrm{project}(X)` for :math:`\lambda > 0`.
    2. The derivatives by point and parameters equal central differences, and :math:`J_X X = 0`.
    3. :math:`\mathrm{project}(\mathrm{unproject}(u)) = u` and :math:`\mathrm{unproject}(\mathrm{project}(X)) = X/|X|`.
    4. The camera centre, and points with a coordinate that is not finite, have no image: NaN, not garbage.
    5. One row of parameters and a row per point give the same.

    Parameters
    ----------
    model : CameraModel
        The model.
    params : (k,) float64
        Typical parameters, distortion included.
    rng : numpy.random.Generator
        Source of the random points.
    half_angle : float
        Largest angle between a point and the optical axis in radians. The distortion must be monotone up to it.
    count : int
        Number of points.

    Raises
    ------
    AssertionError
        If a promise is broken; the message names it, the point and both values.
    """
    params = model.check_parameters(params)[0]
    points = _points_in_cone(rng, half_angle, count)
    pixels, by_point, _ = model.project_jacobian(params, points)
    _near(pixels, model.project(params, points), 1e-10, f"{model.name}: project_jacobian and project", points)
    _near(pixels, model.project(params, 3.0 * points), ROUND_TRIP_TOLERANCE, f"{model.name}: scale of points", points)

    in_rows = model.project(np.tile(params, (count, 1)), points)
    _near(pixels, in_rows, 1e-10, f"{model.name}: a row of parameters per point", points)
    for name, value, numeric in _derivatives(model, params, points):
        _near(value, numeric, DERIVATIVE_TOLERANCE, f"{model.name}: derivative by the {name}", points)
    size = np.abs(by_point).max() * np.abs(points).max()
    _near(np.einsum("nij,nj->ni", by_point, points) / size, 0.0, 1e-12, f"{model.name}: J X = 0", points)

    bearings = model.unproject(params, pixels)
    directions = points / np.linalg.norm(points, axis=1, keepdims=True)
    _near(bearings, directions, 1e-10, f"{model.name}: unproject(project(X)) and X / |X|", points)
    _near(model.project(params, bearings), pixels, ROUND_TRIP_TOLERANCE, f"{model.name}: project(unproject(u))", points)

    nowhere = np.array([[0.0, 0.0, 0.0], [np.nan, 0.1, 1.0], [0.1, np.inf, 1.0], [0.1, 0.1, np.nan], [0.0, 0.0, -0.0]])
    for result in (model.project(params, nowhere), *model.project_jacobian(params, nowhere)):
        if not np.isnan(result).all():
            raise AssertionError(f"{model.name}: points without image must give NaN; got {result}.")
    if not np.isnan(model.unproject(params, np.array([[np.nan, 1.0], [1.0, np.inf]]))).all():
        raise AssertionError(f"{model.name}: pixels that are not finite must have no bearing.")


def derivative_errors(model: CameraModel, rng: np.random.Generator, count: int = 50) -> dict[str, float]:
    """Return the largest errors of the derivatives by ``point`` and ``parameters``, divided by the tolerance.

    At random points in front of a camera with a little distortion: 0.01 for each of its coefficients.
    """
    params = np.full(model.num_parameters, 0.01)
    params[[*model.focal_indices, *model.principal_point_indices, *model.known_indices]] = 500.0
    derivatives = _derivatives(model, params, _points_in_cone(rng, 0.6, count))
    return {name: float(np.abs(value - numeric).max()) / DERIVATIVE_TOLERANCE for name, value, numeric in derivatives}


def _derivatives(
    model: CameraModel, params: FloatArray, points: FloatArray
) -> Iterator[tuple[str, FloatArray, FloatArray]]:
    """Yield what is moved, the derivative and the numeric one, both over the largest entry of each row."""
    _, by_point, by_params = model.project_jacobian(params, points)
    by_point_numeric = _central_differences(lambda moved: model.project(params, moved), points)
    rows = np.tile(params, (len(points), 1))
    by_params_numeric = _central_differences(lambda moved: model.project(moved, points), rows)
    for name, value, numeric in (("point", by_point, by_point_numeric), ("parameters", by_params, by_params_numeric)):
        scale = np.abs(numeric).max(axis=2, keepdims=True) + 1e-3
        yield name, value / scale, numeric / scale


def _points_in_cone(rng: np.random.Generator, half_angle: float, count: int) -> FloatArray:
    """Points in front of the camera; the first two on the optical axis and next to it, the last at the rim."""
    theta = half_angle * np.sqrt(rng.uniform(size=count))
    theta[:2], theta[-1] = (0.0, 1e-9), half_angle
    around, depth = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(0.5, 5.0, count)
    sine = np.sin(theta)
    return depth[:, None] * np.stack([sine * np.cos(around), sine * np.sin(around), np.cos(theta)], axis=1)


def _central_differences(function: Callable[[FloatArray], FloatArray], argument: FloatArray) -> FloatArray:
    """Derivative (N, 2, columns) of ``function`` by the columns of ``argument`` (N, columns)."""
    columns = []
    for j in range(argument.shape[1]):
        step = np.zeros_like(argument)
        step[:, j] = STEP * np.maximum(1.0, np.abs(argument[:, j]))
        columns.append((function(argument + step) - function(argument - step)) / (2.0 * step[:, j : j + 1]))
    return np.stack(columns, axis=-1)


def _near(value: FloatArray, expected: FloatArray | float, tolerance: float, what: str, points: FloatArray) -> None:
    difference = np.abs(value - expected)
    if not (difference <= tolerance).all():
        row = int(np.argmax(np.where(np.isnan(difference), np.inf, difference).reshape(len(points), -1).max(axis=1)))
        raise AssertionError(
            f"{what} differ by {difference[row].max():.3g} (allowed {tolerance:g}) at the point {points[row]}:\n"
            f"{value[row]}\nagainst\n{np.broadcast_to(expected, np.shape(value))[row]}"
        )

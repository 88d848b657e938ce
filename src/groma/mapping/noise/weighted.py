# SPDX-License-Identifier: BSD-3-Clause
"""Adjusting a scene whose observations are weighted by the noise that their residuals show.

Standard deviations of observations in images are relative to a common one, which no file holds. Residuals tell it, in
any frame of the scene.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from groma.adjustment.adjust import AdjustOptions, adjust
from groma.adjustment.report import AdjustResult, Progress
from groma.adjustment.rolling_shutter import GATES as SETTLING
from groma.errors import given_or_default
from groma.mapping.noise.observations import noise_px
from groma.scene import Scene


def weighted(scene: Scene, options: AdjustOptions) -> AdjustOptions:
    """Return the options with the noise that the observations of a scene show."""
    sigma = {}
    if options.points and scene.num_point_observations:
        sigma["point_sigma_px"] = noise_px(scene, "points")
    if options.lines and scene.num_line_observations:
        sigma["line_sigma_px"] = noise_px(scene, "lines")
    return replace(options, **sigma)


def adjust_weighted(
    scene: Scene, options: AdjustOptions | None = None, progress: Callable[[Progress], bool | None] | None = None
) -> tuple[AdjustResult, AdjustOptions]:
    """Adjust a scene with the noise that its residuals show in the end; return the options with it, too.

    As :func:`groma.adjust`, but ``point_sigma_px`` and ``line_sigma_px`` are estimated: before, and where residuals
    shrink much, once more.
    """
    chosen = weighted(scene, given_or_default(options, AdjustOptions))
    result = adjust(scene, chosen, progress)
    for _ in range(SETTLING.max_rounds - 1):
        better = weighted(result.scene, chosen)
        ratios = better.point_sigma_px / chosen.point_sigma_px, better.line_sigma_px / chosen.line_sigma_px
        if all(1.0 / SETTLING.settled <= ratio <= SETTLING.settled for ratio in ratios):
            break
        chosen = better
        result = adjust(scene, chosen, progress)
    return result, chosen

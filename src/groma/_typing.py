# SPDX-License-Identifier: BSD-3-Clause
"""Array types and the letters used for shapes in docstrings.

Shape letters: ``N`` observations, ``C`` cameras or images, ``P`` points, ``L`` lines, ``K`` planes, ``M`` residual
rows, ``...`` any leading batch axes.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
IntArray = npt.NDArray[np.integer]
BoolArray = npt.NDArray[np.bool_]

#: What factors are linearised from, one array for each slot (of a camera model also its tag); and where the columns of
#: each slot begin in a record, -1 for variables that are held.
Inputs: TypeAlias = tuple[Any, ...]
Columns: TypeAlias = tuple[int, ...]

# SPDX-License-Identifier: BSD-3-Clause
"""Arrays as text in a page."""

from __future__ import annotations

import base64
import json
from typing import Any

import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray, IntArray


def pack(values: FloatArray) -> str:
    """Return numbers as base64 of single precision; non-finite ones become zero."""
    finite = np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0)
    return base64.b64encode(np.ascontiguousarray(finite, dtype="<f4").tobytes()).decode()


def pack_whole(values: IntArray) -> str:
    """Return whole numbers as base64 of four bytes each."""
    return base64.b64encode(np.ascontiguousarray(values, dtype="<i4").tobytes()).decode()


def pack_bytes(values: npt.NDArray[np.uint8]) -> str:
    """Return small whole numbers as base64."""
    return base64.b64encode(np.ascontiguousarray(values, dtype=np.uint8).tobytes()).decode()


def thin(count: int, limit: int) -> IntArray:
    """Return at most ``limit`` of the numbers below ``count``, evenly spaced."""
    return np.arange(count) if count <= limit else np.linspace(0, count - 1, limit).astype(np.int64)


def script_json(content: dict[str, Any]) -> str:
    """Return JSON that cannot close a script element or open a comment."""
    return json.dumps(content, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")

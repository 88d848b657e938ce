# SPDX-License-Identifier: BSD-3-Clause
"""Target: a network in an ONNX file that finds segments. It needs onnxruntime; without it there is none.

The file is written here, field by field, as protocol buffers are; the network answers with the mean of each pixel's
colours as score, and that, back and forth, as offsets of the two ends.
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from _targets import Made

from groma.features.onnx_segments import OnnxDetector

SIZE = 16
_FLOAT, _INT, _INTS = 1, 2, 7
PICTURE = np.random.default_rng(3).integers(0, 255, (24, 32)).astype(np.uint8)


def _number(value: int) -> bytes:
    """Return a number in groups of seven bits."""
    groups = []
    while value > 0x7F:
        groups.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*groups, value])


def _field(number: int, value: int | str | bytes) -> bytes:
    """Return a field of a message: a number, or what has a length."""
    if isinstance(value, int):
        return _number(number << 3) + _number(value)
    content = value.encode() if isinstance(value, str) else value
    return _number(number << 3 | 2) + _number(len(content)) + content


def _tensor(name: str, shape: tuple[int, ...]) -> bytes:
    sizes = b"".join(_field(1, _field(1, size)) for size in shape)
    return _field(1, name) + _field(2, _field(1, _field(1, _FLOAT) + _field(2, sizes)))


def _node(kind: str, inputs: tuple[str, ...], output: str, attributes: bytes) -> bytes:
    return b"".join(_field(1, name) for name in inputs) + _field(2, output) + _field(4, kind) + attributes


def network(size: int = SIZE) -> bytes:
    """Return the file of a network of the form of M-LSD, for square images."""
    axes = _field(5, _field(1, "axes") + _field(8, 3) + _field(20, _INTS))
    axis = _field(5, _field(1, "axis") + _field(3, 3) + _field(20, _INT))
    graph = [
        _field(1, _node("ReduceMean", ("image",), "scores", axes)),
        _field(1, _node("Neg", ("scores",), "back", b"")),
        _field(1, _node("Concat", ("back", "back", "scores", "scores"), "offsets", axis)),
        _field(2, "segments"),
        _field(11, _tensor("image", (1, size, size, 3))),
        _field(12, _tensor("scores", (1, size, size, 1))),
        _field(12, _tensor("offsets", (1, size, size, 4))),
    ]
    return _field(1, 7) + _field(7, b"".join(graph)) + _field(8, _field(2, 11))


def made(home: Path) -> Iterator[Made]:
    """Yield the target, where onnxruntime is installed."""
    if find_spec("onnxruntime") is not None:
        yield "onnx_network", {"n.onnx": network()}, _segments


def _segments(folder: Path) -> object:
    return OnnxDetector(str(folder / "n.onnx"), min_length=1.0, min_strength=0.0).detect(PICTURE)

# SPDX-License-Identifier: BSD-3-Clause
r"""Segments by a neural network in an ONNX file, of the form of M-LSD, then fitted to the grey levels.

In comes an image; it is cut into overlapping tiles of about the size that the network takes. Out of the network come
for every cell of a coarse grid a score and the offsets of two ends, in cells,

.. math:: p_k = (c + \tfrac12 + o_k)\, s, \qquad k = 1, 2,

with s pixels a cell: input (1, H, W, 3 or 4), outputs (1, h, w, 1) and (1, h, w, 4), the maxima kept by the network
itself. Its ends are good to some pixels. Each segment is moved across itself to the strongest edge nearby, measured
there like those of every detector (:mod:`groma.features.edge_fit`), joined with collinear neighbours, and left out
where a longer one covers it.

References
----------
G. Gu et al., *Towards Light-weight and Real-time Line Segment Detection*, AAAI 2022, section 3.1.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from groma._typing import BoolArray, FloatArray
from groma.errors import InputError
from groma.features.edge_fit import EDGES, measure_edges
from groma.features.images import MIN_SIDE, GrayImage, to_gray
from groma.features.merging import merge_collinear
from groma.features.segments import MIN_LENGTH, MIN_STRENGTH, Segments
from groma.gates import gate

#: Largest file of a network, bytes (cost: memory).
_LARGEST = 1 << 28
_FORM = "input (1, H, W, 3 or 4), outputs (1, h, w, 1) and (1, h, w, 4), all float32, as M-LSD has them"


@dataclass(frozen=True)
class NetworkGates:
    """What is taken from the network, and where its edges are looked for."""

    min_score: float = gate(0.1, "1", "score of a cell that has a segment", "convention: that of M-LSD's runtime")
    max_scale: float = gate(1.25, "ratio", "pixels of the image in one of the network, before it is cut into tiles",
                            "cost: time grows with the number of tiles")  # fmt: skip
    overlap: float = gate(0.1, "share", "of a tile that its neighbours see, too", "convention: a tenth")
    shifts: tuple[float, ...] = gate(
        (2.5, 5.0), "px", "to either side of a segment, where an edge is looked for too",
        "derived from cells of two pixels, and tiles reduced by up to 1.25",
    )  # fmt: skip
    same: float = gate(1.5, "px", "of the ends of a segment from a longer one on it", "derived from edges a pixel wide")
    largest: int = gate(1 << 22, "pixels", "of the network's input", "cost: 100 bytes for each; M-LSD has 1 << 18")
    covered: float = gate(0.8, "share", "of a segment that a longer one covers, for it to go", "convention: most of it")


NETWORK = NetworkGates()


@dataclass(frozen=True)
class OnnxDetector:
    """Segments by a network in a file; onnxruntime runs it on the processor."""

    #: The ONNX file.
    file: str
    #: Shortest segment, pixels.
    min_length: float = MIN_LENGTH
    #: Smallest mean gradient across a segment, grey levels (of 255) per pixel.
    min_strength: float = MIN_STRENGTH
    #: Maximum number of segments, the longest; 0: all.
    max_segments: int = 0
    #: Hash of the content of the file, so that results are not taken for those of another one.
    content: str = field(init=False, default="")

    def __post_init__(self) -> None:
        if not (np.isfinite(self.min_length) and self.min_length > 0.0):
            raise InputError(f"min_length must be positive, in pixels; got {self.min_length}. The default is 20.")
        path = Path(self.file)
        try:
            size = path.stat().st_size
            if size > _LARGEST:
                raise InputError(f"{path} has {size} bytes; expected an ONNX file of at most {_LARGEST}.")
            content = hashlib.sha256(path.read_bytes()).hexdigest()
        except OSError as error:
            raise InputError(f"Cannot read {path}: {error.strerror or error}. Check the path.") from error
        object.__setattr__(self, "content", content)
        _network(self.file, content)

    def detect(self, image: npt.NDArray[np.generic]) -> Segments:
        """Segments of an image (H, W) or (H, W, 3), 8 bit, longest first."""
        gray = to_gray(image)
        if min(gray.shape) < MIN_SIDE or gray.min() == gray.max():
            return Segments.empty()
        network = _network(self.file, self.content)
        rough = [network.segments(gray, tile) for tile in _tiles(gray.shape, network.size)]
        ends, sigma, strength = _on_edges(gray, np.concatenate(rough))
        merged = merge_collinear(ends)
        if len(merged) < len(ends):
            ends, sigma, strength = measure_edges(gray, merged)
        found = Segments.ranked(ends, sigma, strength, gray.shape, self.min_length, self.min_strength)
        rows = np.flatnonzero(~covered(found.ends))
        return found.select(rows[: self.max_segments or len(rows)])


def covered(ends: FloatArray) -> BoolArray:
    """Tell which segments (N, 4), the longest first, lie on an earlier one that covers most of them."""
    start, way = ends[:, :2], ends[:, 2:] - ends[:, :2]
    length = np.maximum(np.linalg.norm(way, axis=1), 1e-9)
    along = way / length[:, None]
    across = np.column_stack([along[:, 1], -along[:, 0]])
    far, at = np.zeros((len(ends), len(ends))), []
    for end in (ends[:, :2], ends[:, 2:]):  # of the second segment, seen from the first
        away = end[None] - start[:, None]
        far = np.maximum(far, np.abs(np.einsum("ijk,ik->ij", away, across)))
        at.append(np.einsum("ijk,ik->ij", away, along))
    low, high = np.minimum(*at), np.maximum(*at)
    shared = np.minimum(high, length[:, None]) - np.maximum(low, 0.0)
    on = (far < NETWORK.same) & (shared > NETWORK.covered * length) & np.triu(np.ones_like(far, bool), 1)
    return np.asarray(on.any(axis=0))


# -------------------------------------------------------------------------------------------------------------- tiles
#: Left, top, width and height of a tile, and left, top, right and bottom of its core.
_Tile = tuple[tuple[int, int, int, int], tuple[float, float, float, float]]


def _tiles(shape: tuple[int, ...], size: tuple[int, int]) -> list[_Tile]:
    """Cut an image (H, W) into tiles for a network of a size (width, height)."""
    parts = [_parts(shape[1 - axis], size[axis] * NETWORK.max_scale, NETWORK.overlap) for axis in range(2)]
    return [
        ((left, top, width, height), (core_x[0], core_y[0], core_x[1], core_y[1]))
        for left, width, core_x in parts[0]
        for top, height, core_y in parts[1]
    ]


def _parts(length: int, most: float, overlap: float) -> list[tuple[int, int, tuple[float, float]]]:
    """Intervals of a length, each at most so long, and their cores, which do not overlap and cover everything."""
    count = max(1, math.ceil((length - overlap * most) / (most * (1.0 - overlap))))
    step = length / count
    margin = 0.0 if count == 1 else 0.5 * overlap * step / (1.0 - overlap)
    found = []
    for k in range(count):
        low, high = max(0, math.floor(k * step - margin)), min(length, math.ceil((k + 1) * step + margin))
        core = (-math.inf if k == 0 else k * step, math.inf if k == count - 1 else (k + 1) * step)
        found.append((low, high - low, core))
    return found


def _clipped(ends: FloatArray, core: FloatArray) -> FloatArray:
    """Parts of segments (N, 4) in a rectangle; none of those outside."""
    start, way = ends[:, :2], ends[:, 2:] - ends[:, :2]
    way = np.where(np.abs(way) < 1e-9, 1e-9, way)
    both = (core.reshape(2, 1, 2) - start) / way
    first, last = both.min(axis=0).max(axis=1).clip(0.0), both.max(axis=0).min(axis=1).clip(max=1.0)
    kept = first < last
    parts = [start + share[:, None] * way for share in (first, last)]
    return np.hstack(parts)[kept]


def _on_edges(gray: GrayImage, ends: FloatArray) -> tuple[FloatArray, ...]:
    """Move segments across themselves to the strongest edge nearby; ends, deviations and strengths."""
    way = ends[:, 2:] - ends[:, :2]
    length = np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
    across = np.tile(np.column_stack([way[:, 1], -way[:, 0]]) / length, (1, 2))
    tried = [
        measure_edges(gray, ends + shift * across)
        for shift in (0.0, *NETWORK.shifts, *(-shift for shift in NETWORK.shifts))
    ]
    moved, sigma, strength = (np.stack(column) for column in zip(*tried, strict=True))
    # A place where the fit failed counts as half as strong.
    best = np.argmax(np.where(sigma < EDGES.unfitted_sigma, strength, 0.5 * strength), axis=0)
    rows = np.arange(len(ends))
    return moved[best, rows], sigma[best, rows], strength[best, rows]


# ------------------------------------------------------------------------------------------------------------ network
@dataclass(frozen=True, eq=False)
class _Network:
    """A session of onnxruntime, with the names of its input and outputs."""

    session: Any
    #: Where it came from.
    file: str
    name: str
    #: Width, height and channels of the input.
    size: tuple[int, int]
    channels: int
    scores: str
    offsets: str

    def segments(self, gray: GrayImage, tile: _Tile) -> FloatArray:
        """Segments (N, 4) in the core of a tile, pixels of the image."""
        (left, top, width, height), core = tile
        part = gray[top : top + height, left : left + width]
        small = cv2.resize(part, self.size, interpolation=cv2.INTER_AREA).astype(np.float32)
        image = np.ones((1, *small.shape, self.channels), np.float32)
        image[0, :, :, :3] = small[:, :, None]
        scores, offsets = self._run(image)
        row, column = np.nonzero(scores[0, :, :, 0] > NETWORK.min_score)
        cell = np.column_stack([column, row, column, row]) + 0.5 + offsets[0, row, column]
        rows, columns = scores.shape[1:3]
        ends = cell * np.tile([width / columns, height / rows], 2) + np.tile([left, top], 2)
        return _clipped(ends[np.isfinite(ends).all(axis=1)].astype(np.float64), np.array(core))

    def _run(self, image: npt.NDArray[np.float32]) -> tuple[npt.NDArray[np.float32], ...]:
        """Return scores and offsets; InputError if the network cannot, or gives arrays that do not fit each other."""
        try:
            scores, offsets = self.session.run([self.scores, self.offsets], {self.name: image})
        except Exception as error:  # of onnxruntime, of many classes
            raise InputError(f"{self.file} fails on an image: {_first_line(error)}. Use another network.") from error
        if (*scores.shape[:3], 4) != offsets.shape or scores.shape[0] != 1 or scores.shape[3:] != (1,):
            raise InputError(f"{self.file} gives arrays of shape {scores.shape} and {offsets.shape}; expected {_FORM}.")
        return scores, offsets


def _first_line(error: Exception) -> str:
    """Return the first sentence of an error."""
    return (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")


@lru_cache(maxsize=4)
def _network(file: str, content: str) -> _Network:
    """Load a network; ``content`` is the hash of the file.

    Raises
    ------
    InputError
        If onnxruntime is missing, or the file holds no network of this form.
    """
    try:
        import onnxruntime  # type: ignore[import-not-found]  # an extra
    except ImportError as error:
        raise InputError('Detectors in ONNX files need onnxruntime: pip install "groma[onnx]".') from error
    options = onnxruntime.SessionOptions()
    options.log_severity_level, options.intra_op_num_threads = 4, 1  # threads work on images
    try:
        session = onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # of onnxruntime, of many classes
        raise InputError(f"{file} cannot be loaded as an ONNX model: {_first_line(error)}. Fetch it again.") from error
    return _checked(session, file)


def _checked(session: Any, file: str) -> _Network:
    """Return what input and outputs of a session are called; InputError if they are of another form."""
    inputs, outputs = session.get_inputs(), session.get_outputs()
    last = {output.shape[-1]: output for output in outputs if len(output.shape) == 4}
    shape = inputs[0].shape if len(inputs) == 1 else []
    good = len(shape) == 4 and shape[0] in (1, "N", None) and shape[3] in (3, 4) and len(outputs) == 2
    good = good and all(isinstance(size, int) and size > 0 for size in shape[1:]) and {1, 4} <= set(last)
    if not good or any(value.type != "tensor(float)" for value in (*inputs, *outputs)):
        given = ", ".join(str(tuple(value.shape)) for value in inputs)
        made = ", ".join(str(tuple(value.shape)) for value in outputs)
        raise InputError(
            f"{file} is no detector of segments that is known: expected {_FORM}; got input {given or 'none'}, outputs "
            f"{made or 'none'}. Write an adapter as a detector of your own (docs/extending.md)."
        )
    if shape[1] * shape[2] > NETWORK.largest:
        raise InputError(
            f"{file} takes images of {shape[2]} x {shape[1]} pixels; expected at most {NETWORK.largest} in all. Export "
            "it for smaller ones: larger images are cut into tiles."
        )
    return _Network(session, file, inputs[0].name, (shape[2], shape[1]), shape[3], last[1].name, last[4].name)

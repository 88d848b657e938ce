# SPDX-License-Identifier: BSD-3-Clause
"""The panel of a running track: the current picture with its tracked features, and a timeline.

``groma track`` writes both into ``OUT.work``: ``now.npz`` (picture, points, segments) and ``statuses.txt``, a row for
every frame: time, status, numbers of points, lines and planes that agree, whether it is a keyframe.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from groma._counted import counted
from groma._typing import BoolArray, FloatArray, IntArray
from groma.bounded.arrays import Header, opened_arrays
from groma.bounded.text import finite, read_words
from groma.errors import FileFormatError
from groma.io.reading import reading

Picture = npt.NDArray[np.uint8]
#: Colours of statuses in the timeline; others are grey.
_COLOURS = {"tracked": "#1f6fb5", "found": "#2f8f5b", "weak": "#e8a33a", "lost": "#d64b36"}
_POINT, _SEGMENT = (40, 140, 255), (40, 190, 110)
#: Columns of the timeline: each shows the worst status of its frames.
_COLUMNS, _HEIGHT = 200, 46
_WORST = ("lost", "skipped", "weak", "starting", "found", "tracked")


@dataclass(frozen=True)
class Statuses:
    """The statuses of N frames."""

    timestamp: FloatArray
    status: tuple[str, ...]
    #: (N, 3) points, lines and planes that agree.
    counts: IntArray
    keyframe: BoolArray

    def __len__(self) -> int:
        return len(self.status)

    def sentence(self, row: int = -1) -> str:
        """Return the status of a frame in words."""
        number = row % len(self) + 1
        parts = [counted(int(n), kind) for n, kind in zip(self.counts[row], ("points", "lines", "planes"), strict=True)]
        more = ", keyframe" if self.keyframe[row] else ""
        return f"Frame {number:,}: **{self.status[row]}**{more}; {', '.join(parts)} agree"


def read_statuses(path: Path) -> Statuses:
    """Read the complete rows of ``statuses.txt``."""
    with reading(path, "list of frames"):
        rows = [(line, words) for line, words in read_words(path) if len(words) == 6]
        where = f"{path}, line "
        numbers = [finite([words[0], *words[2:]], f"{where}{line}") for line, words in rows]
    table = np.array(numbers, float).reshape(-1, 5)
    return Statuses(table[:, 0], tuple(words[1] for _, words in rows), table[:, 1:4].astype(np.int64), table[:, 4] > 0)


def read_now(path: Path) -> Picture:
    """Read ``now.npz`` and return the picture with its points and segments drawn, red, green, blue.

    Raises
    ------
    FileFormatError
        If the file is damaged.
    """
    import cv2

    def array(name: str, *last: int) -> FloatArray:
        def check(header: Header) -> None:
            if header.dtype.kind != "f" or header.shape[1:] != last:
                raise FileFormatError(f"Array {name} must have {last} columns; got {header.shape}.")

        return members.read(name, check)

    with reading(path, "picture of a frame"), opened_arrays(path) as members:
        picture = members.read("picture")
        points, segments = array("points", 2), array("segments", 4)
    if picture.ndim != 2 or picture.dtype != np.uint8:
        raise FileFormatError(f"{path}: expected a grey picture; got {picture.dtype} {picture.shape}.")
    drawn = cv2.cvtColor(picture, cv2.COLOR_GRAY2RGB)
    for x1, y1, x2, y2 in np.clip(np.nan_to_num(segments), -1e4, 1e4).round().astype(int).tolist():
        cv2.line(drawn, (x1, y1), (x2, y2), _SEGMENT, 2, cv2.LINE_AA)
    for x, y in np.clip(np.nan_to_num(points), -1e4, 1e4).round().astype(int).tolist():
        cv2.circle(drawn, (x, y), 2, _POINT, -1, cv2.LINE_AA)
    return np.asarray(drawn, np.uint8)


def timeline(statuses: Statuses) -> str:
    """Return all frames as an SVG: inlier counts as heights, statuses as colours, keyframes as ticks."""
    count = len(statuses)
    if not count:
        return ""
    columns = np.minimum(np.arange(count) * min(_COLUMNS, count) // count, _COLUMNS - 1)
    together = statuses.counts[:, :2].sum(axis=1)
    top, width = max(int(together.max()), 1), 100.0 / (columns[-1] + 1)
    bars = []
    for column in range(columns[-1] + 1):
        rows = np.flatnonzero(columns == column)
        worst = min((statuses.status[row] for row in rows), key=lambda one: (*_WORST, one).index(one))
        height = max(_HEIGHT * float(together[rows].mean()) / top, 2.0)
        bars.append(
            f'<rect x="{column * width:.2f}%" y="{_HEIGHT - height:.1f}" width="{width:.2f}%" height="{height:.1f}" '
            f'fill="{_COLOURS.get(worst, "#9aa1aa")}"/>'
        )
        if statuses.keyframe[rows].any():
            bars.append(
                f'<rect x="{column * width:.2f}%" y="{_HEIGHT + 2}" width="{width:.2f}%" height="4" fill="#555"/>'
            )
    key = " ".join(
        f'<span style="color:{colour}">&#9632;</span> {name}'
        for name, colour in _COLOURS.items()
        if name in statuses.status
    )
    return (
        f'<div style="padding:0 1em .5em;font-size:.8em"><svg width="100%" height="{_HEIGHT + 6}">{"".join(bars)}</svg>'
        f"{key}; height: points and lines that agree; ticks: keyframes</div>"
    )

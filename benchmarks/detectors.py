# SPDX-License-Identifier: BSD-3-Clause
"""Segment detectors compared by the 3D lines that come out: LSD, a network in an ONNX file, and both.

    python benchmarks/detectors.py onnx:FILE [SCENE ...] [--data DATA] [--json FILE]

SCENEs are those of ``benchmarks/lines.py`` with a truth, at exact poses held fixed, lines with all confidences
(``groma.mapping.map.map_segments``). *Both* are the segments of LSD and those of the network that LSD has not.
Columns: segments in an image; lines; reference found and lines right at three thresholds, per cent; processor seconds
of detection for an image.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np
from lines import SCENES, options_of

from groma.evaluation.lines import score_lines
from groma.features.onnx_segments import covered
from groma.features.registry import DETECTORS
from groma.features.segments import Segments
from groma.mapping.checkpoints import Stages
from groma.mapping.map import MapOptions, adjust_points, map_segments
from groma.scene.line_intervals import one_line_per_interval

ROOT = Path(__file__).parents[1]


def joined(first: Segments, second: Segments) -> Segments:
    """The segments of both detectors, the longest first, without those that a longer one covers."""
    parts = [np.concatenate([getattr(one, name) for one in (first, second)]) for name in ("ends", "sigma", "strength")]
    order = np.argsort(-np.hypot(*(parts[0][:, 2:] - parts[0][:, :2]).T), kind="stable")
    both = Segments(*(part[order] for part in parts))
    return both.select(np.flatnonzero(~covered(both.ends)))


def row_of(name: str, source, segments: list[Segments], seconds: float) -> dict:
    """Map the segments of all images and compare the lines."""
    settings = MapOptions(lines=options_of(source.name), refine_poses=False, min_confidence=0.0, threads=1)
    with tempfile.TemporaryDirectory() as work, Stages(Path(work), source.name, settings) as stages:
        points = stages.run(adjust_points, source.scene)
        result = map_segments(points, segments, None, stages)
    scene = one_line_per_interval(result.scene)
    scores = score_lines(scene.lines.segments, source.edges, source.thresholds)
    return {
        "scene": source.name, "detector": name, "segments": float(np.mean([len(one) for one in segments])),
        "lines": len(scene.lines), "found": list(scores.recall_length.values()),
        "right": list(scores.precision_count.values()), "cpu_s": seconds,
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("network", help="onnx:FILE")
    parser.add_argument("scenes", nargs="*", default=["boxes"])
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--json", type=Path)
    told = parser.parse_args()
    rows = []
    for name in told.scenes:
        source = SCENES[name](told.data)
        shortest, found = options_of(name).min_length, {}
        for kind in ("lsd", told.network):
            detector = DETECTORS.make(kind, min_length=shortest, max_segments=0)
            detector.detect(source.images[0])
            begun = time.process_time()
            segments = [detector.detect(image) for image in source.images]
            found[kind.split(":")[0]] = segments, (time.process_time() - begun) / len(segments)
        (first, one), (second, two) = found["lsd"], found["onnx"]
        found["both"] = [joined(*pair) for pair in zip(first, second, strict=True)], one + two
        for kind, (segments, seconds) in found.items():
            rows.append(row_of(kind, source, segments, seconds))
            print(json.dumps(rows[-1]), flush=True)
    if told.json is not None:
        told.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()

# SPDX-License-Identifier: BSD-3-Clause
"""Segment detectors compared by the 3D lines that come out: LSD, a network in an ONNX file, and both.

    python benchmarks/detectors.py onnx:FILE [SCENE ...] [--data DATA] [--json FILE]

SCENEs are those of ``benchmarks/lines.py``, at exact poses held fixed (``groma.mapping.map.map_segments``), and
``cabinet``, the photographs of ``groma demo``, mapped whole. *Both* are the segments of LSD and those of the network
that LSD has not. Columns: segments in an image; lines of all confidences, and those of the default one; what of the
reference they find and how many are right, per cent; processor seconds of detection for an image.

Where edges are known they are found and right at the thresholds of the scene. Of the cabinet, found are its twelve
edges, right are lines on them. For photographs without a reference, right is the share that the probabilities of the
lines expect to be.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from _line_scenes import SCENES, LineScene
from lines import options_of

from groma.evaluation import evaluate_poses
from groma.evaluation.cabinet import folder, score_cabinet
from groma.evaluation.lines import score_lines
from groma.features.images import GrayImage
from groma.features.onnx_segments import covered
from groma.features.registry import DETECTORS
from groma.features.segments import Segments
from groma.io import read_scene
from groma.mapping.checkpoints import Stages
from groma.mapping.lines.confidence import DEFAULT_CONFIDENCE
from groma.mapping.map import adjust_points, map_images, map_segments
from groma.mapping.options import MapOptions
from groma.scene import Scene
from groma.scene.line_intervals import one_line_per_interval

ROOT = Path(__file__).parents[1]


def joined(first: Segments, second: Segments) -> Segments:
    """The segments of both detectors, the longest first, without those that a longer one covers."""
    both = Segments.joined([first, second])
    both = both.select(np.argsort(-both.length, kind="stable"))
    return both.select(np.flatnonzero(~covered(both.ends)))


@dataclass(frozen=True)
class Given:
    """Detects what was detected before, image by image in their order."""

    segments: Iterator[Segments]

    def detect(self, image: GrayImage) -> Segments:
        """The segments of the next image."""
        return next(self.segments)


def mapped(source: LineScene, segments: list[Segments]) -> Scene:
    """Map the segments of all images at exact poses, those of the cabinet at poses that are adjusted."""
    settings = MapOptions(lines=options_of(source.name), refine_poses=False, min_confidence=0.0, threads=1)
    with tempfile.TemporaryDirectory() as work:
        if source.name == "cabinet":
            settings = replace(settings, refine_poses=True, detector=Given(iter(segments)))
            return map_images(folder() / "images", work, source.scene, settings).scene
        with Stages(Path(work), source.name, settings) as stages:
            return map_segments(stages.run(adjust_points, source.scene), segments, None, stages).scene


def compared(source: LineScene, scene: Scene) -> dict:
    """What of the reference lines find, and how many are right."""
    lines = one_line_per_interval(scene).lines
    if source.edges is not None:
        scores = score_lines(lines.segments, source.edges, source.thresholds)
        found, right = list(scores.recall_length.values()), list(scores.precision_count.values())
    elif source.name == "cabinet":
        cabinet = score_cabinet(scene, evaluate_poses(scene, read_scene(folder() / "motion_capture")).alignment)
        found, right = [cabinet["num_edges"] / 12], [cabinet["num_lines"] / max(len(scene.lines), 1)]
    else:
        found, right = [], [float(scene.lines.confidence.mean())]
    return {"lines": len(lines), "found": found, "right": right}


def row_of(name: str, source: LineScene, segments: list[Segments], seconds: float) -> dict:
    """Map the segments of all images and compare the lines, all and those of the default confidence."""
    scene = mapped(source, segments)
    number = float(np.mean([len(one) for one in segments]))
    row = {"scene": source.name, "detector": name, "segments": number, "cpu_s": seconds}
    sure = scene.keep(lines=scene.lines.confidence >= DEFAULT_CONFIDENCE)
    return row | {"all": compared(source, scene), "default": compared(source, sure)}


def cabinet() -> LineScene:
    """The photographs of the demo, with the start that it has."""
    scene = read_scene(folder() / "model")
    return LineScene("cabinet", scene, [cv2.imread(str(folder() / "images" / n), 0) for n in scene.images.names])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("network", help="onnx:FILE")
    parser.add_argument("scenes", nargs="*", default=["boxes"])
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--json", type=Path)
    told = parser.parse_args()
    rows = []
    for name in told.scenes:
        source = cabinet() if name == "cabinet" else SCENES[name](told.data)
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

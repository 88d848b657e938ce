# SPDX-License-Identifier: BSD-3-Clause
"""Fit the probability that a line is right on rendered scenes, and compare it with what is right on others.

    python benchmarks/line_confidence.py [--data DATA] [--cache FOLDER] [--picture SVG]

A line is right if at least half of what images support of it lies within 2.5 thousandths of the usual distance of lines
from their cameras from a true edge. Prints the weights for ``groma.mapping.lines.confidence.WEIGHTS``, the share of
right lines by predicted probability, and what lines of at least some probability find and are worth. Cameras are held:
probabilities are those of the lines as mapped, and whether they are right is asked of the adjusted ones, as in a map.
Maps are kept in the cache.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from _line_scenes import MIN_LENGTH, SCENES, SMALL, LineScene, boxes, unseen
from _rendered_boxes import BoxSettings
from _workshop import CACHE, ROOT
from scipy.optimize import minimize

from groma.evaluation.lines import Distances, Geometry, places_on, score_lines
from groma.io import read_archive, write_archive
from groma.mapping.checkpoints import Stages
from groma.mapping.lines.confidence import (
    DEFAULT_CONFIDENCE,
    GATES,
    WEIGHTS,
    edge_probability,
    line_accuracy,
    line_evidence,
    usual_distance,
)
from groma.mapping.map import adjust_points, map_segments
from groma.mapping.options import MapOptions
from groma.scene import Scene
from groma.scene.line_intervals import line_pieces, supported_lengths

#: Rendered for this, and for nothing else.
CHOSEN_ON = {
    "train-small": BoxSettings(seed=501, texture=10.0, **SMALL),
    "train-strong": BoxSettings(seed=502, texture=20.0),
    "train-strong-small": BoxSettings(seed=503, texture=16.0, **SMALL),
    "train-random": BoxSettings(seed=504, texture=12.0, cameras="random"),
    "train-fine": BoxSettings(seed=505, texture=10.0, blotches=256, **SMALL),
    "train-few": BoxSettings(seed=506, num_images=12, texture=12.0),
    "train-noisy": BoxSettings(seed=507, noise=6.0, texture=6.0, **SMALL),
    "train-many": BoxSettings(seed=508, num_images=40, texture=10.0, **SMALL),
    "train-round": BoxSettings(seed=611, num_boxes=5, num_round=9, texture=6.0),
    "train-round-small": BoxSettings(seed=612, num_boxes=4, num_round=9, num_images=36, **SMALL),
    "train-round-random": BoxSettings(seed=613, num_boxes=4, num_round=9, texture=10.0, cameras="random"),
}
#: Scenes of benchmarks/lines.py that have edges; none was used for the fit.
REPORTED_ON = (
    "pavilion", "boxes", "boxes-small", "boxes-textured", "boxes-fine", "boxes-rough", "boxes-strong",
    "boxes-strong-small", "boxes-random", "boxes-held-small", "boxes-held-random", "boxes-held-many", "boxes-round",
    "boxes-round-small", "boxes-round-random", "boxes-3101", "stairs-3103", "stairs-3104", "stairs-3105", "room-3102",
    "room-3106", "wings-3107", "gable-3108",
)  # fmt: skip
LEVELS = (0.0, 0.3, 0.5, 0.8)
BINS = np.array([0.0, 0.1, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98, 1.0])
_PLACES = 64


@dataclass(frozen=True, eq=False)
class Judged:
    """A map, what is known of its lines, and which are right."""

    source: LineScene
    scene: Scene
    evidence: np.ndarray
    accuracy: np.ndarray
    right: np.ndarray
    #: Lines that lie where edges were marked.
    counted: np.ndarray


def judged(source: LineScene, cache: Path) -> Judged:
    """Map a scene, or take the map from the cache, and compare its lines with the edges."""
    file, before, surface = (cache / f"{source.name}{end}" for end in (".npz", "-before.npz", "-surface.txt"))
    if not surface.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        settings = MapOptions(refine_poses=False, threads=1, min_confidence=0.0)
        segments = source.segments(MIN_LENGTH.get(source.name, settings.lines.min_length))
        with tempfile.TemporaryDirectory() as work, Stages(Path(work), source.name, settings) as stages:
            result = map_segments(stages.run(adjust_points, source.scene), segments, None, stages)
            write_archive(result.scene, file)
            write_archive(result.before, before)
            surface.write_text(repr(float(result.adjusted_with.structure_sigma_px)))
    scene, mapped = read_archive(file), read_archive(before)
    ends, line = line_pieces(scene)
    places, owner = places_on(ends, np.full(len(ends), _PLACES))
    tau = GATES.tolerance * usual_distance(scene)
    near = Distances(Geometry(segments=source.edges), tau / 4, tau, tau).of(places) <= tau
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    share = np.bincount(line, np.bincount(owner, near, len(ends)) / _PLACES * length) / supported_lengths(scene)
    counted = np.ones(scene.num_lines, bool)
    if source.box is not None:
        inside = ((places >= source.box[0]) & (places <= source.box[1])).all(axis=1)
        counted = np.bincount(line[owner], inside) / np.bincount(line[owner]) > 0.9
    accuracy = line_accuracy(mapped, surface_px=float(surface.read_text()))
    return Judged(source, scene, line_evidence(mapped), accuracy, share >= 0.5, counted)


def probability(one: Judged, weights: np.ndarray) -> np.ndarray:
    """Return the probability that each line is right."""
    return edge_probability(one.evidence, weights) * one.accuracy


def fitted(scenes: list[Judged]) -> np.ndarray:
    """Weights of most likelihood, with a standard normal prior on those of standardised quantities.

    Scenes of boxes and scenes of round bodies count alike: the latter have a fifth of the lines, and all the outlines.
    """
    x = np.concatenate([one.evidence[:, :-2] for one in scenes])
    is_round = np.array(["round" in one.source.name for one in scenes])
    lines = np.array([len(one.right) for one in scenes])
    count = np.where(is_round, lines[~is_round].sum() / lines[is_round].sum(), 1.0)
    varies = np.ptp(x, axis=0) > 0.0
    mean, spread = np.where(varies, x.mean(0), 0.0), np.where(varies, x.std(0), 1.0)
    rows = [np.column_stack([(one.evidence[:, :-2] - mean) / spread, one.evidence[:, -2:]]) for one in scenes]

    def cost(weights: np.ndarray) -> float:
        total = 0.5 * (weights[varies] ** 2).sum()
        for one, evidence, times in zip(scenes, rows, count, strict=True):
            p = np.clip(edge_probability(evidence, weights) * one.accuracy, 1e-9, 1.0 - 1e-9)
            total -= times * np.log(np.where(one.right, p, 1.0 - p)).sum()
        return total

    weights = minimize(cost, np.ones(x.shape[1]), method="L-BFGS-B").x / spread
    weights[0] -= weights @ mean  # the first quantity is one
    return weights


def reliability(scenes: list[Judged], weights: np.ndarray) -> list[tuple[float, float, int]]:
    """Return mean probability, share of right lines and number of lines in each bin."""
    p = np.concatenate([probability(one, weights)[one.counted] for one in scenes])
    right = np.concatenate([one.right[one.counted] for one in scenes])
    owner = np.clip(np.searchsorted(BINS, p, side="right") - 1, 0, len(BINS) - 2)
    return [
        (float(p[owner == k].mean()), float(right[owner == k].mean()), int((owner == k).sum()))
        for k in range(len(BINS) - 1)
        if (owner == k).any()
    ]


def curve(one: Judged, weights: np.ndarray) -> str:
    """Rows of a table: lines, found, right, wholly right and right length at each level."""
    p, rows = probability(one, weights), []
    for level in LEVELS:
        pieces = line_pieces(one.scene.keep(lines=p >= level))[0]
        scores = score_lines(pieces, one.source.edges, one.source.thresholds)
        columns = scores.recall_length, scores.precision_count, scores.precision_strict, scores.precision_length
        cells = [" / ".join(f"{100 * value:.1f}" for value in column.values()) for column in columns]
        rows.append(f"| {one.source.name} | {level:g} | {len(pieces)} | {' | '.join(cells)} |")
    return "\n".join(rows)


def picture(sets: dict[str, list[tuple[float, float, int]]]) -> str:
    """Reliability diagram as SVG: the share of right lines over the predicted probability; areas are numbers."""
    size, margin, colours = 360.0, 48.0, ("#8a8a8a", "#0b6e8f", "#d55e00")

    def place(x: float, y: float) -> tuple[float, float]:
        return margin + size * x, margin / 2 + size * (1.0 - y)

    body = []
    for tick in (0.0, 0.25, 0.5, 0.75, 1.0):
        (x, bottom), (left, y) = place(tick, 0.0), place(0.0, tick)
        body.append(f'<path class="grid" d="M{x:.0f} {bottom:.0f} v{-size:.0f} M{left:.0f} {y:.0f} h{size:.0f}"/>')
        body.append(f'<text x="{x:.0f}" y="{bottom + 18:.0f}" text-anchor="middle">{tick:g}</text>')
        body.append(f'<text x="{left - 6:.0f}" y="{y + 4:.0f}" text-anchor="end">{tick:g}</text>')
    (x0, y0), (x1, y1) = place(0.0, 0.0), place(1.0, 1.0)
    body.append(f'<path class="even" d="M{x0:.0f} {y0:.0f} L{x1:.0f} {y1:.0f}"/>')
    for number, (name, bins) in enumerate(sets.items()):
        for p, share, count in bins:
            x, y = place(p, share)
            radius = 2.0 + 0.5 * count**0.5
            body.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}" fill="{colours[number]}"/>')
        y = margin + 20 * number
        body.append(f'<circle cx="{margin + 16:.0f}" cy="{y:.0f}" r="6" fill="{colours[number]}"/>')
        body.append(f'<text x="{margin + 28:.0f}" y="{y + 4:.0f}">{name}</text>')
    body.append(f'<text x="{margin + size / 2:.0f}" y="{size + 64:.0f}" text-anchor="middle">probability</text>')
    style = (
        "svg{font:13px system-ui,sans-serif;background:#fff}text{fill:#333}.grid{stroke:#e4e4e4}"
        ".even{stroke:#999;stroke-dasharray:5 4}circle{fill-opacity:.75}"
    )
    width, height = size + 1.5 * margin, size + 76
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" width="{width:.0f}" '
        f'height="{height:.0f}"><style>{style}</style>{"".join(body)}</svg>\n'
    )


def main() -> None:
    """Fit, report, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--cache", type=Path, default=CACHE / "confidence")
    parser.add_argument("--picture", type=Path, help="where to draw the reliability diagram, .svg")
    given = parser.parse_args()
    chosen = [judged(boxes(name, settings), given.cache) for name, settings in CHOSEN_ON.items()]
    weights = fitted(chosen)
    print("Weights, now and as the library has them:")
    for name, value in zip(WEIGHTS, weights, strict=True):
        print(f'    "{name}": {value:.3f},    {WEIGHTS[name]:.3f}')
    used = np.array(list(WEIGHTS.values()))
    names = [name for name in REPORTED_ON if name != "pavilion" or (given.data / "pavilion_chair").is_dir()]
    sources = (SCENES[name](given.data) if name in SCENES else unseen(name) for name in names)
    reported = [judged(source, given.cache) for source in sources]
    groups = {
        "scenes of the fit": chosen,
        "other rendered scenes": [one for one in reported if one.source.box is None],
        "pavilion, edges marked by hand": [one for one in reported if one.source.box is not None],
    }
    sets = {name: reliability(group, used) for name, group in groups.items() if group}
    for name, bins in sets.items():
        print(f"\n{name}\n\n| probability | right | lines |\n|--:|--:|--:|")
        print("\n".join(f"| {p:.3f} | {share:.3f} | {count} |" for p, share, count in bins))
    print(
        f"\n| scene | at least (default {DEFAULT_CONFIDENCE:g}) | pieces | found % | right % | wholly right % |", end=""
    )
    print(" right length % |\n|---|--:|--:|--:|--:|--:|--:|")
    print("\n".join(curve(one, used) for one in reported))
    if given.picture:
        given.picture.write_text(picture(sets))


if __name__ == "__main__":
    main()

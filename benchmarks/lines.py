# SPDX-License-Identifier: BSD-3-Clause
"""Map the lines of posed images with groma and LIMAP, from the same segments and the same matches.

    python benchmarks/lines.py [SCENE ...] [--data DIR] [--python-limap PYTHON] [--curves SVG] [--cluster-size N]

A scene is one of the list, or KIND-SEED (boxes, room, wings, gable, stairs, tower): rendered anew, and compared at 0.2,
1, 5 and 10 thousandths of its extent.

Without a Python that has pylimap 2 groma runs alone; with one its rows are printed before LIMAP starts, and again with
LIMAP's. Scenes whose data is not in the folder are left out.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from _line_curves import drawing
from _line_scenes import LIMAP_MIN_LENGTH, MIN_LENGTH, NUM_NEIGHBORS, SCENES, UNSEEN, LineScene, unseen
from _workshop import CACHE, CONTESTANTS, RESULTS, ROOT, TIMEOUT, machine, run_program

from groma import cameras as camera_models
from groma.evaluation.lines import Distances, Geometry, places_on, score_lines
from groma.features import Segments
from groma.features.matches import LineMatches
from groma.geometry import quaternion, segment2
from groma.mapping.checkpoints import Stages
from groma.mapping.lines.build import map_lines
from groma.mapping.lines.confidence import DEFAULT_CONFIDENCE
from groma.mapping.lines.matches import segment_matches
from groma.mapping.lines.neighbors import covisible_neighbors
from groma.mapping.lines.options import MapLinesOptions
from groma.mapping.map import adjust_points, map_segments
from groma.mapping.options import MapOptions
from groma.scene import Scene
from groma.scene.line_intervals import one_line_per_interval

#: Probabilities at which points of groma's curve are, and numbers of images at which those of LIMAP's are.
LEVELS, IMAGES = (0.0, 0.3, 0.5, 0.7, 0.8, 0.9), (3, 4, 5, 6, 8, 10)
#: ``all``: every segment of a neighbour is a candidate. ``wide``: groma's matches of surroundings and points.
MATCHING = ("all", "wide")


@dataclass(frozen=True, eq=False)
class LineSet:
    """Lines of one contestant, and who sees them."""

    contestant: str
    matching: str
    ends: np.ndarray
    #: (T, 3) line, image, segment.
    track: np.ndarray
    seconds: float = float("nan")
    #: (L,) what orders the lines from doubtful to sure: groma's probability; None: the number of images.
    sure: np.ndarray | None = None

    @property
    def num_images(self) -> np.ndarray:
        pairs = np.unique(self.track[:, :2], axis=0)
        return np.bincount(pairs[:, 0].astype(int), minlength=len(self.ends))

    def keep(self, kept: np.ndarray) -> LineSet:
        """Return some of the lines."""
        new = np.cumsum(kept) - 1
        track = self.track[kept[self.track[:, 0]]]
        track = np.column_stack([new[track[:, 0]], track[:, 1:]])
        sure = None if self.sure is None else self.sure[kept]
        return replace(self, ends=self.ends[kept], track=track, sure=sure)


@dataclass(frozen=True, eq=False)
class Task:
    """A scene with its segments and the matches that every contestant gets."""

    source: LineScene
    segments: list[Segments]
    neighbors: list[np.ndarray]
    options: MapLinesOptions
    matches: dict[tuple[int, int], LineMatches] = field(default_factory=dict)

    @property
    def matching(self) -> str:
        return "wide" if self.matches else "all"


def prepare(source: LineScene, matching: str, cluster_size: int) -> Task:
    """Detect, choose neighbours, match."""
    options = replace(options_of(source.name), cluster_size=cluster_size)
    segments = source.segments(options.min_length)
    neighbors = covisible_neighbors(source.scene, options.num_neighbors, options.min_shared)
    matches = {}
    if matching == "wide":
        provider = segment_matches(source.scene, segments, lambda i: source.images[i])
        pairs = {(min(i, int(j)), max(i, int(j))) for i, row in enumerate(neighbors) for j in row}
        matches = {pair: provider(*pair) for pair in sorted(pairs)}
    return Task(source, segments, neighbors, options, matches)


def options_of(scene: str) -> MapLinesOptions:
    """The defaults, but for photographs that figures were published of."""
    usual = MapLinesOptions()
    return replace(
        usual,
        min_length=MIN_LENGTH.get(scene, usual.min_length),
        num_neighbors=NUM_NEIGHBORS.get(scene, usual.num_neighbors),
    )


# --------------------------------------------------------------------------------------------------------- contestants
def run_groma(task: Task) -> list[LineSet]:
    """Lines as mapped, after the joint adjustment of everything but the exact poses, and the probable ones of them.

    Then the same with ``selective`` options, but of new scenes.
    """
    found = _run_groma(task, "groma", task.options)
    if task.source.name in SCENES:
        found += _run_groma(task, "groma, selective", MapLinesOptions.selective(task.options.min_length))[1:]
    return found


def _run_groma(task: Task, name: str, options: MapLinesOptions) -> list[LineSet]:
    settings = MapOptions(lines=options, refine_poses=False, threads=1, min_confidence=0.0)
    matches = task.matches or None
    with tempfile.TemporaryDirectory() as work, Stages(Path(work), task.source.name, settings) as stages:
        points = stages.run(adjust_points, task.source.scene)
        map_lines(points, task.segments, matches, options)  # kernels into memory
        start = time.process_time()
        found = map_lines(points, task.segments, matches, options)
        seconds = time.process_time() - start
        track = np.column_stack([found.line_idx, found.image_idx, found.segment_idx])
        mapped = LineSet(f"{name}, no joint adjustment", task.matching, found.segments, track, seconds)
        if not found.num_lines:
            return [mapped]
        start = time.process_time()
        result = map_segments(points, task.segments, matches, stages)
        seconds = time.process_time() - start
    scene = one_line_per_interval(result.scene)
    track, sure = _track(scene, task.segments), scene.lines.confidence
    every = LineSet(f"{name}, all", task.matching, scene.lines.segments, track, seconds, sure)
    return [mapped, every, replace(every.keep(sure >= DEFAULT_CONFIDENCE), contestant=name)]


def _track(scene: Scene, segments: list[Segments]) -> np.ndarray:
    """Line, image and number within the image (T, 3) of each observed segment of a scene."""
    number = [{ends.tobytes(): row for row, ends in enumerate(one.ends)} for one in segments]
    seen = scene.line_observations
    rows = [number[image][ends.tobytes()] for image, ends in zip(seen.image_idx, seen.segment, strict=True)]
    return np.column_stack([seen.line_idx, seen.image_idx, np.array(rows, np.int64)])


def run_limap(task: Task, python: str) -> list[LineSet]:
    """LIMAP's lines, as triangulated and after its own refinement."""
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "in.npz", Path(folder) / "out.npz"
        np.savez(source, **for_limap(task))
        done = run_program([python, CONTESTANTS / "limap_lines.py", source, target])
        if done is None:
            return []
        with np.load(target) as found:
            name = f"LIMAP {done['version']}"
            return [
                LineSet(name, task.matching, found["ends"], found["track"], done["cpu_s"]),
                LineSet(f"{name}, refined", task.matching, found["refined_ends"], found["refined_track"]),
            ]


def for_limap(task: Task) -> dict[str, np.ndarray]:
    """Return the arrays that the contestant reads."""
    scene: Scene = task.source.scene
    camera = scene.images.camera_idx
    if any(scene.cameras.models[c] != "PINHOLE" for c in camera):
        raise SystemExit(f"{task.source.name}: LIMAP needs undistorted PINHOLE images.")
    seen, ends = scene.point_observations, [segments.ends for segments in task.segments]
    neighbors = np.full((len(ends), max(len(row) for row in task.neighbors)), -1)
    for i, row in enumerate(task.neighbors):
        neighbors[i, : len(row)] = row
    pairs = [found.pairs for found in task.matches.values()]
    return {
        "intrinsics": np.array([scene.cameras.params_of(c) for c in camera]),
        "size": np.column_stack([scene.cameras.width[camera], scene.cameras.height[camera]]),
        "pose": scene.cam_from_world,
        "point": scene.points.xyz,
        "observation_image": seen.image_idx,
        "observation_point": seen.point_idx,
        "observation_pixel": seen.pixel,
        "segments": np.concatenate(ends),
        "segment_start": np.cumsum([0, *map(len, ends)]),
        "neighbors": neighbors,
        "match_images": np.array(list(task.matches), int).reshape(-1, 2),
        "match_pairs": np.concatenate([np.empty((0, 2), int), *pairs]),
        "match_start": np.cumsum([0, *map(len, pairs)]),
        "min_length": np.array(LIMAP_MIN_LENGTH.get(task.source.name, task.options.min_length)),
    }


# ------------------------------------------------------------------------------------------------------------- results
def row_of(task: Task, lines: LineSet) -> dict[str, object]:
    """Counts, distances in the images, and agreement with the edges."""
    many = lines.num_images >= 4
    row: dict[str, object] = {
        "contestant": lines.contestant,
        "matching": lines.matching,
        "num_lines": len(lines.ends),
        "in_4_images": int(many.sum()),
        "images_per_line": float(lines.num_images.mean()) if len(many) else 0.0,
        "median_px": float(np.median(reprojection(task, lines))) if len(lines.track) else float("nan"),
        "cpu_s": lines.seconds,
    }
    if task.source.edges is not None:
        row["scores"] = _scores(task.source, lines.ends, task.source.edges)
    if task.source.edges is not None and task.source.box is not None:
        ends, edges = inside(lines.ends, task.source.box), inside(task.source.edges, task.source.box)
        row["inside"] = {"num_lines": len(ends), **_scores(task.source, ends, edges)}
    if task.source.edges is not None and (lines.contestant == "groma, all" or lines.contestant.endswith(", refined")):
        row["curve"] = curve_of(task.source, lines)
    return row


def curve_of(source: LineScene, lines: LineSet) -> list[dict[str, object]]:
    """Scores of the lines of at least some probability, or seen in at least so many images."""
    of_images = lines.sure is None
    sure = lines.num_images if lines.sure is None else lines.sure
    levels = IMAGES if of_images else LEVELS
    curve: list[dict[str, object]] = []
    for level in levels:
        if (sure >= level).any():
            scores = _scores(source, lines.ends[sure >= level], source.edges)
            curve.append({"at_least": level, "num_lines": int((sure >= level).sum()), **scores})
    return curve


def _scores(source: LineScene, ends: np.ndarray, edges: np.ndarray) -> dict[str, list[float]]:
    scores = score_lines(ends, edges, source.thresholds)
    names = ("recall_length", "precision_count", "precision_strict", "precision_length", "inlier_length")
    return {name: [float(v) for v in getattr(scores, name).values()] for name in names}


def inside(ends: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Parts of segments (L, 2, 3) inside a box given by two corners; none of those outside."""
    along = ends[:, 1] - ends[:, 0]
    along = np.where(np.abs(along) < 1e-12, 1e-12, along)
    both = (box[:, None] - ends[:, 0]) / along
    first, last = both.min(0).max(1).clip(0.0), both.max(0).min(1).clip(max=1.0)
    share = np.column_stack([first, last])[first < last]
    ends = ends[first < last]
    return ends[:, :1] + share[:, :, None] * (ends[:, 1:] - ends[:, :1])


def reprojection(task: Task, lines: LineSet) -> np.ndarray:
    """Root mean square distance of each observation's end points from its projected line, pixels."""
    scene = task.source.scene
    line, image, segment = lines.track.T
    measured = np.array([task.segments[i].ends[s] for i, s in zip(image, segment, strict=True)])
    poses = scene.cam_from_world[image]
    squares = np.zeros(len(line))
    model = camera_models.model("PINHOLE")
    local = quaternion.rotate(poses[:, None, :4], lines.ends[line]) + poses[:, None, 4:]
    for c in np.unique(scene.images.camera_idx):
        rows = np.flatnonzero(scene.images.camera_idx[image] == c)
        pixel = model.project(scene.cameras.params_of(c), local[rows].reshape(-1, 3)).reshape(-1, 4)
        projected = segment2.to_line(pixel)
        for k in (0, 2):
            squares[rows] += ((projected[:, :2] * measured[rows, k : k + 2]).sum(1) + projected[:, 2]) ** 2 / 2
    return np.sqrt(squares[np.isfinite(squares)])


def table(source: LineScene, rows: list[dict]) -> str:
    """Return one scene's results as Markdown; thresholds one after the other within a cell."""
    names = {"recall_length": "found %", "precision_count": "right %", "precision_strict": "wholly right %",
             "precision_length": "right length %"}  # fmt: skip
    scored = [name for name in names if rows and "scores" in rows[0]]
    head = ["program", "matches", "lines", "in 4 images", "images per line", "median px", "CPU s"]
    table = [head + [names[name] for name in scored]]
    for row in rows:
        cells = [row["contestant"], row["matching"], row["num_lines"], row["in_4_images"]]
        cells += [f"{row['images_per_line']:.2f}", f"{row['median_px']:.3f}"]
        cells += ["" if np.isnan(row["cpu_s"]) else f"{row['cpu_s']:.1f}"]
        table.append(cells + [_percent(row["scores"][name]) for name in scored])
    taus = ", ".join(f"{tau:.4g}" for tau in source.thresholds)
    text = f"**{source.name}**" + (f", within {taus}" if taus else "") + "\n\n" + _markdown(table, 2)
    if rows and "inside" in rows[0]:
        table = [["program", "matches", "lines", *names.values()]]
        for row in rows:
            part = row["inside"]
            table.append([row["contestant"], row["matching"], part["num_lines"], *(_percent(part[n]) for n in names)])
        text += "\nParts of the lines inside the box in which edges were marked:\n\n" + _markdown(table, 2)
    return text


def _percent(shares: list[float]) -> str:
    return " / ".join(f"{100 * share:.1f}" for share in shares)


def _markdown(table: list[list[object]], num_left: int) -> str:
    rows = ["| " + " | ".join(map(str, cells)) + " |" for cells in table]
    return "\n".join([rows[0], "|" + "---|" * num_left + "--:|" * (len(table[0]) - num_left), *rows[1:]]) + "\n"


def draw(task: Task, lines: LineSet, image: int, target: Path) -> None:
    """Draw the lines over a photograph: blue within the middle threshold of an edge, orange farther away."""
    if task.source.edges is None or not len(lines.ends):
        return
    scene, limit = task.source.scene, task.source.thresholds[len(task.source.thresholds) // 2]
    picture = cv2.cvtColor(task.source.images[image], cv2.COLOR_GRAY2BGR)
    picture = cv2.resize(picture // 2 + 127, None, fx=2, fy=2, interpolation=cv2.INTER_AREA)
    camera = scene.images.camera_idx[image]
    model = camera_models.model(scene.cameras.models[camera])
    near = Distances(Geometry(segments=task.source.edges), limit / 4, 0.0, 2 * limit)
    for ends in lines.ends[np.unique(lines.track[lines.track[:, 1] == image, 0])]:
        places, _ = places_on(ends[None], np.array([40]))
        right = near.of(places) <= limit
        local = quaternion.rotate(scene.cam_from_world[image, :4], places) + scene.cam_from_world[image, 4:]
        pixel = np.round(2 * model.project(scene.cameras.params_of(camera), local) * 16).astype(int)
        for a, b, good in zip(pixel[:-1], pixel[1:], right[1:], strict=True):
            colour = (178, 114, 0) if good else (0, 94, 213)
            cv2.line(picture, tuple(map(int, a)), tuple(map(int, b)), colour, 2, cv2.LINE_AA, 4)
    cv2.imwrite(str(target), picture)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help=f"{', '.join(SCENES)}; or KIND-SEED, a new one")
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of the data sets")
    parser.add_argument("--python-limap", help="Python that has pylimap 2; without it groma runs alone")
    parser.add_argument("--curves", type=Path, help="draw what is right over what is found, .svg")
    parser.add_argument("--cluster-size", type=int, default=0, help="groma maps lines in clusters of so many images")
    parser.add_argument("--matching", choices=MATCHING, help="one kind of matches; default: both")
    arguments = parser.parse_args()
    unknown = {name for name in {*arguments.scenes} - {*SCENES} if not UNSEEN.fullmatch(name)}
    if unknown:
        parser.error(f"no such scene: {', '.join(sorted(unknown))}")
    RESULTS.mkdir(exist_ok=True)
    CACHE.mkdir(parents=True, exist_ok=True)
    texts, results = [], []
    for name in arguments.scenes or SCENES:
        try:
            source = SCENES[name](arguments.data) if name in SCENES else unseen(name)
        except (OSError, ValueError) as error:
            print(f"{name} is left out: {error}")
            continue
        rows, missing = [], ""
        for matching in [arguments.matching] if arguments.matching else MATCHING:
            task = prepare(source, matching, arguments.cluster_size)
            found = run_groma(task)
            rows += [row_of(task, lines) for lines in found]
            if arguments.python_limap:
                print("\n" + table(source, rows), flush=True)  # LIMAP may take ten minutes
                limap = run_limap(task, arguments.python_limap)
                rows += [row_of(task, lines) for lines in limap]
                found += limap
                if not limap:
                    missing += f"\nLIMAP ({matching}) gave no lines: it failed, or was stopped after {TIMEOUT} s.\n"
            for lines in found:
                draw(task, lines, len(source.images) // 2, RESULTS / f"lines-{name}-{matching}-{lines.contestant}.png")
        result = {"scene": name, "thresholds": source.thresholds, "machine": machine(), "rows": rows}
        (RESULTS / f"lines-{name}.json").write_text(json.dumps(result, indent=1) + "\n")
        results.append(result)
        texts.append(table(source, rows) + missing)
        print("\n" + texts[-1], flush=True)
    if arguments.curves:
        arguments.curves.write_text(drawing([result for result in results if "curve" in result["rows"][1]]))
    return 0 if texts else 1


if __name__ == "__main__":
    sys.exit(main())

# SPDX-License-Identifier: BSD-3-Clause
"""Which relations of mapped lines and points are found, and which of those found are right, on rendered scenes.

    python benchmarks/structure.py [SCENE ...] [--cache FOLDER]
    python benchmarks/structure.py --held [SCENE ...]
    python benchmarks/structure.py --exact [SCENE ...]

The faces of these scenes are known, and so are their edges: which lie in one plane, which are parallel, which meet. A
mapped line stands for the edge that it lies on; lines that are no edges of the object are left out. Recall is over all
true pairs of usable lines and points with what enough of them share: a plane of ten points or segment ends, a direction
of four lines. Faces that lie in one plane share it, wherever they are. Lines that meet are asked for where both
are seen up to a tenth of their length from the corner. Maps are kept in the cache, without their structure.

With --exact: lines along directions as found, the same where an edge that is turned by less than half a degree counts
as along, and where the true directions are given exactly, those of four lines or more, or of two, so that only what
belongs to which is to be decided: what the noise of the lines leaves possible.

With --held: what relations bring. The cameras are free, with the exact ones as the start; root mean square of the
centres after the best similarity, of the ends of true edges from their lines, and of the angles between planes
and true ones.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass, fields, replace
from itertools import product
from pathlib import Path

import numpy as np
from _buildings import BuildingSettings, render_building
from _rendered_boxes import BoxSettings, RenderedScene, render_boxes
from _structure_scenes import SCENES
from _workshop import CACHE

from groma.adjustment.adjust import AdjustOptions, adjust
from groma.estimators._direction_features import Parallel
from groma.estimators._parallel_lines import ParallelGates, _anywhere, _members
from groma.evaluation.alignment import align_poses
from groma.features import LsdDetector
from groma.features.close_edges import CloseEdges
from groma.features.contrast import WithContrast
from groma.geometry.algebra import norm, unit
from groma.io import read_archive, write_archive
from groma.mapping.checkpoints import Stages
from groma.mapping.lines.confidence import with_confidence
from groma.mapping.map import adjust_points, find_lines
from groma.mapping.noise.observations import line_end_correlation, noise_px, with_point_noise
from groma.mapping.options import MapOptions
from groma.mapping.structure.find import StructureOptions, _landmarks, find_structure
from groma.mapping.structure.flatness import surface_noise_px
from groma.scene import Directions, Relations, Scene

KINDS = (
    "line_along_direction",
    "within half a degree",
    "line_on_plane",
    "point_on_plane",
    "lines_meeting",
    "parallel",
    "parallel within half a degree",
    "right_angles",
    "right angles within half a degree",
)
#: Lines along directions: columns of --exact, and the lines that an exactly given direction has at least.
ALONG = ("line_along_direction", "within half a degree")
FEWEST = (4, 2)
#: Relations of planes and directions, and the tables they are between.
ANGLES = {
    "parallel": ("parallel_planes", "plane_across_direction", "parallel_directions"),
    "right_angles": ("perpendicular_planes", "plane_along_direction", "perpendicular_directions"),
}
#: Distances from an edge over the distance from the cameras, up to which a line stands for it.
NEAR = 0.0025
#: Angles and distances of true structure, radians and scene units, that are none.
EXACT = 1e-6
#: Edges that are turned by less against each other count as parallel, radians.
PARALLEL = 0.003
#: The same for the columns that tell how many wrong directions and angles are of edges turned by little, less than what
#: is held to be right may deviate.
NEARLY = np.deg2rad(0.5)


@dataclass(frozen=True, eq=False)
class Truth:
    """What the landmarks of a map stand for."""

    #: (L, 2, 3) the edge of each line, NaN for none.
    edges: np.ndarray
    #: (L, K) and (P, K): which planes they lie in.
    line_in_plane: np.ndarray
    point_in_plane: np.ndarray
    #: (L,) number of the direction, -1 for none.
    direction: np.ndarray
    #: (K, 3) normals of the planes.
    normals: np.ndarray
    #: (M, 2) lines whose edges meet, and whether both are seen nearly up to there: others are not asked for.
    meeting: np.ndarray
    seen: np.ndarray


def mapped(name: str, settings: BoxSettings | BuildingSettings, cache: Path) -> tuple[RenderedScene, Scene]:
    """Return a rendered scene and the map of its points and lines, without structure."""
    rendered = render_boxes(settings) if isinstance(settings, BoxSettings) else render_building(settings)
    file = cache / f"{name.replace(' ', '-').replace(',', '')}.npz"
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        options = MapOptions(refine_poses=False, threads=1)
        detector = WithContrast(CloseEdges(LsdDetector(min_length=options.min_segment_length)))  # cameras are held
        segments = [detector.detect(image) for image in rendered.images]
        with tempfile.TemporaryDirectory() as work, Stages(Path(work), name, options) as stages:
            points = with_point_noise(stages.run(adjust_points, rendered.scene))
            lines = stages.run(find_lines, points, segments, None, None, None)
        write_archive(lines.add_to(points, segments), file)
    scene = with_confidence(read_archive(file))
    return rendered, scene.keep(lines=scene.lines.confidence >= MapOptions().min_confidence)


def truth_of(rendered: RenderedScene, scene: Scene) -> Truth:
    """Find the edge of each line, and what edges and points have in common."""
    rendered = replace(rendered, plane_of_face=_planes_of_faces(rendered))
    faces = np.unique(rendered.plane_of_face)
    corners = [rendered.faces[k] for k in faces]
    normals = np.array([np.cross(c[1] - c[0], c[-1] - c[0]) for c in corners])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    edges, meant = _edges_of_faces(rendered)
    owner = _edge_of_lines(scene, edges)
    known = owner >= 0
    own = np.full((scene.num_lines, 2, 3), np.nan)
    own[known] = edges[owner[known]]
    inside = np.zeros((scene.num_lines, len(faces)), bool)
    inside[known] = meant[owner[known]][:, faces]
    way = own[:, 1] - own[:, 0]
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    same = np.abs(np.nan_to_num(way) @ np.nan_to_num(way).T) > np.cos(PARALLEL)
    direction = np.where(known, same.argmax(axis=1), -1)
    point = np.zeros((scene.num_points, len(faces)), bool)
    face = rendered.face_of_point[scene.points.ids - 1]
    point[face >= 0] = rendered.plane_of_face[face[face >= 0]][:, None] == faces
    point &= (np.bincount(scene.point_observations.point_idx, minlength=scene.num_points) >= 3)[:, None]
    enough = point.sum(axis=0) + 2 * inside.sum(axis=0) >= 10
    return Truth(own, inside & enough, point & enough, direction, normals, *_meeting(scene, own))


def _planes_of_faces(rendered: RenderedScene) -> np.ndarray:
    """(F,) number of the plane of each face; faces in one plane, as the tops of boxes of one height, have the same."""
    corners = np.array([face[[0, 1, -1]] for face in rendered.faces])
    hesse = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    hesse /= np.linalg.norm(hesse, axis=1, keepdims=True)
    away = np.abs(np.einsum("ki,fci->kfc", hesse, corners) - np.einsum("ki,ki->k", hesse, corners[:, 0])[:, None, None])
    return (away.max(axis=2) < EXACT)[:, rendered.plane_of_face].argmax(axis=0)


def _edges_of_faces(rendered: RenderedScene) -> tuple[np.ndarray, np.ndarray]:
    """Edges (E, 2, 3), each once, and the planes (E, K) of their own faces and of others through both ends."""
    edges = np.concatenate([np.stack([face, np.roll(face, -1, axis=0)], axis=1) for face in rendered.faces])
    plane = np.repeat(rendered.plane_of_face, 4)
    key = np.sort(np.round(edges, 6).view([("", float)] * 3).reshape(len(edges), 2), axis=1)
    _, first, owner = np.unique(key, axis=0, return_index=True, return_inverse=True)
    inside = np.zeros((len(first), len(rendered.faces)), bool)
    inside[owner.ravel(), plane] = True
    for k in np.unique(rendered.plane_of_face):
        c = rendered.faces[k]
        normal = np.cross(c[1] - c[0], c[-1] - c[0])
        normal /= np.linalg.norm(normal)
        inside[:, k] |= (np.abs((edges[first] - c[0]) @ normal) < EXACT).all(axis=1)
    return edges[first], inside


def _edge_of_lines(scene: Scene, edges: np.ndarray) -> np.ndarray:
    """(L,) the edge that each line lies on, -1 for none."""
    ends = scene.lines.segments
    away = np.linalg.norm(scene.cam_centers_in_world[None] - ends.mean(axis=1)[:, None], axis=2)
    near = NEAR * np.median(away, axis=1)
    way = edges[:, 1] - edges[:, 0]
    share = (
        np.einsum("lnpi,ni->lnp", ends[:, None] - edges[None, :, None, 0], way) / (way**2).sum(axis=1)[None, :, None]
    )
    foot = edges[None, :, None, 0] + np.clip(share, 0.0, 1.0)[..., None] * way[None, :, None]
    distance = np.linalg.norm(ends[:, None] - foot, axis=3).max(axis=2)
    return np.where(distance.min(axis=1) < near, distance.argmin(axis=1), -1)


def _meeting(scene: Scene, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(M, 2) lines whose edges meet, and which meet at a corner and are seen up to a tenth of their length from it."""
    pairs = np.column_stack(np.triu_indices(len(own), 1))
    way = own[:, 1] - own[:, 0]
    length, start = np.linalg.norm(way, axis=1), own[pairs, 0]
    crossed = np.cross(*way[pairs].swapaxes(0, 1))
    size, between = np.linalg.norm(crossed, axis=1), start[:, 1] - start[:, 0]
    kept = size > 0.1 * length[pairs].prod(axis=1)
    pairs, crossed, size, between = pairs[kept], crossed[kept], size[kept, None], between[kept]
    away = np.abs(np.einsum("mi,mi->m", between, crossed)) / size[:, 0]
    other = np.cross(between[:, None], way[pairs][:, ::-1])
    share = np.einsum("mki,mi->mk", other, crossed) / size**2
    near = (away < EXACT) & (np.abs(share - 0.5) < 0.5 + EXACT).all(axis=1)
    pairs, share = pairs[near], share[near]
    seen = (np.abs(np.abs(share - 0.5) - 0.5) < EXACT).all(axis=1)  # at a corner of both
    for line, at in zip(pairs.T, share.T, strict=True):
        ends, place = scene.lines.segments[line], own[line, 0] + at[:, None] * way[line]
        far = np.linalg.norm(ends - place[:, None], axis=2).min(axis=1)
        seen &= far < 0.1 * np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    return pairs, seen


def counts(truth: Truth, scene: Scene) -> dict[str, tuple[int, int, int]]:
    """Of each kind of relation: right ones found, found ones that can be judged, true ones."""
    known = ~np.isnan(truth.edges[:, 0, 0])
    relations, result = scene.relations, {}
    line, direction = relations.line_along_direction.T
    kind = np.array([_usual(truth.direction[line[direction == k]]) for k in range(len(scene.directions))], int)
    judged = known[line]
    way = truth.edges[:, 1] - truth.edges[:, 0]
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    common = np.bincount(truth.direction[known], minlength=scene.num_lines)[truth.direction] * known >= 4
    cosine = np.abs(np.einsum("ni,ni->n", way[line], way[kind[direction]]))
    nearly = judged & (kind >= 0)[direction] & (cosine > np.cos(NEARLY))
    right = judged & (truth.direction[line] == kind[direction])
    for name, ones in (("line_along_direction", right), ("within half a degree", nearly | right)):
        few = int((ones & ~common[line]).sum())  # right, though fewer than are asked for
        result[name] = int(ones.sum()) - few, int(judged.sum()) - few, int(common.sum())
    on_plane = {"line_on_plane": (truth.line_in_plane, known), "point_on_plane": (truth.point_in_plane, None)}
    true_plane, normals = _true_planes(truth, scene)
    for name, (inside, sure) in on_plane.items():
        mark, plane = getattr(relations, name).T
        judged = np.ones(len(mark), bool) if sure is None else sure[mark]
        right = judged & inside[mark, true_plane[plane]]
        pairs = np.unique(np.column_stack([mark, true_plane[plane]])[right], axis=0)
        result[name] = len(pairs), int(judged.sum() - right.sum()) + len(pairs), int(inside.sum())
    known_pairs = known[relations.lines_meeting].all(axis=1)
    found, true = (np.sort(pairs, axis=1) for pairs in (relations.lines_meeting[known_pairs], truth.meeting))
    same = (found[:, None] == true[None]).all(axis=2)
    judged = len(found) - int(same[:, ~truth.seen].sum())  # others are right, though not asked for
    result["lines_meeting"] = int(same[:, truth.seen].sum()), judged, int(truth.seen.sum())
    vectors = np.concatenate([normals, np.where((kind >= 0)[:, None], way[kind], np.nan)])
    return result | _angle_counts(vectors, scene)


def _true_planes(truth: Truth, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Which true plane most of what lies on each plane is on, and its normal; NaN where nothing is on a true one."""
    votes = np.zeros((scene.num_planes, truth.line_in_plane.shape[1]), int)
    for name, inside in (("line_on_plane", truth.line_in_plane), ("point_on_plane", truth.point_in_plane)):
        np.add.at(votes, getattr(scene.relations, name)[:, 1], inside[getattr(scene.relations, name)[:, 0]])
    best = votes.argmax(axis=1) if len(votes) else np.zeros(0, int)
    return best, np.where((votes.max(axis=1, initial=0) > 0)[:, None], truth.normals[best], np.nan)


def _angle_counts(vectors: np.ndarray, scene: Scene) -> dict[str, tuple[int, int, int]]:
    """The same of pairs of planes and directions, the first (N, 3) of which stand for these true vectors."""
    vectors = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    cosine, result = np.abs(vectors @ vectors.T), {}
    is_true = {"parallel": cosine > np.cos(PARALLEL), "right_angles": cosine < np.sin(PARALLEL)}
    first, num = {"planes": 0, "directions": scene.num_planes}, len(vectors)
    for name, kinds in ANGLES.items():
        given = [np.zeros((0, 2), int)]
        for item in fields(Relations):
            if item.name in kinds:
                given.append(getattr(scene.relations, item.name) + [first[table] for table in item.metadata["refers"]])
        pairs = np.concatenate(given)
        pairs = pairs[(pairs < num).all(axis=1)]
        judged = pairs[np.isfinite(cosine[pairs[:, 0], pairs[:, 1]])]
        right = is_true[name][judged[:, 0], judged[:, 1]]
        nearly = cosine > np.cos(NEARLY) if name == "parallel" else cosine < np.sin(NEARLY)
        result[name] = int(right.sum()), len(judged), int(np.triu(is_true[name], 1).sum())
        turned = int(nearly[judged[:, 0], judged[:, 1]].sum())
        result[f"{name} within half a degree".replace("_", " ")] = turned, len(judged), int(np.triu(nearly, 1).sum())
    return result


def held(rendered: RenderedScene, scene: Scene) -> dict[str, tuple[float, ...]]:
    """Errors of centres, line ends (thousandths of a scene unit) and normals (mrad) with more and more relations."""
    exact, truth, found = rendered.scene, truth_of(rendered, scene), find_structure(scene, StructureOptions())
    edges, normals = truth.edges, _true_planes(truth, found)[1]
    is_plane = np.isfinite(normals[:, 0])
    known = np.flatnonzero(~np.isnan(edges[:, 0, 0]))
    angles, off = {kind: [] for kinds in ANGLES.values() for kind in kinds}, {}
    chosen = {"no relations": Relations(), "without angles": found.relations.take(**angles), "all": found.relations}
    end_correlation = line_end_correlation(scene)
    options = AdjustOptions(
        point_sigma_px=noise_px(scene, "points"), line_sigma_px=noise_px(scene, "lines", end_correlation),
        line_end_correlation=end_correlation, loss="cauchy", loss_scale=4.0, threads=1, check_lens=False,
        structure_sigma_px=surface_noise_px(found, StructureOptions()),
    )  # fmt: skip
    for name, relations in chosen.items():
        adjusted = adjust(found.replace(relations=relations), options).scene
        adjusted = adjusted.transformed(align_poses(adjusted.cam_from_world, exact.cam_from_world))
        moment, way = adjusted.lines.plucker[known, None, :3], adjusted.lines.plucker[known, None, 3:]
        far = np.linalg.norm(np.cross(edges[known], way) - moment, axis=2)
        shift = np.linalg.norm(adjusted.cam_centers_in_world - exact.cam_centers_in_world, axis=1)
        tilt = np.linalg.norm(np.cross(adjusted.planes.hesse[is_plane, :3], normals[is_plane]), axis=1)
        errors = (shift, far) if name == "no relations" else (shift, far, tilt)
        off[name] = tuple(1e3 * float(np.sqrt(np.mean(one**2))) for one in errors)
    return off


def along_exact(truth: Truth, scene: Scene, fewest: int) -> Scene:
    """Lines along the true directions of enough lines: the mixture of the search, and its noise, by likelihood."""
    options, gates = StructureOptions(), ParallelGates()
    marks = _landmarks(scene, options, None)
    lines, length = np.flatnonzero(marks.line_usable), norm(marks.segments[:, 1] - marks.segments[:, 0])
    group, number = np.unique(truth.direction[lines], return_counts=True)
    vectors = unit((truth.edges[:, 1] - truth.edges[:, 0])[group[(group >= 0) & (number >= fewest)]])
    covariance, best = marks.own_line_noise.directions(length)[lines], (-np.inf, np.zeros((1, len(lines))))
    for px, angle in product(
        (0.0, *gates.deviations), options.directions.parallel_sigma * 2.0 ** np.arange(gates.angles)
    ):
        turned = np.hypot(angle, px * np.sqrt(2.0) * marks.line_pixel[lines] / length[lines])
        pool = Parallel.of(scene.lines.plucker[lines, 3:], covariance, turned)
        density = np.vstack([_members(pool, vectors), _anywhere(pool)])
        share = np.full((len(density), 1), 1.0 / len(density))
        for _ in range(gates.rounds):
            mixed = np.log(share) + density
            total = np.logaddexp.reduce(mixed, axis=0)
            share = np.exp(mixed - total).mean(axis=1, keepdims=True)
        if total.sum() > best[0]:
            best = total.sum(), np.exp(mixed - total)[:-1]
    rows = np.flatnonzero(best[1].max(axis=0, initial=0.0) > options.min_direction_probability)
    pairs = np.column_stack([lines[rows], best[1][:, rows].argmax(axis=0)]) if len(rows) else np.zeros((0, 2), int)
    return Scene(
        lines=scene.lines,
        directions=Directions(np.arange(len(vectors)) + 1, vectors),
        relations=Relations(line_along_direction=pairs),
    )


def _usual(labels: np.ndarray) -> int:
    """Most frequent label that is not negative, -1 if there is none."""
    labels = labels[labels >= 0]
    return int(np.bincount(labels).argmax()) if len(labels) else -1


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "scenes", nargs="*", metavar="SCENE", help="all by default; also: chosen, reported, fresh, later, last, unseen"
    )
    parser.add_argument("--cache", type=Path, default=CACHE / "structure")
    parser.add_argument("--held", action="store_true", help="what relations bring to cameras and lines")
    parser.add_argument("--exact", action="store_true", help="directions given: which lines are along which")
    given = parser.parse_args()
    everything = {name: settings for group in SCENES.values() for name, settings in group.items()}
    names = [name for one in given.scenes or SCENES for name in SCENES.get(one, [one])]
    if given.held:
        _print_held({name: everything[name] for name in names}, given.cache)
        return
    kinds = (*ALONG, *(f"directions of {fewest} lines" for fewest in FEWEST)) if given.exact else KINDS
    print("Recall / precision, per cent (true ones)\n")
    print("| scene | " + " | ".join(kind.replace("_", " ") for kind in kinds) + " |")
    print("|---" + "|---:" * len(kinds) + "|")
    total = dict.fromkeys(kinds, np.zeros(3, int))
    for name in names:
        rendered, scene = mapped(name, everything[name], given.cache)
        truth = truth_of(rendered, scene)
        found = counts(truth, find_structure(scene, StructureOptions()))
        if given.exact:
            exact = [counts(truth, along_exact(truth, scene, fewest))[ALONG[0]] for fewest in FEWEST]
            found |= dict(zip(kinds[len(ALONG) :], exact, strict=True))
        print(f"| {name} | " + " | ".join(_cell(found.get(kind, (0, 0, 0))) for kind in kinds) + " |", flush=True)
        total = {kind: total[kind] + np.array(found.get(kind, (0, 0, 0))) for kind in kinds}
    print("| all | " + " | ".join(_cell(total[kind]) for kind in kinds) + " |")


def _print_held(scenes: dict[str, BoxSettings | BuildingSettings], cache: Path) -> None:
    print("Root mean square of centres, of ends of edges from their lines, thousandths, and of normals, mrad\n")
    for number, (name, settings) in enumerate(scenes.items()):
        off = held(*mapped(name, settings, cache))
        if number == 0:
            print("| scene | " + " | ".join(off) + " |\n|---" + "|---:" * len(off) + "|")
        print(
            f"| {name} | " + " | ".join(", ".join(f"{one:.3g}" for one in errors) for errors in off.values()) + " |",
            flush=True,
        )


def _cell(count: tuple[int, int, int] | np.ndarray) -> str:
    right, judged, true = count
    return f"{100 * right / max(true, 1):.1f} / {100 * right / max(judged, 1):.1f} ({true})"


if __name__ == "__main__":
    main()

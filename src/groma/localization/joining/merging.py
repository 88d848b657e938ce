# SPDX-License-Identifier: BSD-3-Clause
"""Two maps of one place: photographs of one are localised in the other, which matches points and lines of both.

A photograph of the second map that is found in the first shows points and lines whose places both maps know. All such
pairs together give the motion between the worlds (:mod:`groma.estimators.motion`), with a scale where that is open.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from groma._typing import FloatArray, IntArray
from groma.errors import InputError
from groma.estimators.motion.estimation import Motion, estimate_motion
from groma.estimators.motion.groups import Kind
from groma.estimators.motion.matches import LandmarkMatches
from groma.features.segments import SEGMENTS
from groma.gates import gate
from groma.geometry.segment2 import segments_apart
from groma.geometry.so3 import hat
from groma.localization.joining.measurements import with_measurements_of
from groma.localization.localizer import LocalizedImage, Localizer
from groma.localization.map_index import Progress
from groma.localization.pose.camera import QueryCamera
from groma.localization.pose.hypotheses import max_errors
from groma.localization.pose.verdict import moved as way_between
from groma.localization.posed_model import gather_photographs, with_photographs
from groma.localization.stored import StoredImage
from groma.mapping.carried.kept_lines import with_lines_of
from groma.mapping.noise.landmarks import project_points
from groma.mapping.photographs import content_digest
from groma.scene import Scene, Similarity


@dataclass(frozen=True)
class MergeGates:
    """How landmarks of two maps are found to be the same."""

    photographs: int = gate(24, "images", "of the second map that are looked for in the first", "cost: linear in it")
    same_place: float = gate(0.5, "px", "distance of the same feature, found twice", "convention: half a pixel")
    growth: float = gate(2.0, "1", "of the noise, until half of the matches agree", "convention: doubling")
    doublings: int = gate(6, "steps", "of the noise: that of landmarks lacks errors of poses", "cost: of estimates")


GATES = MergeGates()


@dataclass(frozen=True, eq=False)
class MergedModel:
    """The photographs of two maps in one world, ready to be mapped."""

    #: All of them with poses in the world of the first map, and points.
    scene: Scene
    #: The folder with links to all of them.
    folder: Path
    #: The two maps, and what their images are called in the scene.
    maps: tuple[Scene, Scene]
    names: tuple[tuple[str, ...], tuple[str, ...]]
    #: (n, 2) lines of the second map and of the first that are the same.
    same_lines: IntArray
    #: first_from_second.
    motion: Motion
    #: Matched points and lines, and photographs that both maps have.
    num_points: int
    num_lines: int
    num_common: int
    #: What was measured of the second map and does not hold here, in words; empty if nothing.
    left_out: str

    @property
    def map(self) -> Scene:
        """The first map."""
        return self.maps[0]

    def with_lines(self, scene: Scene) -> Scene:
        """Return what was mapped of the model, with lines of both maps that were not found anew."""
        return with_lines_of(scene, self.maps, self.names, self.same_lines, SEGMENTS.on)

    def sentence(self) -> str:
        """Say how the maps were joined."""
        agree = int(self.motion.point_inliers.sum()), int(self.motion.line_inliers.sum())
        scale, sigma = self.motion.similarity[7], np.sqrt(self.motion.covariance[-1, -1])
        told = f"scale {scale:.4f} ± {scale * sigma:.4f}" if self.motion.kind == "similarity" else "scale kept"
        common = f"; {self.num_common} photographs are in both" if self.num_common else ""
        return (
            f"Joined by {agree[0]:,} of {self.num_points:,} matched points and {agree[1]:,} of {self.num_lines:,} "
            f"matched lines: {told}{common}."
        )


def merged_model(first: Localizer, second: Localizer, folder: Path, kind: Kind, say: Progress) -> MergedModel:
    """Return the model of the photographs of two maps.

    Parameters
    ----------
    first, second
        The maps; the result is in the world of the first.
    folder
        Made here: links to all photographs.
    kind
        ``similarity``, or ``rigid`` where both maps have the same scale.
    say, gates
        Progress, and how landmarks are matched.

    Raises
    ------
    InputError
        If the maps share no place that is recognised, or what they share does not determine the motion.
    """
    found = _found(first, second, say)
    matches, same_lines = _matches(first, second, found)
    motion = _motion(matches, kind)
    moved = second.scene.transformed(Similarity.from_array(motion.similarity))
    poses = {image: _pose_of(moved, image, one) for image, one in found.items()}
    known = {content_digest(path): row for row, path in enumerate(first.files)}
    digests = [content_digest(path) for path in second.files]
    is_fresh = np.array([digest not in known for digest in digests])
    fresh = np.flatnonzero(is_fresh).tolist()
    stored = [_as_stored(moved, row, poses.get(row)) for row in fresh]
    paths = [*first.files, *(second.files[row] for row in fresh)]
    scene = with_photographs(first.scene, first.index, stored, paths, say)
    gather_photographs(folder, dict(zip(scene.images.names, paths, strict=True)))
    place = {row: first.scene.num_images + number for number, row in enumerate(fresh)}
    images = np.array([place.get(row, known.get(digest, 0)) for row, digest in enumerate(digests)])
    called = tuple(scene.images.names[image] for image in images.tolist())
    scene, left_out = with_measurements_of(
        scene, first.scene, second.scene, Similarity.from_array(motion.similarity), images, is_fresh
    )
    return MergedModel(
        scene, folder, (first.scene, second.scene), (first.scene.images.names, called),
        same_lines[motion.line_inliers], motion, len(matches) - matches.num_lines, matches.num_lines,
        len(second.files) - len(fresh), left_out,
    )  # fmt: skip


def _motion(matches: LandmarkMatches, kind: Kind) -> Motion:
    """The motion by the least noise at which half of the matches agree; else that with which most do."""
    best, refused = None, None
    for step in range(GATES.doublings):
        factor = GATES.growth**step
        noisier = (matches.line_sigma * factor, matches.point_sigma * factor)
        noisy = LandmarkMatches.of(
            matches.lines_in_a, matches.lines_in_b, matches.points_in_a, matches.points_in_b, noisier
        )
        try:
            found = estimate_motion(noisy, kind)
        except InputError as error:
            refused = error
            continue
        agree = found.line_inliers.sum() + found.point_inliers.sum()
        if best is None or agree > best[0]:
            best = agree, found
        if 2 * agree >= len(matches):
            break
    if best is None:
        raise InputError(f"The maps cannot be joined. {refused}")
    return best[1]


def _found(first: Localizer, second: Localizer, say: Progress) -> dict[int, LocalizedImage]:
    """Photographs of the second map that are found in the first, by their number."""
    count = second.scene.num_images
    chosen = np.unique(np.linspace(0, count - 1, min(count, GATES.photographs)).astype(int))
    out, sentence = {}, ""
    for done, image in enumerate(chosen.tolist()):
        say("looking for photographs of the second map in the first", done, len(chosen))
        camera = QueryCamera.of(second.scene.cameras, int(second.scene.images.camera_idx[image]))
        found = first.localize(second.files[image], camera)
        sentence = found.pose.sentence
        if found.pose.status == "localized":
            out[image] = found
    if not out:
        raise InputError(f"The maps cannot be joined: no photograph of the second is found in the first. {sentence}")
    return out


def _matches(first: Localizer, second: Localizer, found: dict[int, LocalizedImage]) -> tuple[LandmarkMatches, IntArray]:
    """Points and lines of the second map (a) and of the first (b) that are the same; and rows of the lines."""
    points, lines = Counter[tuple[int, int]](), Counter[tuple[int, int]]()
    for image, one in found.items():
        points.update(map(tuple, _same_points(second, image, one).tolist()))
        lines.update(map(tuple, _same_lines(second, image, one).tolist()))
    pairs, line_pairs = _one_to_one(points), _one_to_one(lines)
    a, b = second.index, first.index
    of_points = np.column_stack(
        [_point_sigma(a.point_covariance[pairs[:, 0]]), _point_sigma(b.point_covariance[pairs[:, 1]])]
    )
    segments = second.scene.lines.segments[line_pairs[:, 0]], first.scene.lines.segments[line_pairs[:, 1]]
    of_lines = np.column_stack(
        [_line_sigma(one, covariance) for one, covariance in zip(
            segments, (a.line_covariance[line_pairs[:, 0]], b.line_covariance[line_pairs[:, 1]]), strict=True)]
    )  # fmt: skip
    sure = np.isfinite(of_lines).all(axis=1) & (of_lines > 0).all(axis=1)
    good = np.isfinite(of_points).all(axis=1) & (of_points > 0).all(axis=1)
    matches = LandmarkMatches.of(
        segments[0][sure], segments[1][sure], a.xyz[pairs[good, 0]], b.xyz[pairs[good, 1]],
        (of_lines[sure], of_points[good]),
    )  # fmt: skip
    return matches, line_pairs[sure]


def _same_points(second: Localizer, image: int, found: LocalizedImage) -> IntArray:
    """Pairs (n, 2) of points of the second map and of the first that one photograph shows at one place."""
    index = second.index
    rows = np.arange(int(index.begin[image]), int(index.begin[image + 1]))
    pixels = found.pose.matches.points2d[found.pose.point_inliers]
    if not len(rows) or not len(pixels):
        return np.zeros((0, 2), np.int64)
    near = KDTree(index.pixel[rows]).query(pixels, distance_upper_bound=GATES.same_place)
    distance, nearest = np.asarray(near[0]), np.asarray(near[1])
    hit = np.flatnonzero(np.isfinite(distance))
    return np.column_stack(
        [index.point[rows[nearest[hit]]], found.point[np.flatnonzero(found.pose.point_inliers)[hit]]]
    )


def _same_lines(second: Localizer, image: int, found: LocalizedImage) -> IntArray:
    """Pairs (n, 2) of lines of the second map and of the first of which one photograph shows one segment."""
    seen = second.scene.line_observations
    rows = np.flatnonzero(seen.image_idx == image)
    inliers = np.flatnonzero(found.pose.line_inliers)
    query = found.pose.matches.segments2d[inliers].reshape(-1, 2, 2)
    if not len(rows) or not len(query):
        return np.zeros((0, 2), np.int64)
    off = segments_apart(query.reshape(-1, 4), seen.segment[rows])
    nearest = off.argmin(axis=1)
    hit = np.flatnonzero(off[np.arange(len(query)), nearest] < SEGMENTS.on)
    return np.column_stack([seen.line_idx[rows[nearest[hit]]], found.line[inliers[hit]]])


def _one_to_one(votes: Counter[tuple[int, int]]) -> IntArray:
    """The pairs (n, 2) that most photographs show, each side once."""
    taken: tuple[set[int], set[int]] = set(), set()
    out = []
    for (one, two), _ in votes.most_common():
        if one not in taken[0] and two not in taken[1]:
            taken[0].add(one)
            taken[1].add(two)
            out.append((one, two))
    return np.array(out, np.int64).reshape(-1, 2)


def _point_sigma(covariance: FloatArray) -> FloatArray:
    return np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 3.0)


def _line_sigma(segments: FloatArray, covariance: FloatArray) -> FloatArray:
    """Standard deviations (n,) of the ends of segments across their lines, from covariances (n, 6, 6) of (m, d)."""
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    total = np.zeros(len(segments))
    for end in (0, 1):
        jacobian = np.concatenate([np.tile(-np.eye(3), (len(segments), 1, 1)), hat(segments[:, end])], axis=2)
        total += np.einsum("nij,njk,nik->n", jacobian, covariance, jacobian)
    # Of lines whose direction has length one; two coordinates across at each of two ends.
    return np.where(length > 0, np.sqrt(total / 4.0), np.nan)


def _pose_of(moved: Scene, image: int, found: LocalizedImage) -> FloatArray:
    """The pose (7,) of a photograph that both maps tell: its own, unless more agrees with that in the first map.

    A thing whose sides look alike is found at the wrong side by a few photographs; their own map then knows better.
    """
    pose, matches = found.pose, found.pose.matches
    assert pose.cam_from_world is not None
    lines = matches.segments3d[pose.line_inliers].mean(axis=1)
    places = np.concatenate([matches.points3d[pose.point_inliers], lines])
    own = moved.cam_from_world[image]
    way = way_between(pose.camera, own, pose.cam_from_world, places)
    # Under its own pose half of what agrees with the first map would not.
    limit = max_errors(matches)[0]
    if way <= limit:
        return own
    seen = moved.point_observations
    seen = seen.take(np.flatnonzero(seen.image_idx == image))
    pixel = project_points(moved, seen.image_idx, moved.points.xyz[seen.point_idx])[0]
    agree = np.linalg.norm(pixel - seen.pixel, axis=1) <= limit
    return own if agree.sum() > pose.point_inliers.sum() else pose.cam_from_world


def _as_stored(scene: Scene, image: int, pose: FloatArray | None) -> StoredImage:
    """An image of a scene as a photograph with a pose, its own unless another is given."""
    camera = QueryCamera.of(scene.cameras, int(scene.images.camera_idx[image]))
    none = np.zeros(0, np.int64)
    own = scene.cam_from_world[image] if pose is None else pose
    return StoredImage(
        scene.images.names[image], "localized", "", own, np.zeros((6, 6)), camera.model,
        camera.params, np.array([camera.width, camera.height]), none, np.zeros((0, 2)), none, np.zeros((0, 4)), 0.0,
    )  # fmt: skip

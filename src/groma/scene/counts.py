# SPDX-License-Identifier: BSD-3-Clause
"""What a scene holds, as numbers and as words."""

from typing import TYPE_CHECKING

from groma._counted import counted

if TYPE_CHECKING:
    from groma.scene.scene import Scene


def counts_of(scene: "Scene") -> dict[str, int]:
    """Number of images, landmarks and observations under the names of the machine-readable reports."""
    return {
        "num_images": scene.num_images,
        "num_points": scene.num_points,
        "num_lines": scene.num_lines,
        "num_planes": scene.num_planes,
        "num_observations": scene.num_observations,
    }


def sentence_of(scene: "Scene", *kinds: str) -> str:
    """Return for example ``16 images, 22,106 points, 83,718 observations``; of some ``kinds`` only, if named."""
    counts = {name.removeprefix("num_"): count for name, count in counts_of(scene).items()}
    said = [counted(counts[kind], kind) for kind in kinds or counts if counts[kind] or kind == "images"]
    return ", ".join(said) or "nothing"


def num_relations(scene: "Scene") -> dict[str, int]:
    """Number of relations between landmarks, by kind; only kinds that there are."""
    counts = {kind: len(getattr(scene.relations, kind)) for kind in scene.relations.kinds()}
    return {kind: count for kind, count in counts.items() if count}


def has_weights(scene: "Scene") -> bool:
    """Whether observations in images have different standard deviations, relative to a common one."""
    tables = scene.point_observations.sigma, scene.line_observations.sigma
    return any(len(sigma) > 0 and sigma.min() < sigma.max() for sigma in tables)


def measurements_of(scene: "Scene") -> dict[str, int]:
    """Number of measurements besides those of points and lines in images, by kind; only kinds that there are."""
    counts = {
        "point depths": len(scene.point_depths),
        "right columns": len(scene.right_columns),
        "line depths": len(scene.line_depths),
        "plane observations": len(scene.plane_observations),
        "pose priors": len(scene.pose_priors),
        "camera motions": len(scene.camera_motions),
        "camera positions": len(scene.camera_positions),
        "camera poses": len(scene.camera_poses),
        "control points": len(scene.control_points),
        "marks": len(scene.marks),
        "distances": len(scene.distances),
        "known planes": len(scene.known_planes),
        "known directions": len(scene.known_directions),
        "held objects": len(scene.held),
    }
    return {name: count for name, count in counts.items() if count}

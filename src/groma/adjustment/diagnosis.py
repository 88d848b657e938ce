# SPDX-License-Identifier: BSD-3-Clause
"""The diagnosis of a scene: :func:`groma.solver.observability.diagnosis.diagnose` with the scene's own names."""

from __future__ import annotations

from dataclasses import replace

from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.moved_problem import problem_at
from groma.adjustment.terms.open_motions import num_open_motions
from groma.problem.problem import Problem
from groma.scene import Scene
from groma.scene.checks import check_scene_given
from groma.scene.local_frame import local_frame
from groma.solver.observability.diagnosis import Diagnosis, diagnose

#: Commands diagnose larger scenes on request only (cost: time).
MANY_IMAGES = 300


def diagnose_scene(
    scene: Scene, options: AssemblyOptions | None = None, problem: Problem | None = None, threads: int = 1
) -> Diagnosis:
    """Report in sentences which quantities the observations of a scene do not determine.

    Parameters
    ----------
    scene : Scene
        An adjusted scene, or a start.
    options : AssemblyOptions, optional
        What is assembled from the scene, and its noise; by default that of :class:`AssemblyOptions`.
    problem : Problem, optional
        The problem already made from the scene, at its solution; saves making it again.
    threads : int
        Threads for the linearisation.

    Returns
    -------
    Diagnosis
        Cameras are identified by the names of their images, landmarks by their identifiers.
    """
    check_scene_given(scene)
    near = local_frame(scene)
    if near is not None:
        scene = scene.transformed(near)
        problem = None if problem is None else problem_at(problem, scene)
    if problem is None:
        unknown = AssemblyOptions(refine_intrinsics=None, refine_principal_point=None)
        problem = assemble(scene, options or unknown).problem
    first_image = {int(frame): k for k, frame in reversed(list(enumerate(scene.images.frame_idx)))}
    ids = {"points": scene.points.ids, "lines": scene.lines.ids, "planes": scene.planes.ids}
    ids["directions"] = scene.directions.ids

    def name(group: str, index: int) -> str:
        if group == "frames":
            return f"image {scene.images.names[first_image[index]]}" if index in first_image else f"frame {index}"
        if group in ids:
            return f"{group.removesuffix('s')} {int(ids[group][index])}"
        if group.startswith("intrinsics/"):
            return f"calibration {index} ({group.removeprefix('intrinsics/')})"
        return f"{group.removesuffix('s')} {index}"

    found = diagnose(problem, name, threads=threads)
    held = found.num_free_motions and scene.has_survey and num_open_motions(scene) == 0
    return _held_by_measurements(found) if held else found


def _held_by_measurements(found: Diagnosis) -> Diagnosis:
    """Return the message for measurements that hold the frame so weakly that it is lost in rounding errors."""
    sentences = {
        "determined": "Everything is determined by the data.",
        "free_motions": "The frame is held by the measurements alone, which weigh little beside the images.",
    }
    findings = tuple(replace(one, sentence=sentences.get(one.kind, one.sentence)) for one in found.findings)
    return replace(found, free_motions=(), num_free_motions=0, findings=findings)

# SPDX-License-Identifier: BSD-3-Clause
"""New photographs in a map: localised in it, those that only see each other in turns; then a model of all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from groma._counted import counted
from groma.adjustment.terms.principal_points import near_the_middle
from groma.errors import InputError
from groma.evaluation.alignment import align_poses
from groma.io.colmap.masks import Masks
from groma.localization.calibration import CalibrationChoice
from groma.localization.localizer import Localizer
from groma.localization.map_index import Progress
from groma.localization.posed_model import gather_photographs, with_photographs
from groma.localization.registered import QUERY
from groma.localization.run import localize_images
from groma.localization.stored import StoredImage
from groma.mapping.photographs import content_digest
from groma.mapping.result import MapResult
from groma.scene import Scene, Similarity
from groma.scene.table import joined


@dataclass(frozen=True, eq=False)
class ExtendedModel:
    """The photographs of a map and new ones, ready to be mapped."""

    #: All of them with poses in the world of the map, and points.
    scene: Scene
    #: The folder with links to all of them, by their names.
    folder: Path
    #: The map before.
    map: Scene
    #: What became of the new ones.
    queries: tuple[StoredImage, ...]
    #: Photographs that the map has already.
    num_known: int = 0
    #: What may be used of all of them.
    masks: Masks | None = None

    def warnings(self) -> list[str]:
        """Say which photographs are left out."""
        known = [f"Left out, as the map has them already, or as copies: {counted(self.num_known, 'photographs')}."]
        known = known if self.num_known else []
        left = [one for one in self.queries if one.status != "localized"]
        if not left:
            return known
        named = "; ".join(f"{one.name} ({one.status}: {one.sentence})" for one in left[:3])
        more = f"; and {len(left) - 3} more" if len(left) > 3 else ""
        return [
            *known,
            f"Left out, as the map does not tell where: {len(left)} of {len(self.queries)} photographs. {named}{more}",
        ]


def extended_model(
    localizer: Localizer,
    files: Mapping[str, Path],
    work: Path,
    folder: Path,
    choice: CalibrationChoice,
    say: Progress,
    masks: Masks | None = None,
) -> ExtendedModel:
    """Return the model of a map and new photographs.

    Parameters
    ----------
    localizer
        The map.
    files
        The new photographs by name; those that the map has are left out.
    work
        Folder where localised ones are kept.
    folder
        Made here: links to all photographs.
    choice
        Where calibrations come from.
    say
        Progress.
    masks
        What may be used of the photographs.

    Raises
    ------
    InputError
        If no photograph is found in the map, or it has all of them already.
    """
    num_given, files = len(files), _without_known(files, localizer.files)
    if not files:
        raise InputError(f"The map has all of the {counted(num_given, 'photographs')} already. Pass new ones.")
    if masks is not None:  # of new photographs also by the names that they have in the model
        masks = replace(masks, files=masks.files + tuple((f"{QUERY}{name}", *rest) for name, *rest in masks.files))
    before, done = localizer.scene, dict[str, StoredImage]()
    waiting, scene = dict(files), localizer.scene
    for turn in range(len(files)):
        found = localize_images(localizer, waiting, work / str(turn), choice, say, masks)
        done |= {one.name: one for one in found}
        placed = [one for one in found if one.status == "localized"]
        if not placed and turn == 0:
            raise InputError(f"None of the {len(files)} photographs is found in the map: {found[0].sentence}")
        if not placed:
            break
        waiting = {one.name: waiting[one.name] for one in found if one.status != "localized"}
        paths = [*localizer.files, *(files[one.name] for one in placed)]
        scene = with_photographs(localizer.scene, localizer.index, placed, paths, say, masks)
        scene = _with_new_lenses(scene, localizer.scene)
        gather_photographs(folder, dict(zip(scene.images.names, paths, strict=True)))
        if not waiting:
            break
        # What shows nothing of the map may show what the photographs do that are in it now.
        localizer = Localizer(scene, folder, options=localizer.options, progress=say)
    return ExtendedModel(scene, folder, before, tuple(done[name] for name in files), num_given - len(files), masks)


def _with_new_lenses(scene: Scene, before: Scene) -> Scene:
    """Return a scene in which calibrations of new cameras are estimated, but for those taken from a given one."""
    table, known = near_the_middle(scene).principal_point_priors, before.cameras
    given = np.setdiff1d(np.arange(len(known)), before.principal_point_priors.camera_idx)
    calibrated = {(known.models[row], *known.params_of(row).tolist()) for row in given.tolist()}
    lens = [(scene.cameras.models[row], *scene.cameras.params_of(row).tolist()) for row in table.camera_idx.tolist()]
    new = (table.camera_idx >= len(known)) & np.array([one not in calibrated for one in lens], bool)
    return scene.replace(principal_point_priors=joined(before.principal_point_priors, table.take(new)))


def _without_known(files: Mapping[str, Path], known: Sequence[Path]) -> dict[str, Path]:
    """Return the photographs that are no copies of known ones or of each other; what cannot be read is kept."""
    digests, fresh = {content_digest(path) for path in known}, dict(files)
    for name, path in files.items():
        with suppress(OSError):
            if (digest := content_digest(path)) in digests:
                del fresh[name]
            digests.add(digest)
    return fresh


def in_world_of(result: MapResult, before: Scene) -> MapResult:
    """Return a map in the world of the one that it extends, by the poses of the images that both have.

    Where measurements say where it is, it is there; where they tell its scale, that stays.
    """
    place = {name: row for row, name in enumerate(result.scene.images.names)}
    both = [(place[name], row) for row, name in enumerate(before.images.names) if name in place]
    scene = result.scene
    placed = scene.camera_positions, scene.camera_poses, scene.control_points, scene.pose_priors
    if len(both) < 2 or scene.is_tied or any(map(len, placed)):
        return result
    now, then = np.array(both).T
    poses = scene.cam_from_world[now], before.cam_from_world[then]
    moved: Similarity = align_poses(*poses, with_scale=not scene.has_scale)
    scenes = {name: getattr(result, name).transformed(moved) for name in ("scene", "before", "adjusted")}
    return replace(result, **scenes)

# SPDX-License-Identifier: BSD-3-Clause
"""The output of an earlier track as a map: where the frames of its keyframes are, and what was made of them."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, cast

from groma.bounded.documents import read_document
from groma.errors import GromaError, InputError
from groma.io import read_scene
from groma.io.sequences import Kind, open_sequence
from groma.io.sequences.frame import Frame
from groma.scene import Scene
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.map.saved_map import is_metric, map_of_scene
from groma.tracking.map.track_map import TrackMap
from groma.tracking.options import TrackOptions


@dataclass(frozen=True)
class FrameSource:
    """A sequence on disk, how it was opened, and which of its frames are keyframes."""

    path: str
    camera: str | None = None
    depth_scale: float | None = None
    kind: Kind | None = None
    #: Its masks, a folder or one image for all.
    masks: str | None = None
    #: Name of the image in the scene -> name of the frame.
    images: dict[str, str] = field(default_factory=dict)

    @classmethod
    def of(
        cls, path: str | os.PathLike[str], camera: str | None = None, masks: Path | None = None, **how: Any
    ) -> FrameSource:
        """Return a source with full paths."""
        if camera is not None and os.path.exists(camera):
            camera = os.path.abspath(camera)
        return cls(os.path.abspath(path), camera, masks=None if masks is None else os.path.abspath(masks), **how)

    def with_images(self, names: tuple[str, ...], frames: set[str]) -> FrameSource:
        """Return the source with the images of a scene that are frames of it."""
        found = {}
        for name in names:
            frame = name if name in frames else name.partition("_")[2]
            if frame in frames:
                found[name] = frame
        return replace(self, images=found)

    def read(self) -> dict[str, Frame]:
        """Return the frames of the images, by image.

        Raises
        ------
        InputError
            If the sequence is not there any more, or some of its frames are not.
        """
        how = {"camera": self.camera, "depth_scale": self.depth_scale, "kind": self.kind, "masks": self.masks}
        sequence = open_sequence(self.path, **how)
        wanted = {frame: image for image, frame in self.images.items()}
        found: dict[str, Frame] = {}
        for frame in sequence:
            if frame.name in wanted:
                found[wanted[frame.name]] = frame
                if len(found) == len(wanted):
                    break
        missing = sorted(set(self.images) - set(found))
        if missing:
            raise InputError(
                f"{len(missing)} of the {len(self.images)} keyframes of the map are not in {self.path}, for example "
                f"{self.images[missing[0]]!r}. Restore the sequence, or track it again."
            )
        return found


@dataclass(frozen=True, eq=False)
class SavedMap:
    """The map of an earlier track."""

    path: str
    scene: Scene
    sources: tuple[FrameSource, ...]

    def track_map(
        self, camera: TrackCamera, metric: bool, options: TrackOptions, say: Callable[[int, int], None]
    ) -> TrackMap:
        """Return what the tracker tracks in.

        Raises
        ------
        InputError
            If the map cannot be one of the sequence: another camera, no scale, frames that are gone.
        """
        if metric and not is_metric(self.scene):
            raise InputError(
                f"The map {self.path} is of a single camera and has no scale; the sequence has depths. Pass --kind "
                "mono, or a map of a sequence with depths."
            )
        frames = {image: frame for source in self.sources for image, frame in source.read().items()}
        return map_of_scene(self.scene, frames, camera, options, say)


def read_saved_map(folder: str | os.PathLike[str]) -> SavedMap:
    """Read OUT of ``groma track``.

    Raises
    ------
    InputError
        If it is something else, or does not name its frames.
    """
    path = Path(folder)
    if not path.exists():
        raise InputError(f"{path} does not exist. Pass OUT of groma track as the map.")
    remedy = "Pass OUT of groma track, made of a sequence on disk."
    missing = f"{path} is no map to track in: its summary.json does not tell"
    try:
        told = read_document(path / "summary.json")
        of_photographs = "sources" not in told and isinstance(told.get("images"), str)
        sources = () if of_photographs else tuple(_source(one) for one in told["sources"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError, GromaError) as error:
        raise InputError(f"{missing} where the frames of its keyframes are. {remedy}") from error
    if of_photographs:
        raise InputError(
            f"{path} is a map of photographs, made by groma map: tracking goes on in maps of groma track, whose "
            f"keyframes are of the camera of the sequence. Place frames in it: groma localize {path} FRAMES -o OUT."
        )
    scene = read_scene(path / "scene.npz")
    known = {name for source in sources for name in source.images}
    unknown = [name for name in scene.images.names if name not in known]
    if unknown or not scene.num_images:
        what = f"where its image {unknown[0]!r} is from" if unknown else "of any keyframe"
        raise InputError(f"{missing} {what}. {remedy}")
    return SavedMap(str(path), scene, sources)


def _source(told: dict[str, Any]) -> FrameSource:
    camera, scale, kind, masks = (told.get(name) for name in ("camera", "depth_scale", "kind", "masks"))
    good = isinstance(told["path"], str) and kind in (None, "rgbd", "stereo", "mono") and isinstance(masks, str | None)
    if not good or not isinstance(camera, str | None) or not isinstance(scale, int | float | None):
        raise ValueError("not a source")
    images = {str(image): str(frame) for image, frame in told["images"].items()}
    return FrameSource(told["path"], camera, scale, cast("Kind | None", kind), masks, images)


def sources_of(
    scene: Scene, earlier: SavedMap | None, source: FrameSource | None, frames: set[str]
) -> list[dict[str, Any]]:
    """Return where the images of a scene are from, as plain values: of the map before, and of the sequence."""
    names = scene.images.names
    before = () if earlier is None else earlier.sources
    known = {name for one in before for name in one.images}
    kept = [
        replace(one, images={image: frame for image, frame in one.images.items() if image in names}) for one in before
    ]
    if source is not None:
        kept.append(source.with_images(tuple(name for name in names if name not in known), frames))
    return [asdict(one) for one in kept if one.images]

# SPDX-License-Identifier: BSD-3-Clause
"""Whether an argument is a scene; the error says how to get one."""

from groma.errors import check_kind
from groma.scene.scene import Scene


def check_scene_given(value: object, name: str = "scene", *other: type) -> None:
    """Raise InputError unless a value is a scene or of one of the other types; ``name`` is that of the argument."""
    if isinstance(value, (Scene, *other)):
        return
    has_one = isinstance(getattr(value, "scene", None), Scene)
    way = (
        "It has a scene: pass its .scene."
        if has_one
        else "Read one with groma.read_scene(path), or turn a pycolmap.Reconstruction into one with "
        "groma.io.from_pycolmap(reconstruction)."
    )
    check_kind(value, (Scene, *other), name, way)

# SPDX-License-Identifier: BSD-3-Clause
"""What a scene holds, as numbers and as words."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from groma.scene import Scene


def counted(count: int, plural: str) -> str:
    """Return for example ``22,106 points`` or ``1 image``."""
    return f"{count:,} {plural.removesuffix('s') if count == 1 else plural}"


def counts_of(scene: "Scene") -> dict[str, int]:
    """Number of images, landmarks and observations under the names of the machine-readable reports."""
    return {
        "num_images": scene.num_images,
        "num_points": scene.num_points,
        "num_lines": scene.num_lines,
        "num_planes": scene.num_planes,
        "num_observations": scene.num_observations,
    }


def sentence_of(scene: "Scene") -> str:
    """Return for example ``16 images, 22,106 points, 83,718 observations``."""
    return ", ".join(
        counted(count, name.removeprefix("num_"))
        for name, count in counts_of(scene).items()
        if count or name == "num_images"
    )

# SPDX-License-Identifier: BSD-3-Clause
"""What every kind of measurement gives the assembler: a term.

A term says which tables of the scene it reads and which landmarks it needs, and turns the tables into groups of
factors. A new kind of measurement is one table of the scene and one file here; a term from outside may hold its
measurements itself and is passed to :func:`groma.adjustment.assemble.assemble` or named in
:class:`groma.adjustment.adjust.AdjustOptions`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.adjustment.assembly_options import AssemblyOptions
from groma.cameras import model as camera_model
from groma.factors.contract import Factor, Ref
from groma.factors.losses import Loss
from groma.problem.variables import Variables
from groma.scene import Scene


@dataclass(frozen=True)
class Group:
    """Factors of one type, as a term makes them."""

    factor: Factor
    #: Kind of landmark (``points`` or ``lines``) of which each factor is one observation in an image; they make the
    #: reprojection errors of a report. Empty for other measurements.
    observes: str = ""
    #: What a residual of 1 is in the image, pixels: (N,), or (N, 2, 2) matrices to multiply residuals with.
    pixels_of_residual: FloatArray | None = None


@dataclass(frozen=True)
class Term:
    """A kind of measurement."""

    #: What it is called in reports, in the plural.
    name: str
    #: Tables of the scene, none of which is empty where there is anything to do.
    tables: tuple[str, ...]
    #: Groups of landmarks that must take part: ``points``, ``lines``, ``planes``, ``directions``.
    landmarks: tuple[str, ...]
    #: Makes the factors; it may add further groups of variables to ``draft.variables``.
    factors: Callable[[Draft], Iterator[Group]]

    def applies(self, draft: Draft) -> bool:
        """Tell whether there is anything to do."""
        return all(len(getattr(draft.scene, table)) for table in self.tables) and all(
            name in draft.variables for name in self.landmarks
        )


@dataclass(frozen=True)
class Draft:
    """A problem in the making, and what terms ask for."""

    scene: Scene
    options: AssemblyOptions
    #: Groups of variables so far: cameras and landmarks.
    variables: dict[str, Variables]
    #: Sentences about measurements that were left out.
    notes: list[str]

    @property
    def line_loss(self) -> Loss:
        """Loss of segments."""
        return self.options.loss.scaled(self.options.line_loss_factor)

    @property
    def relation_loss(self) -> Loss:
        """Loss of relations between landmarks."""
        return self.options.relation_loss or self.options.loss

    @cached_property
    def has_rigs(self) -> bool:
        """Whether images are taken by cameras on rigs."""
        return not self.scene.has_trivial_rigs

    def camera_refs(self, image_idx: IntArray) -> dict[str, Any]:
        """Return the references to the poses of images that factors of cameras take."""
        images = self.scene.images
        refs = {"pose": Ref("frames", images.frame_idx[image_idx])}
        if self.has_rigs:
            refs["extrinsics"] = Ref("sensors", images.sensor_idx[image_idx])
        return refs

    def by_model(self, image_idx: IntArray) -> Iterator[tuple[str, IntArray, Ref]]:
        """Yield (name of a camera model, rows of the measurements in its images, references to their intrinsics)."""
        camera_of = self.scene.images.camera_idx[image_idx]
        for name, members in self.scene.cameras.by_model().items():
            position = np.full(len(self.scene.cameras), -1)
            position[members] = np.arange(len(members))
            rows = np.flatnonzero(position[camera_of] >= 0)
            if len(rows):
                yield name, rows, Ref(f"intrinsics/{name}", position[camera_of[rows]])

    def by_camera(self, image_idx: IntArray) -> Iterator[tuple[str, IntArray, dict[str, Any]]]:
        """Yield (name of a camera model, rows of the measurements in its images, what factors take of its cameras)."""
        for name, rows, intrinsics in self.by_model(image_idx):
            yield name, rows, {"camera_model": name, "intrinsics": intrinsics, **self.camera_refs(image_idx[rows])}

    def params(self, name: str, image_idx: IntArray) -> FloatArray:
        """Return the parameters (N, K) of the cameras of images, all of one model."""
        return self.scene.cameras.params[self.scene.images.camera_idx[image_idx], : camera_model(name).num_parameters]

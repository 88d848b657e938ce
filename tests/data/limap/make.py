# SPDX-License-Identifier: BSD-3-Clause
"""Writes the files beside it with LIMAP's own writers: ``python make.py`` with pylimap 2.0 installed.

Three images, five points, four lines; a plane, a vanishing point and a sphere; 2D groups with and without a 3D group;
a 2D line without a 3D line, an image without a pose, weights, scores and uncertainties; both wireframes.
"""

from pathlib import Path

import numpy as np
import pycolmap
from limap.geometry import GroupType, Line2d, Line3d
from limap.scene import (
    AssociatedFeature2d,
    AssociatedFeature3d,
    Group2d,
    Group3d,
    HolisticReconstruction,
    Structure2d,
    Wireframe2d,
)

HERE = Path(__file__).parent


def track(*elements):
    result = pycolmap.Track()
    for image_id, idx in elements:
        result.add_element(image_id, idx)
    return result


def model():
    rng = np.random.default_rng(5)
    points = pycolmap.Reconstruction()
    points.add_camera_with_trivial_rig(
        pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[500, 500, 320, 240], camera_id=1)
    )
    for number in (1, 2, 4):
        image = pycolmap.Image(
            name=f"{number}.png", keypoints=rng.uniform(0, 480, (6, 2)), camera_id=1, image_id=number
        )
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), rng.normal(0, 1, 3))
        points.add_image_with_trivial_frame(image, pose)
    for number in range(1, 6):
        seen = [(image, number - 1) for image in (1, 2, 4)]
        points.add_point3D_with_id(10 * number, pycolmap.Point3D(xyz=rng.normal(0, 2, 3), track=track(*seen)))
        for image, idx in seen:
            points.images[image].set_point3D_for_point2D(idx, 10 * number)
    model = HolisticReconstruction(points)
    structures = model.structure_recon
    for image in (1, 2, 3, 4):
        lines = [Line2d(*rng.uniform(0, 480, (2, 2))) for _ in range(4)]
        for line, score in zip(lines, (0.5, 1.25, 2.0, 3.0), strict=True):
            line.score = score
        groups = [
            Group2d(GroupType.PLANE, [AssociatedFeature2d(0, 0.5), AssociatedFeature2d(3)], [AssociatedFeature2d(1)]),
            Group2d(GroupType.VP, [], [AssociatedFeature2d(0), AssociatedFeature2d(2, 0.25)]),
        ]
        wireframe = Wireframe2d()
        wireframe.add_edge(2, 1, 0.75)
        structures.add_structure2d(image, Structure2d(lines, groups, wireframe, 6))
    for number, idx in ((2, 1), (3, 0), (7, 2)):
        line = Line3d(rng.normal(0, 2, 3), rng.normal(0, 2, 3))
        line.set_uncertainty(0.125 * number)
        line.track = track(*[(image, idx) for image in ((1, 2, 3, 4) if number == 3 else (1, 4))])
        structures.add_line3D(number, line)
    plane = Group3d(GroupType.PLANE, [0.0, 3.0, 4.0, 5.0])
    plane.add_point(AssociatedFeature3d(10, 0.5))
    plane.add_point(AssociatedFeature3d(40))
    plane.add_line(AssociatedFeature3d(2, 2.0))
    plane.track = track((1, 0), (2, 0))
    structures.add_group3D(4, plane)
    point = Group3d(GroupType.VP, [2.0, 1.0, -2.0])
    point.add_line(AssociatedFeature3d(3))
    point.add_line(AssociatedFeature3d(7, 0.25))
    point.track = track((1, 1), (4, 1))
    structures.add_group3D(9, point)
    sphere = Group3d(GroupType.SPHERE, [1.0, 2.0, 3.0, 0.5])
    sphere.add_point(AssociatedFeature3d(50))
    structures.add_group3D(5, sphere)
    structures.wireframe.add_edge(30, 2, 1.5)
    structures.wireframe.add_edge(20, 7, 0.5)
    return model


if __name__ == "__main__":
    for form in ("binary", "text"):
        (HERE / form).mkdir(exist_ok=True)
        getattr(model(), f"write_{form}")(str(HERE / form))

# SPDX-License-Identifier: BSD-3-Clause
"""Features of large photographs at the price of small ones.

SIFT begins with an image of twice the size, which costs four fifths of its time, and keeps the features of the largest
scales, as many as it may. In a large photograph those of the doubled image are computed and thrown away. So it is
looked at first without: where that gives as many features as are kept, they are the ones. Otherwise the caller looks in
the doubled image, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from groma.io.colmap.load import find_sift, opened

#: Longer side from which a photograph is large, pixels (cost: time only).
_LARGE = 2000


def features_of_large(
    pycolmap: Any, database: Path, images: Path, names: Sequence[str], extraction: Any, reader: Any
) -> list[str]:
    """Find the features of those photographs that are large, if they have enough, and return the names of the others.

    Parameters
    ----------
    pycolmap : module
        The library.
    database : Path
        Where images are entered; features are written to it whole or not at all.
    images : Path
        Folder of the photographs.
    names : sequence of str
        Names of the images.
    extraction : pycolmap.FeatureExtractionOptions
        As for all photographs; changed temporarily.
    reader : pycolmap.ImageReaderOptions
        Where their masks are.
    """
    with opened(pycolmap, database) as content:
        entered = {name: content.read_image_with_name(name) for name in names}
        cameras = {name: content.read_camera(image.camera_id) for name, image in entered.items()}
    large = [name for name in names if max(cameras[name].width, cameras[name].height) > _LARGE]
    if not large:
        return list(names)
    beside = database.with_name("large.db")
    beside.unlink(missing_ok=True)
    with opened(pycolmap, beside):
        pass
    pycolmap.import_images(beside, images, pycolmap.CameraMode.AUTO, large)
    sift = extraction.sift
    sift.first_octave, sift.num_octaves = sift.first_octave + 1, sift.num_octaves - 1
    find_sift(pycolmap, beside, images, large, extraction, reader)
    sift.first_octave, sift.num_octaves = sift.first_octave - 1, sift.num_octaves + 1
    enough = set()
    with opened(pycolmap, beside) as found, opened(pycolmap, database) as content:
        for name in large:
            source, target = found.read_image_with_name(name).image_id, entered[name].image_id
            if found.num_keypoints_for_image(source) < sift.max_num_features:
                continue
            with pycolmap.DatabaseTransaction(content):
                content.write_keypoints(target, found.read_keypoints(source))
                content.write_descriptors(target, found.read_descriptors(source))
            enough.add(name)
    beside.unlink()
    return [name for name in names if name not in enough]

# SPDX-License-Identifier: BSD-3-Clause
"""Photographs of which a mask hides a part, localised in a map of the embedded cabinet."""

import cv2
import numpy as np
import pytest
from worlds import QUERIES, cabinet_in

from groma.errors import InputError
from groma.io.colmap.masks import Masks
from groma.localization import localizer as localizer_module
from groma.localization.localizer import Localizer
from groma.localization.run import localize_images, query_files


def test_what_a_mask_hides_is_neither_used_nor_missing(tmp_path, monkeypatch):
    """The left half is of another photograph, as a person in front of the camera; the mask of the file hides it."""
    place = cabinet_in(tmp_path)
    localizer = Localizer(place / "map.npz", place / "images")
    image, other = (
        cv2.imread(str(place / "queries" / name), cv2.IMREAD_GRAYSCALE) for name in (QUERIES[3], QUERIES[0])
    )
    used = np.zeros(image.shape, bool)
    used[:, 320:] = True
    (tmp_path / "new").mkdir()
    whole = localizer.localize(image).pose
    image[:, :320] = other[:, :320]
    for name, picture in (("a.png", image), ("a_mask.png", 255 * used.astype(np.uint8))):
        cv2.imwrite(str(tmp_path / "new" / name), picture)
    files = query_files([tmp_path / "new"])
    assert list(files) == ["a.png"]
    plain, masked = (
        localize_images(localizer, files, tmp_path / "work", masks=masks)[0]
        for masks in (None, Masks.of(tmp_path / "new", list(files)))
    )
    assert (plain.status, masked.status) == ("uncertain", "localized")
    assert (masked.pixel[:, 0] > 320.0).all() and (masked.segment[:, ::2] > 320.0).all()
    shown = []
    ask = localizer_module.shown_of
    monkeypatch.setattr(localizer_module, "shown_of", lambda *given: shown.append(ask(*given)) or shown[-1])
    found = localizer.localize(image, used=used).pose
    assert shown and all(one.missing == 0.0 for one in shown)
    assert np.array_equal(found.cam_from_world, masked.pose)
    # Both have the same map and the same right half.
    assert np.linalg.norm(found.center - whole.center) < 5.0 * np.linalg.norm(found.center_sigma)
    with pytest.raises(InputError, match=r"used must have the shape of the image, \(480, 640\); got \(2, 2\)"):
        localizer.localize(image, used=np.ones((2, 2), bool))

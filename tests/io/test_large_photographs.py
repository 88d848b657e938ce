# SPDX-License-Identifier: BSD-3-Clause
"""Features of large photographs: those of the doubled image that SIFT begins with, found without it where it can be."""

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.spatial import KDTree

from groma.io.colmap.large_photographs import features_of_large
from groma.io.colmap.load import quiet

NAMES = ["large.png", "plain.png", "small.png"]


@pytest.fixture
def entered(tmp_path):
    """Photographs in a database: large with texture, large with hardly any, small."""
    rng = np.random.default_rng(0)
    noise = cv2.GaussianBlur(rng.normal(128.0, 60.0, (64, 2010)), None, 2.0)
    noise = cv2.normalize(noise, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    plain = np.full_like(noise, 128)
    plain[20:50, 40:90] = 30
    for name, image in zip(NAMES, (noise, plain, noise[:, :500]), strict=True):
        cv2.imwrite(str(tmp_path / name), image)
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads, extraction.sift.max_num_features = 1, 100
    databases = [tmp_path / "fast.db", tmp_path / "usual.db"]
    with quiet(pycolmap):
        for database in databases:
            pycolmap.Database.open(str(database)).close()
            pycolmap.import_images(database, tmp_path, pycolmap.CameraMode.AUTO, NAMES)
    return databases, tmp_path, extraction


def features(database, name):
    content = pycolmap.Database.open(str(database))
    number = content.read_image_with_name(name).image_id
    found = content.exists_descriptors(number), content.read_keypoints(number)[:, :2]
    content.close()
    return found


def test_enough_features_are_found_without_the_doubled_image(entered):
    (fast, usual), images, extraction = entered
    before = extraction.sift.first_octave, extraction.sift.num_octaves
    with quiet(pycolmap):
        left = features_of_large(pycolmap, fast, images, NAMES, extraction, pycolmap.ImageReaderOptions())
        assert left == ["plain.png", "small.png"]  # too little texture; cheap anyway
        assert (extraction.sift.first_octave, extraction.sift.num_octaves) == before
        pycolmap.extract_features(
            usual, images, image_names=["large.png"], extraction_options=extraction, device=pycolmap.Device.cpu
        )
        assert features_of_large(pycolmap, fast, images, left, extraction, pycolmap.ImageReaderOptions()) == left
    assert [features(fast, name)[0] for name in NAMES] == [True, False, False]
    ours, theirs = features(fast, "large.png")[1], features(usual, "large.png")[1]
    assert len(ours) >= 100 and len(ours) == pytest.approx(len(theirs), rel=0.1)
    assert (KDTree(ours).query(theirs)[0] < 0.25).mean() > 0.8
    assert not (images / "large.db").exists()

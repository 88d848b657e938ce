# SPDX-License-Identifier: BSD-3-Clause
"""Which camera of the TUM benchmark a folder is of: by its name, or by the first lines of its files."""

import numpy as np
import pytest
from _sequences import image

from groma.errors import InputError
from groma.io.sequences import open_sequence


def test_intrinsics_of_the_benchmark(tum, tmp_path):
    (tum / "camera.txt").unlink()
    with pytest.raises(InputError, match="Pass one"):
        open_sequence(tum)
    named = tmp_path / "rgbd_dataset_freiburg3_walk"
    for row in range(2):
        image(named / f"rgb/{row}.png", row, (640, 480))
    (named / "rgb.txt").write_text("0.0 rgb/0.png\n0.1 rgb/1.png\n")
    sequence = open_sequence(named)
    assert sequence.kind == "mono"
    np.testing.assert_allclose(sequence.camera.params, [535.4, 539.2, 320.6, 248.1])
    named.rename(tmp_path / "freiburg1_xyz")
    np.testing.assert_allclose(open_sequence(tmp_path / "freiburg1_xyz").camera.params, [517.3, 516.5, 319.1, 255.8])
    (tmp_path / "freiburg1_xyz").rename(tmp_path / "data")
    with pytest.raises(InputError, match="neither its name nor the first lines of its files say"):
        open_sequence(tmp_path / "data")
    said = "# color images\n# file: 'rgbd_dataset_freiburg2_desk.bag'\n"
    (tmp_path / "data" / "rgb.txt").write_text(said + (tmp_path / "data" / "rgb.txt").read_text())
    np.testing.assert_allclose(open_sequence(tmp_path / "data").camera.params[:2], [520.9, 521.0])

# SPDX-License-Identifier: BSD-3-Clause
"""Segments by a network in an ONNX file: tiles, cells to pixels, edges nearby, what is refused.

The network is a stand-in for onnxruntime: a file names the form of its input and outputs, and it answers with the true
segments of a drawn picture, a few pixels off. One test runs where onnxruntime is installed.
"""

import json
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import cv2
import numpy as np
import pytest

from groma.errors import InputError
from groma.features.lsd import LsdDetector
from groma.features.onnx_segments import OnnxDetector, covered
from groma.features.registry import DETECTORS

SIZE = 128  # of the network's input; its cells are two pixels
TRUE = np.array([[30.0, 40.0, 250.0, 90.0], [60.0, 200.0, 280.0, 150.0], [290.0, 20.0, 300.0, 220.0]])


def picture():
    """Three dark bars on a bright ground, each with a true segment along its upper or left edge."""
    image = np.full((8 * 240, 8 * 320), 200, np.uint8)
    for u1, v1, u2, v2 in TRUE:
        way = np.array([u2 - u1, v2 - v1]) / np.hypot(u2 - u1, v2 - v1)
        across = np.array([-way[1], way[0]])
        corners = np.array([[u1, v1], [u2, v2], [u2, v2] + 12 * across, [u1, v1] + 12 * across])
        cv2.fillPoly(image, [np.round(8 * corners - 0.5).astype(np.int32)], 60)
    return cv2.resize(image, (320, 240), interpolation=cv2.INTER_AREA)


class Session:
    """Finds the picture's position in the whole by its content, and answers with what is visible of the segments."""

    def __init__(self, file, options, providers):
        text = Path(file).read_text()
        if not text.startswith("{"):
            raise RuntimeError("[ONNXRuntimeError] : 7 : INVALID_PROTOBUF : Protobuf parsing failed.\nmore")
        self.form = json.loads(text)

    def _values(self, which):
        return [SimpleNamespace(name=name, shape=shape, type=kind) for name, shape, kind in self.form[which]]

    def get_inputs(self):
        return self._values("inputs")

    def get_outputs(self):
        return self._values("outputs")

    def run(self, names, given):
        image = given["image"][0, :, :, 0]
        best = None
        for left, top, width, height in self.form["tiles"]:
            part = picture()[top : top + height, left : left + width]
            part = cv2.resize(part, (SIZE, SIZE), interpolation=cv2.INTER_AREA)
            if np.abs(part.astype(np.float32) - image).max() < 1e-3:
                best = left, top, width, height
        assert best is not None
        left, top, width, height = best
        cells = SIZE // 2
        scores, offsets = np.zeros((1, cells, cells, 1), np.float32), np.zeros((1, cells, cells, 4), np.float32)
        for segment in TRUE:
            ends = [segment[:2] + t * (segment[2:] - segment[:2]) for t in np.linspace(0, 1, 400)]
            seen = [e for e in ends if left <= e[0] < left + width and top <= e[1] < top + height]
            if len(seen) < 30:
                continue
            way = (segment[2:] - segment[:2]) / np.linalg.norm(segment[2:] - segment[:2])
            off = 3.0 * np.array([way[1], -way[0]])  # pixels across, as far as networks err
            scaled = [(e + off - [left, top]) * [cells / width, cells / height] for e in (seen[0], seen[-1])]
            column, row = np.clip(np.floor(0.5 * (scaled[0] + scaled[1])).astype(int), 0, cells - 1)
            scores[0, row, column] = 0.9
            offsets[0, row, column] = np.concatenate([s - [column + 0.5, row + 0.5] for s in scaled])
        return [scores if name == "scores" else offsets for name in names]


@pytest.fixture
def runtime(monkeypatch):
    """A module that stands for onnxruntime."""
    module = ModuleType("onnxruntime")
    module.SessionOptions = SimpleNamespace
    module.InferenceSession = Session
    monkeypatch.setitem(sys.modules, "onnxruntime", module)


FLOAT = "tensor(float)"
FORM = {
    "inputs": [["image", [1, SIZE, SIZE, 4], FLOAT]],
    "outputs": [["offsets", [1, SIZE // 2, SIZE // 2, 4], FLOAT], ["scores", [1, SIZE // 2, SIZE // 2, 1], FLOAT]],
    # Two rows and three columns of tiles of at most 160 pixels, which overlap.
    "tiles": [[left, top, width, 127] for left, width in ((0, 113), (100, 120), (207, 113)) for top in (0, 113)],
}


def network(folder, **changes):
    path = folder / "network.onnx"
    path.write_text(json.dumps(FORM | changes))
    return f"onnx:{path}"


def test_segments_of_all_tiles_lie_on_the_edges(tmp_path, runtime):
    detector = DETECTORS.make(network(tmp_path), min_length=30.0, max_segments=0)
    found = detector.detect(picture())
    assert len(found) == 3  # pieces of different tiles are one segment again
    for ends in found.ends:
        away = np.minimum(np.abs(TRUE - ends).max(axis=1), np.abs(TRUE - ends[[2, 3, 0, 1]]).max(axis=1))
        assert away.min() < 4.0
        line = TRUE[np.argmin(away)]
        way = (line[2:] - line[:2]) / np.linalg.norm(line[2:] - line[:2])
        across = (ends.reshape(2, 2) - line[:2]) @ np.array([-way[1], way[0]])
        assert np.abs(across).max() < 0.3  # the network was three pixels off
    assert (found.sigma < 0.3).all()
    assert len(DETECTORS.make(network(tmp_path), min_length=30.0, max_segments=2).detect(picture())) == 2
    assert len(detector.detect(np.full((240, 320), 90, np.uint8))) == 0


def test_their_dark_side_is_that_of_lsd(tmp_path, runtime):
    found = DETECTORS.make(network(tmp_path), min_length=30.0, max_segments=0).detect(picture())
    for segments in (found, LsdDetector(min_length=100.0).detect(picture())):
        assert len(segments) >= 3
        for u1, v1, u2, v2 in segments.ends:
            way = np.array([u2 - u1, v2 - v1]) / np.hypot(u2 - u1, v2 - v1)
            u, v = 0.5 * np.array([u1 + u2, v1 + v2]) + 4.0 * np.array([way[1], -way[0]])
            assert picture()[int(v), int(u)] < 100


def test_another_file_is_another_detector(tmp_path, runtime):
    first = DETECTORS.make(network(tmp_path), min_length=30.0, max_segments=0)
    second = DETECTORS.make(network(tmp_path, note="retrained"), min_length=30.0, max_segments=0)
    assert first.file == second.file
    assert first != second


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"inputs": [["image", [1, 3, SIZE, SIZE], FLOAT]]}, r"got input \(1, 3, 128, 128\)"),
        ({"inputs": [["image", ["N", "H", "W", 3], FLOAT]]}, "no detector of segments that is known"),
        ({"inputs": [["image", [1, SIZE, SIZE, 4], "tensor(uint8)"]]}, "all float32"),
        ({"outputs": [["scores", [1, 64, 64, 1], FLOAT]]}, r"outputs \(1, 64, 64, 1\)"),
        ({"outputs": []}, "outputs none"),
        ({"inputs": [["image", [1, 1 << 15, 1 << 15, 4], FLOAT]]}, "takes images of 32768 x 32768 pixels; expected at"),
    ],
)
def test_networks_of_another_form_are_refused(tmp_path, runtime, changes, said):
    with pytest.raises(InputError, match=said) as caught:
        DETECTORS.make(network(tmp_path, **changes), min_length=12.0, max_segments=0)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (lambda names, given: [np.zeros((1, 64, 64, 1)), np.zeros((1, 32, 64, 4))], r"64, 1\) and \(1, 32, 64, 4\)"),
        (lambda names, given: [np.zeros((2, 8, 8, 1)), np.zeros((2, 8, 8, 4))], "gives arrays of shape"),
        (lambda names, given: [][0], "fails on an image: list index out of range. Use another network"),
    ],
)  # fmt: skip
def test_networks_that_fail_on_an_image_are_named(tmp_path, runtime, monkeypatch, answer, said):
    monkeypatch.setattr(Session, "run", lambda self, names, given: answer(names, given))
    detector = DETECTORS.make(network(tmp_path), min_length=12.0, max_segments=0)
    with pytest.raises(InputError, match=said):
        detector.detect(picture())


def test_what_is_no_network_is_refused(tmp_path, runtime):
    (tmp_path / "text.onnx").write_text("weights")
    with pytest.raises(InputError, match=r"cannot be loaded as an ONNX model: .*Protobuf parsing failed\. Fetch"):
        DETECTORS.make(f"onnx:{tmp_path / 'text.onnx'}", min_length=12.0, max_segments=0)
    with pytest.raises(InputError, match=r"Cannot read .*nowhere"):
        DETECTORS.make(f"onnx:{tmp_path / 'nowhere.onnx'}", min_length=12.0, max_segments=0)
    for name in ("onnx", "onnx:", "onnx:FILE"):
        with pytest.raises(InputError):
            DETECTORS.make(name, min_length=12.0, max_segments=0)
    with pytest.raises(InputError, match="min_length must be positive"):
        OnnxDetector("any", min_length=-1.0)


def test_without_onnxruntime_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    (tmp_path / "other.onnx").write_text("any other content")
    with pytest.raises(InputError, match=r'pip install "groma\[onnx\]"'):
        OnnxDetector(str(tmp_path / "other.onnx"))


def test_onnxruntime_itself_refuses_what_is_no_network(tmp_path):
    pytest.importorskip("onnxruntime")
    (tmp_path / "text.onnx").write_text("no protobuf at all")
    with pytest.raises(InputError, match="cannot be loaded as an ONNX model"):
        OnnxDetector(str(tmp_path / "text.onnx"))


def test_what_a_longer_segment_covers():
    ends = np.array([[0, 0, 100, 0], [10, 1, 60, 1], [90, 0, 140, 0], [10, 3, 60, 3], [60, 1, 10, 1.0]])
    assert covered(ends).tolist() == [False, True, False, False, True]

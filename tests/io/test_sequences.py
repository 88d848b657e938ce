# SPDX-License-Identifier: BSD-3-Clause
"""Image sequences: every layout from a folder made here, cameras and their pixel conventions, undistortion and
rectification against projected points, and faults: missing, damaged, repeated, unordered files; the shared data.
"""

import threading

import cv2
import numpy as np
import pytest
from _sequences import POINTS, SIZE, blob_center, image, pose, values

from groma import cameras
from groma.errors import FileFormatError, InputError
from groma.geometry import se3
from groma.io.sequences import Sequence, open_sequence

# ------------------------------------------------------------------------------------------------------- TUM RGB-D


def test_tum(tum):
    sequence = open_sequence(tum)
    assert isinstance(sequence, Sequence)
    assert (sequence.kind, sequence.num_frames, len(sequence.reference)) == ("rgbd", 6, 6)
    camera = sequence.camera
    assert (camera.model, camera.width, camera.height, camera.baseline) == ("PINHOLE", 64, 48, None)
    assert camera.params.tolist() == [50, 51, 32.5, 24.5]  # files count from the first pixel's centre
    frames = list(sequence)
    assert [frame.timestamp for frame in frames] == [10.0, 10.1, 10.2, 10.3, 10.4, 10.5]
    assert frames[0].gray.dtype == np.uint8
    assert frames[0].depth.dtype == np.float32
    # 10.4 and 10.5 have no depth within the tolerance.
    assert [None if f.depth is None else float(f.depth[0, 0]) for f in frames] == [1, 2, 3, 4, None, None]
    assert any("4.png has no depth" in text for text in sequence.warnings)
    assert values(sequence) == [0, 10, 20, 30, 40, 50]  # again, from the start
    assert len(sequence.warnings) == 2


def test_options(tum):
    assert values(open_sequence(tum, stride=2)) == [0, 20, 40]
    assert values(open_sequence(tum, stride=2, max_frames=2)) == [0, 20]
    assert next(iter(open_sequence(tum, depth_scale=1000))).depth[0, 0] == 5.0
    mono = open_sequence(tum, kind="mono")
    assert mono.kind == "mono"
    assert next(iter(mono)).depth is None
    for options, words in (
        ({"stride": 0}, "stride"), ({"max_frames": 0}, "max_frames"), ({"kind": "stereo"}, "'rgbd' or 'mono'"),
        ({"depth_scale": 0}, "depth_scale"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=words):
            open_sequence(tum, **options)


def test_associations_in_either_order(tum):
    (tum / "associations.txt").write_text("10.0 rgb/0.png 10.0 depth/1.png\n10.1 depth/0.png 10.11 rgb/1.png\n")
    frames = list(open_sequence(tum))
    assert [(f.timestamp, float(f.depth[0, 0])) for f in frames] == [(10.0, 2.0), (10.11, 1.0)]
    (tum / "associations.txt").write_text("10.0 rgb/0.png 10.0\n")
    with pytest.raises(FileFormatError, match="line 1"):
        open_sequence(tum)
    (tum / "associations.txt").write_text("nan rgb/0.png 10.0 depth/0.png\n")
    with pytest.raises(FileFormatError, match="finite"):
        open_sequence(tum)


def test_faults(tum):
    lines = (tum / "rgb.txt").read_text().splitlines()
    # Out of order, a missing file, a repeated time.
    lines = [lines[0], lines[3], lines[1], lines[2], *lines[4:], "10.6 rgb/none.png", "10.5 rgb/0.png"]
    (tum / "rgb.txt").write_text("\n".join(lines))
    (tum / "rgb/1.png").write_bytes(b"no image")
    image(tum / "rgb/3.png", 30, (32, 24))
    image(tum / "depth/0.png", 1000, (32, 20), np.uint16)
    sequence = open_sequence(tum)
    frames = list(sequence)
    assert [frame.timestamp for frame in frames] == [10.0, 10.2, 10.4, 10.5]
    assert frames[0].depth is None
    text = "\n".join(sequence.warnings)
    for words in ("not in order", "0.png has the time of 5.png", "1.png cannot be read", "none.png cannot be read"):
        assert words in text
    assert "3.png is 32x24, not 64x48" in text
    assert "0.png is 32x20, not 64x48 grey" in text


def test_a_picture_of_depths_is_no_depth(tum):
    """Of 8 bits, in steps of four centimetres or a map of the wrong size; a frame without depth is honest."""
    image(tum / "depth/0.png", 20)
    sequence = open_sequence(tum)
    assert next(iter(sequence)).depth is None
    assert "0.png has 8 bits, too few for distances" in "\n".join(sequence.warnings)


def test_depth_without_value(tum):
    raw = np.full((48, 64), 5000, np.uint16)
    raw[0, 0], raw[0, 1] = 65535, 0
    cv2.imwrite(str(tum / "depth/0.png"), raw)
    depth = next(iter(open_sequence(tum))).depth
    assert depth[0, :3].tolist() == [0.0, 0.0, 1.0]


def test_only_a_few_frames_are_read_ahead_and_threads_end(tum):
    before = threading.active_count()
    iterator = iter(open_sequence(tum))
    next(iterator)
    assert threading.active_count() == before + 1
    iterator.close()
    assert threading.active_count() == before


# ----------------------------------------------------------------------------------------------------------- KITTI


def test_kitti(kitti):
    sequence = open_sequence(kitti)
    assert sequence.kind == "stereo"
    assert sequence.camera.baseline == 0.5
    assert sequence.camera.params.tolist() == [70, 70, 30.5, 20.5]
    assert sequence.reference.timestamps.tolist() == [0.0, 0.1, 0.2]
    assert sequence.reference.world_from_cam[2, 6] == 2.0
    assert [(f.timestamp, int(f.gray[0, 0]), int(f.right[0, 0])) for f in sequence] == [
        (0.0, 0, 1),
        (0.1, 10, 11),
        (0.2, 20, 21),
    ]
    mono = open_sequence(kitti, kind="mono")
    assert (mono.kind, mono.camera.baseline, next(iter(mono)).right) == ("mono", None, None)


def test_kitti_with_dropped_images(kitti):
    (kitti / "image_0/000001.png").unlink()
    (kitti / "image_1/000002.png").unlink()
    sequence = open_sequence(kitti)
    assert [(frame.timestamp, frame.right is None) for frame in sequence] == [(0.0, False), (0.2, True)]
    assert sequence.warnings == ["000002.png has no right image."]
    (kitti / "times.txt").unlink()
    assert [frame.timestamp for frame in open_sequence(kitti)] == [0.0, 0.2]
    (kitti / "times.txt").write_text("0\n")
    with pytest.raises(FileFormatError, match="expected 3 finite times"):
        open_sequence(kitti)
    (kitti / "calib.txt").write_text("P0: 1 2\n")
    with pytest.raises(FileFormatError, match="calib"):
        open_sequence(kitti)


# ----------------------------------------------------------------------------------------------------------- EuRoC


def test_euroc_is_rectified(euroc):
    folder, world_from_left = euroc
    sequence = open_sequence(folder)
    assert (sequence.kind, sequence.num_frames, sequence.warnings) == ("stereo", 3, [])
    assert sequence.camera.baseline == pytest.approx(np.linalg.norm([0.11, 0.002, -0.003]))
    frame = next(iter(sequence))
    assert abs(frame.timestamp - 1403636579.763555584) < 1e-6
    # Points in the world, seen from where the reference says the camera is.
    world = POINTS @ world_from_left[:3, :3].T + world_from_left[:3, 3]
    rectified = se3.transform_points(np.tile(sequence.reference.cam_from_world[:1], (5, 1)), world)
    model, params = cameras.model("PINHOLE"), sequence.camera.params
    for gray, shift in ((frame.gray, 0.0), (frame.right, sequence.camera.baseline)):
        for pixel in model.project(params, rectified - [shift, 0, 0]):
            np.testing.assert_allclose(blob_center(gray, pixel), pixel, atol=0.15)
    assert open_sequence(folder / "mav0").kind == "stereo"


def test_euroc_with_one_camera(euroc):
    folder, world_from_left = euroc
    sequence = open_sequence(folder, kind="mono")
    np.testing.assert_allclose(sequence.camera.params, [250, 252, 158.5, 121.5])
    np.testing.assert_allclose(se3.to_matrix(sequence.reference.world_from_cam)[0], world_from_left, atol=1e-9)
    gray = next(iter(sequence)).gray
    for pixel in cameras.model("PINHOLE").project(sequence.camera.params, POINTS):
        np.testing.assert_allclose(blob_center(gray, pixel), pixel, atol=0.15)


def test_euroc_faults(euroc):
    folder, _ = euroc
    right = sorted((folder / "mav0/cam1/data").iterdir())
    table = folder / "mav0/cam1/data.csv"
    table.write_text("".join(line + "\n" for line in table.read_text().splitlines() if right[1].stem not in line))
    right[0].write_bytes(b"")
    sequence = open_sequence(folder)
    assert [frame.right is None for frame in sequence] == [True, True, False]
    assert len(sequence.warnings) == 2
    with pytest.raises(InputError, match="stereo folder"):
        open_sequence(folder, camera="250 250 160 120")
    sensor = folder / "mav0/cam0/sensor.yaml"
    text = sensor.read_text()
    for damage, words in (
        (text.replace("intrinsics", "other"), "no entry intrinsics"),
        (text.replace("radial-tangential", "wide"), "distortion_model"),
        (text.replace("data: [", "data: [3, "), "sensor.yaml"),
    ):
        sensor.write_text(damage)
        with pytest.raises(FileFormatError, match=words):
            open_sequence(folder)


# ------------------------------------------------------------------------------------------------------- 7-Scenes


@pytest.mark.kernels
def test_seven_scenes(tmp_path):
    for row in (0, 1, 3):
        image(tmp_path / f"frames/frame-{row:06d}.color.png", row, (640, 480))
        image(tmp_path / f"frames/frame-{row:06d}.depth.png", 2000, (640, 480), np.uint16)
        np.savetxt(tmp_path / f"frames/frame-{row:06d}.pose.txt", pose([0, 0.1 * row, 0], [row, 0, 0]))
    sequence = open_sequence(tmp_path)
    frames = list(sequence)
    assert (sequence.kind, [round(30 * frame.timestamp) for frame in frames]) == ("rgbd", [0, 1, 3])
    np.testing.assert_array_equal(sequence.camera.params, [525, 525, 320.5, 240.5])
    # A wall two metres from the depth camera, seen by the colour camera, which is turned by half a degree.
    depth = frames[0].depth
    inside = depth[60:-60, 60:-60]
    assert (inside > 0).mean() > 0.999
    assert 1.98 < inside[inside > 0].min() < inside.max() < 2.02
    # The colour camera lies 2.5 cm to the right of the depth camera.
    offset = sequence.reference.world_from_cam[:, 4:] - [[0, 0, 0], [1, 0, 0], [3, 0, 0]]
    np.testing.assert_allclose(np.linalg.norm(offset, axis=1), 0.0256, atol=1e-4)
    assert offset[0, 0] > 0.025


# -------------------------------------------------------------------------------------- Colour and depth, no lists


def test_color_and_depth_by_number(tmp_path):
    for number in (1, 2, 10):
        image(tmp_path / f"color/{number}.jpg", 10 * number)
    for number in (2, 1):
        image(tmp_path / f"depth/d_{number:04d}.png", 1000 * number, dtype=np.uint16)
    with pytest.raises(InputError, match="No camera is known"):
        open_sequence(tmp_path)
    sequence = open_sequence(tmp_path, camera="50 50 32 24")
    frames = list(sequence)
    assert sequence.kind == "rgbd" and [frame.name for frame in frames] == ["1.jpg", "2.jpg", "10.jpg"]
    assert [None if frame.depth is None else frame.depth[0, 0] for frame in frames] == [1.0, 2.0, None]
    assert "1000 is taken for a metre. Pass --depth-scale" in sequence.warnings[0]
    assert sequence.warnings[1:] == ["10.jpg has no depth image."]
    said = open_sequence(tmp_path, camera="50 50 32 24", depth_scale=500)
    assert next(iter(said)).depth[0, 0] == 2.0 and not said.warnings
    assert open_sequence(tmp_path, camera="50 50 32 24", kind="mono").warnings == []


def test_color_and_depth_in_one_folder(tmp_path):
    """As Replica has them; photographs that happen to be named after depth are photographs."""
    for number in range(2):
        image(tmp_path / f"results/frame{number:06d}.jpg", 10 + number)
        image(tmp_path / f"results/depth{number:06d}.png", 1000 * (number + 1), dtype=np.uint16)
    for place in (tmp_path, tmp_path / "results"):
        sequence = open_sequence(place, camera="50 50 32 24")
        assert sequence.kind == "rgbd" and [frame.depth[0, 0] for frame in sequence] == [1.0, 2.0]
    image(tmp_path / "results/in_depth.jpg", 12)
    sequence = open_sequence(tmp_path / "results", camera="50 50 32 24")
    assert sequence.kind == "mono" and len(sequence) == 5


def test_depth_of_another_resolution(tmp_path):
    image(tmp_path / "rgb/1.png", 1)
    depth = np.arange(1, 13, dtype=np.uint16).reshape(3, 4) * 1000
    (tmp_path / "depth").mkdir()
    assert cv2.imwrite(str(tmp_path / "depth/1.png"), depth)
    frame = next(iter(open_sequence(tmp_path, camera="50 50 32 24")))
    assert frame.depth == pytest.approx(depth.repeat(16, 0).repeat(16, 1) / 1000.0, rel=1e-6)


def test_color_and_depth_by_time(tmp_path):
    for name in ("1.50", "1.25"):
        image(tmp_path / f"rgb/{name}.png", 1)
    image(tmp_path / "depth/1.255.png", 5000, dtype=np.uint16)
    frames = list(open_sequence(tmp_path, camera="50 50 32 24"))
    assert [(frame.timestamp, frame.depth is None) for frame in frames] == [(1.25, False), (1.5, True)]
    assert frames[0].depth[0, 0] == 1.0  # as TUM writes depth


def test_depth_in_floats_is_metres(tmp_path):
    image(tmp_path / "image/7.png", 1)
    image(tmp_path / "depth/7.tiff", 2.5, dtype=np.float32)
    sequence = open_sequence(tmp_path, camera="50 50 32 24")
    assert next(iter(sequence)).depth[0, 0] == 2.5 and not sequence.warnings


def test_color_and_depth_that_do_not_belong_together(tmp_path):
    image(tmp_path / "rgb/1.png", 1)
    image(tmp_path / "depth/2.png", 1, dtype=np.uint16)
    with pytest.raises(InputError, match="has the number or time of a depth image"):
        open_sequence(tmp_path, camera="50 50 32 24")


# -------------------------------------------------------------------------------------------------- Folders, videos


def test_image_folder(tmp_path):
    for number in (1, 2, 10):
        image(tmp_path / f"img{number}.png", number)
    with pytest.raises(InputError, match="No camera is known"):
        open_sequence(tmp_path)
    sequence = open_sequence(tmp_path, camera="50 50 32 24")
    assert (sequence.kind, sequence.reference) == ("mono", None)
    assert values(sequence) == [1, 2, 10]
    (tmp_path / "times.txt").write_text("0.5\n0.25\n0.75\n")
    sequence = open_sequence(tmp_path, camera="50 50 32 24")
    assert values(sequence) == [2, 1, 10]
    assert "not in order" in sequence.warnings[0]
    (tmp_path / "times.txt").write_text("0.5\n")
    with pytest.raises(FileFormatError, match="expected 3"):
        open_sequence(tmp_path, camera="50 50 32 24")


@pytest.mark.parametrize(
    ("levels", "expected"),
    [([0, 2048, 4095], [0, 128, 255]), ([300, 512, 1023], [75, 128, 255]), ([257, 25700, 65535], [1, 100, 255])],
)
def test_images_of_more_than_8_bits(tmp_path, levels, expected):
    """12 and 10 bits are stored in 16; one scale is for all frames, and another sequence has another."""
    for number, level in enumerate(levels):
        image(tmp_path / f"{number}.png", level, dtype=np.uint16)
    assert values(open_sequence(tmp_path, camera="50 50 32 24")) == expected
    image(tmp_path / "0.png", 7)  # of 8 bits: others are the exception
    assert values(open_sequence(tmp_path, camera="50 50 32 24"))[0] == 7


def test_times_from_names(tmp_path):
    for name in ("1.50", "1.25"):
        image(tmp_path / "a" / f"{name}.png", 1)
    for name in ("1403636579763555584", "1403636579813555584"):
        image(tmp_path / "b" / f"{name}.png", 1)
    camera = "50 50 32 24"
    assert [f.timestamp for f in open_sequence(tmp_path / "a", camera=camera)] == [1.25, 1.5]
    times = [f.timestamp for f in open_sequence(tmp_path / "b", camera=camera)]
    assert times[1] - times[0] == pytest.approx(0.05, abs=1e-6)


def test_video(tmp_path):
    path = tmp_path / "v.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, SIZE)
    for row in range(7):
        writer.write(np.full((48, 64, 3), 30 * row, np.uint8))
    writer.release()
    sequence = open_sequence(path, camera="50 50 32 24", stride=2, max_frames=3)
    assert sequence.num_frames is None
    for _ in range(2):
        frames = list(sequence)
        np.testing.assert_allclose([frame.timestamp for frame in frames], [0.0, 0.1, 0.2])
        np.testing.assert_allclose([float(frame.gray.mean()) for frame in frames], [0, 60, 120], atol=3)
    assert len(list(open_sequence(path, camera="50 50 32 24"))) == 7
    iterator = iter(sequence)
    next(iterator)
    iterator.close()
    (tmp_path / "broken.mp4").write_bytes(b"no video")
    with pytest.raises(FileFormatError, match="not a video"):
        open_sequence(tmp_path / "broken.mp4", camera="50 50 32 24")
    with pytest.raises(InputError, match="No camera"):
        open_sequence(path)


def test_what_is_no_sequence(tmp_path):
    (tmp_path / "x.dat").write_text("x")
    for name, words in ((".", "no sequence"), ("none", "Cannot read"), ("x.dat", "neither a folder nor a video")):
        with pytest.raises(InputError, match=words):
            open_sequence(tmp_path / name)
    image(tmp_path / "bad/0.png", 1)
    with pytest.raises(InputError, match=r"no sequence.*It contains sequences: bad\."):
        open_sequence(tmp_path)
    (tmp_path / "bad/0.png").write_bytes(b"x")
    with pytest.raises(InputError, match="None of the 1 images"):
        open_sequence(tmp_path / "bad", camera="50 50 32 24")


@pytest.mark.shared
@pytest.mark.parametrize(
    ("name", "kind", "count", "size"),
    [
        ("rgbd_tum_fr3_cabinet", "rgbd", 58, (640, 480)),
        ("rgbd_7scenes_redkitchen", "rgbd", 120, (640, 480)),
        ("stereo_kitti06", "stereo", 40, (1226, 370)),
    ],
)
def test_shared_sequences(shared_data, name, kind, count, size):
    sequence = open_sequence(shared_data / name)
    assert (sequence.kind, sequence.num_frames, len(sequence.reference)) == (kind, count, count)
    assert (sequence.camera.width, sequence.camera.height) == size
    frames = [frame for frame, _ in zip(sequence, range(3), strict=False)]
    np.testing.assert_array_equal([frame.timestamp for frame in frames], sequence.reference.timestamps[:3])
    assert all(frame.gray.shape == size[::-1] for frame in frames)
    assert sequence.warnings == []

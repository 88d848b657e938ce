# SPDX-License-Identifier: BSD-3-Clause
"""The turn of the camera in a KITTI sequence, by OpenCV alone, beside the reference and a track of groma.

    groma track SEQUENCE -o TRACK
    python benchmarks/street_rotation.py SEQUENCE TRACK

SEQUENCE is a folder of the KITTI layout with ``poses.txt``. SIFT features of two frames give the rotation twice: by the
essential matrix, and by a perspective pose from points of the stereo pair. With pycolmap, all frames of the left camera
are adjusted together as well. Printed are differences in degrees, the rotation of the reference from frame to frame at
the start, and the errors of the paths of TRACK (stereo) and of COLMAP (scale aligned), whole and from the twelfth pose
on.
"""

import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

try:
    import pycolmap
except ImportError:
    pycolmap = None

PAIRS = [(0, 2), (0, 4), (0, 6), (10, 20), (20, 30), (30, 39)]
#: Largest ratio of a match to the second best, reprojection errors and least disparity in pixels.
RATIO, EPIPOLAR_PX, POSE_PX, MIN_DISPARITY = 0.8, 0.6, 1.5, 3.0


class Street:
    """Features of the frames of a sequence, and rotations between them."""

    def __init__(self, folder: Path) -> None:
        rows = dict(line.split(":", 1) for line in (folder / "calib.txt").read_text().splitlines() if ":" in line)
        left, right = (np.array(rows[name].split(), float).reshape(3, 4) for name in ("P0", "P1"))
        self.K, self.baseline = left[:, :3], -right[0, 3] / right[0, 0]
        self.folder, self._found = folder, {}
        self._sift = cv2.SIFT.create(6000, contrastThreshold=0.01)

    def features(self, camera: int, frame: int):
        """Places (N, 2) and descriptors."""
        if (camera, frame) not in self._found:
            image = cv2.imread(str(self.folder / f"image_{camera}" / f"{frame:06d}.png"), cv2.IMREAD_GRAYSCALE)
            points, descriptors = self._sift.detectAndCompute(image, None)
            self._found[camera, frame] = np.array([point.pt for point in points]), descriptors
        return self._found[camera, frame]

    def matches(self, first, second):
        """Rows (M, 2) of features that are alike."""
        pairs = cv2.BFMatcher().knnMatch(first[1], second[1], k=2)
        return np.array([(a.queryIdx, a.trainIdx) for a, b in pairs if a.distance < RATIO * b.distance])

    def by_essential_matrix(self, i: int, j: int):
        """Rotation from frame i to frame j of the left camera."""
        first, second = self.features(0, i), self.features(0, j)
        rows = self.matches(first, second)
        a, b = first[0][rows[:, 0]], second[0][rows[:, 1]]
        E, inliers = cv2.findEssentialMat(a, b, self.K, method=cv2.RANSAC, prob=0.9999, threshold=EPIPOLAR_PX)
        return cv2.recoverPose(E, a, b, self.K, mask=inliers)[1]

    def by_stereo(self, i: int, j: int):
        """The same from points that the stereo pair places in frame i."""
        left, right, later = self.features(0, i), self.features(1, i), self.features(0, j)
        rows = self.matches(left, right)
        a, b = left[0][rows[:, 0]], right[0][rows[:, 1]]
        good = (abs(a[:, 1] - b[:, 1]) < 1.0) & (a[:, 0] - b[:, 0] > MIN_DISPARITY)
        depth = self.K[0, 0] * self.baseline / (a - b)[good, 0]
        rays = np.column_stack([a[good], np.ones(len(depth))]) @ np.linalg.inv(self.K).T
        place = np.full((len(left[0]), 3), np.nan)
        place[rows[good, 0]] = rays * depth[:, None]
        rows = self.matches(left, later)
        rows = rows[np.isfinite(place[rows[:, 0], 0])]
        X, x = place[rows[:, 0]], later[0][rows[:, 1]]
        _, turn, shift, inliers = cv2.solvePnPRansac(
            X,
            x,
            self.K,
            None,
            reprojectionError=POSE_PX,
            iterationsCount=2000,
            confidence=0.9999,
            flags=cv2.SOLVEPNP_SQPNP,
        )
        inliers = inliers.ravel()
        return cv2.Rodrigues(cv2.solvePnPRefineLM(X[inliers], x[inliers], self.K, None, turn, shift)[0])[0]


def by_adjustment(street: Street, folder: Path) -> np.ndarray:
    """cam_from_world (N, 3, 4) of all frames: features, matches and adjustment by COLMAP, camera held."""
    K = street.K
    pycolmap.set_random_seed(0)
    reader = pycolmap.ImageReaderOptions(
        camera_model="PINHOLE", camera_params=f"{K[0, 0]},{K[1, 1]},{K[0, 2] + 0.5},{K[1, 2] + 0.5}"
    )
    images, database = street.folder / "image_0", folder / "database.db"
    mode = pycolmap.CameraMode.SINGLE
    pycolmap.extract_features(database, images, camera_mode=mode, reader_options=reader)
    pairing = pycolmap.SequentialPairingOptions(overlap=6, quadratic_overlap=False, loop_detection=False)
    pycolmap.match_sequential(database, pairing_options=pairing)
    options = pycolmap.IncrementalPipelineOptions()
    options.ba_refine_focal_length = options.ba_refine_principal_point = options.ba_refine_extra_params = False
    # A camera that goes straight on sees its points under small angles.
    options.mapper.init_min_tri_angle, options.mapper.init_max_forward_motion = 2.0, 1.0
    options.mapper.filter_min_tri_angle, options.triangulation.min_angle = 0.5, 0.5
    options.mapper.abs_pose_min_num_inliers = 20
    made = pycolmap.incremental_mapping(database, images, folder / "model", options=options)
    model = max(made.values(), key=lambda one: one.num_reg_images())
    found = {int(Path(image.name).stem): image.cam_from_world().matrix() for image in model.images.values()}
    return np.array([found.get(k, np.full((3, 4), np.nan)) for k in range(max(found) + 1)])


def angle(first, second) -> float:
    """Angle between two rotations, degrees."""
    return float(np.degrees(np.arccos(np.clip((np.trace(first @ second.T) - 1) / 2, -1, 1))))


def tracked(path: Path, times):
    """Rotations of a TUM trajectory at times (N,), (N, 3, 3); world_from_cam."""
    from groma.geometry import quaternion
    from groma.io.trajectories import read_tum

    track = read_tum(path)
    nearest = [int(np.abs(track.timestamps - time).argmin()) for time in times]
    return quaternion.to_matrix(track.world_from_cam[nearest, :4])


def print_path(name: str, estimate, reference, align: str) -> None:
    """Print the errors of a path, whole and without its first eleven poses."""
    from groma.evaluation.trajectory import score_trajectory

    for begin, part in ((0, "whole"), (11, "from the twelfth pose on")):
        of = [one.take(np.flatnonzero(one.timestamps >= reference.timestamps[begin])) for one in (estimate, reference)]
        found = score_trajectory(*of, align)
        print(
            f"| {name}, {part} | {100 * found.ate.rmse:.1f} cm | {found.drift_percent:.2f} % | "
            f"{found.drift_deg_per_metre:.4f} |",
            flush=True,
        )


def as_path(times, cam_from_world):
    """A trajectory of poses (N, 3, 4); those that are not finite are left out."""
    from groma.geometry import quaternion
    from groma.io.trajectories import Trajectory

    rows = np.flatnonzero(np.isfinite(cam_from_world).all(axis=(1, 2)))
    turn = np.swapaxes(cam_from_world[rows, :, :3], 1, 2)
    center = -np.einsum("nij,nj->ni", turn, cam_from_world[rows, :, 3])
    return Trajectory(times[rows], np.hstack([quaternion.from_matrix(turn), center]))


def main() -> None:
    street = Street(Path(sys.argv[1]))
    reference = np.loadtxt(street.folder / "poses.txt").reshape(-1, 3, 4)[:, :, :3]
    times = np.loadtxt(street.folder / "times.txt")
    groma = tracked(Path(sys.argv[2]) / "trajectory.txt", times)
    columns = ["essential matrix, reference", "stereo, reference", "essential matrix, stereo", "groma, reference",
               "groma, essential matrix"]  # fmt: skip
    adjusted = None
    if pycolmap is not None:
        with tempfile.TemporaryDirectory() as folder:
            adjusted = by_adjustment(street, Path(folder))
        columns += ["COLMAP, reference", "groma, COLMAP"]
    print(f"| frames | {' | '.join(columns)} |\n|---|{'--:|' * len(columns)}", flush=True)
    for i, j in PAIRS:
        essential, stereo = street.by_essential_matrix(i, j), street.by_stereo(i, j)
        truth, ours = reference[j].T @ reference[i], groma[j].T @ groma[i]
        pairs = [(essential, truth), (stereo, truth), (essential, stereo), (ours, truth), (ours, essential)]
        if adjusted is not None:
            colmap = adjusted[j, :, :3] @ adjusted[i, :, :3].T
            pairs += [(colmap, truth), (ours, colmap)]
        print(f"| {i} and {j} | " + " | ".join(f"{angle(*pair):.2f}" for pair in pairs) + " |", flush=True)
    print("\nThe reference from frame to frame, degrees about x, y, z:")
    for i in range(14):
        print(i, np.degrees(cv2.Rodrigues(reference[i + 1].T @ reference[i])[0].ravel()).round(3))

    from groma.io import read_trajectory
    from groma.io.trajectories import read_tum

    path = read_trajectory(street.folder / "poses.txt", "kitti", times)
    print("\n| path | position error | translation error | rotation, degrees a metre |\n|---|--:|--:|--:|")
    print_path("groma", read_tum(Path(sys.argv[2]) / "trajectory.txt"), path, "se3")
    if adjusted is not None:
        print_path("COLMAP", as_path(times, adjusted), path, "sim3")


if __name__ == "__main__":
    main()

# SPDX-License-Identifier: BSD-3-Clause
"""A stereo sequence whose right images are warped as if the right camera were turned by known angles.

    python benchmarks/turned_right.py SEQUENCE [--cases N]

SEQUENCE is one with a reference. The right images are warped by the homography K R K^-1. The untouched sequence is
tracked first: what is found there is what its own rectification left, and is taken from what is found in the others.
Printed are, of every case, pitch and yaw as pixels in the middle of the image and roll as pixels at its left and right
border, made and found, and the errors of the path.
"""

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from groma.geometry import so3
from groma.io.sequences import open_sequence
from groma.tracking.sequence import track

#: Pitch, yaw and roll, pixels.
CASES = [(0.0, 0.0, 0.0), (0.5, 1.2, -0.7), (-0.5, -1.2, 0.7), (0.5, -1.2, -0.7), (-0.5, 1.2, 0.7), (0.0, 1.2, 0.0)]


@dataclass
class Turned:
    """A sequence with its right images warped."""

    sequence: object
    angles: np.ndarray

    def __getattr__(self, name):
        return getattr(self.sequence, name)

    def __iter__(self):
        for frame in self.sequence:
            yield replace(frame, right=self.warped(frame.right)) if self.angles.any() else frame

    def warped(self, image):
        """What a right camera turned by the angles would have seen."""
        fx, fy, cx, cy = self.sequence.camera.params
        K = np.array([[fx, 0.0, cx - 0.5], [0.0, fy, cy - 0.5], [0.0, 0.0, 1.0]])
        turned = K @ so3.exp(self.angles[None])[0] @ np.linalg.inv(K)
        return cv2.warpPerspective(
            image, turned, image.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
        )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--cases", type=int, default=len(CASES))
    arguments = parser.parse_args()
    camera = open_sequence(arguments.sequence).camera
    pixels = np.array([camera.params[1], camera.params[0], camera.width / 2])
    print("| made: pitch, yaw, roll, px | found | standard deviations | error | position error, cm | drift, % |")
    print("|---|---|---|---|---|---|")
    own = np.zeros(3)
    for case in CASES[: arguments.cases]:
        result = track(Turned(open_sequence(arguments.sequence), np.array(case) / pixels))
        found = result.statistics["right_camera"]
        angles, sigma = np.array(found["shift_px"]), np.array(found["sigma_px"])
        if not any(case):
            own = angles
        columns = [" ".join(f"{value:+.2f}" for value in row) for row in (case, angles, sigma, angles - own - case)]
        scores = result.scores
        print(f"| {' | '.join(columns)} | {100 * scores.ate.rmse:.2f} | {scores.drift_percent:.2f} |", flush=True)


if __name__ == "__main__":
    main()

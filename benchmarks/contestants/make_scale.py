# SPDX-License-Identifier: BSD-3-Clause
"""Write a corridor of so many images as an archive of points: ``make_scale.py IMAGES FILE``."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from groma.io import write_archive
from groma.scene import synthetic


def main() -> None:
    path = Path(sys.argv[2])
    draft = path.with_suffix(".draft.npz")
    write_archive(synthetic.corridor(int(sys.argv[1])).start.points_only(), draft, force=True)
    os.replace(draft, path)


if __name__ == "__main__":
    main()

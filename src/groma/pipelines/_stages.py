# SPDX-License-Identifier: BSD-3-Clause
"""Finished stages of a long pipeline, kept in a folder so that an interrupted run goes on from them."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from groma.frontend.segments import Segments
from groma.io import read_archive, write_archive
from groma.scene import Scene


def fingerprint(files: list[Path], model: Scene | None, options: object) -> str:
    digest = hashlib.sha256(repr(options).encode())
    for path in files:
        stat = path.stat()
        digest.update(f"{path.name} {stat.st_size} {stat.st_mtime_ns}".encode())
    if model is not None:
        for array in (
            model.frames.rig_from_world,
            model.points.xyz,
            model.point_observations.pixel,
            model.cameras.params,
        ):
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


class Stages:
    """Finished stages in a folder, valid for one fingerprint of input and options."""

    def __init__(self, folder: Path, fingerprint: str) -> None:
        self.folder = folder
        mark = folder / "fingerprint.json"
        if folder.is_dir():
            try:
                same = json.loads(mark.read_text())["fingerprint"] == fingerprint
            except (OSError, ValueError, KeyError):
                same = False
            if not same:
                shutil.rmtree(folder)
        folder.mkdir(parents=True, exist_ok=True)
        mark.write_text(json.dumps({"fingerprint": fingerprint}))

    def scene(self, name: str, make: Callable[[], Scene]) -> Scene:
        """Return the saved scene of a stage, or make and save it."""
        path = self.folder / f"{name}.npz"
        if path.exists():
            return read_archive(path)
        scene = make()
        write_archive(scene, path, force=True)
        return scene

    def segments(self, make: Callable[[], list[Segments]]) -> list[Segments]:
        """Return the saved segments, or make and save them."""
        path = self.folder / "segments.npz"
        if not path.exists():
            found = make()
            draft = path.with_suffix(".tmp.npz")
            arrays: dict[str, Any] = {
                name: np.concatenate([getattr(s, name) for s in found]) for name in ("ends", "sigma", "strength")
            }
            np.savez(draft, counts=np.array([len(s) for s in found]), **arrays)
            os.replace(draft, path)
        with np.load(path, allow_pickle=False) as saved:
            cuts = np.cumsum(saved["counts"])[:-1]
            parts = (np.split(saved[name], cuts) for name in ("ends", "sigma", "strength"))
            return [Segments(ends, sigma, strength) for ends, sigma, strength in zip(*parts, strict=True)]

# SPDX-License-Identifier: BSD-3-Clause
"""Modules that lie elsewhere now: who imports one by its old name is told the new one."""

from __future__ import annotations

import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

#: Packages and modules whose last name changed too.
_RENAMED = {
    "groma.pipelines": "groma.adjustment (adjust, uncertainty, pose graphs) and groma.mapping (lines, structure)",
    "groma.frontend": "groma.features",
    "groma.solver.dogleg": "gone: Levenberg-Marquardt serves every solve",
    "groma.solver.linear.reduced": "groma.solver.linear.choice (which solver), .dense, .sparse and .pcg",
    "groma.tracking.motion": "groma.tracking.pose.estimate",
    "groma.tracking.observations": "groma.tracking.frame.measurements",
    "groma.tracking.belief": "groma.tracking.pose.verification",
    "groma.tracking.parts": "groma.tracking.backend.submaps",
    "groma.tracking.upkeep": "groma.tracking.map.culling",
}


class _Finder:
    """Comes last, so it is asked only for modules that nobody else found; without its abstract base, slow to import."""

    def find_spec(self, fullname: str, path: Any, target: Any = None) -> None:
        package, _, name = fullname.rpartition(".")
        if not package.startswith("groma"):
            return
        places = [_RENAMED[fullname]] if fullname in _RENAMED else _places(name)
        if places:
            raise ModuleNotFoundError(f"No module named {fullname!r}. It is now {' or '.join(places)}.", name=fullname)


def _places(name: str) -> list[str]:
    from pathlib import Path

    root = Path(__file__).parent
    found = [*root.rglob(f"{name}.py"), *(init.parent for init in root.rglob(f"{name}/__init__.py"))]
    return sorted(".".join(("groma", *file.relative_to(root).with_suffix("").parts)) for file in found)


sys.meta_path.append(_Finder())

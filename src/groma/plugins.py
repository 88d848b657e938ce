# SPDX-License-Identifier: BSD-3-Clause
"""Installed packages that add to groma.

A package names modules in the entry-point group ``groma.plugins``::

    [project.entry-points."groma.plugins"]
    my_lab = "my_lab.groma_parts"

The command line imports them all before a command runs; importing registers camera models, factors, losses, charts and
file formats through their decorators. In Python, import the module yourself, or call :func:`load_plugins`.
Detectors, matchers and retrieval have groups of their own (:mod:`groma.features.registry`).
"""

from __future__ import annotations

import warnings
from functools import cache
from importlib.metadata import entry_points

GROUP = "groma.plugins"


@cache
def load_plugins() -> tuple[str, ...]:
    """Import the plugins of all installed packages, once, and return their names; a broken one causes a warning."""
    loaded = []
    for point in entry_points(group=GROUP):
        try:
            point.load()
        except (Exception, SystemExit) as error:  # a stranger's module may raise anything
            package = point.dist.name if point.dist is not None else point.value
            reason = " ".join(str(error).split())
            warnings.warn(
                f"the plugin {point.name!r} of the package {package} cannot be loaded and is left out: "
                f"{type(error).__name__}: {reason}. Update or uninstall it.",
                UserWarning,
                stacklevel=2,
            )
        else:
            loaded.append(point.name)
    return tuple(loaded)

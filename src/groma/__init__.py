# SPDX-License-Identifier: BSD-3-Clause
"""groma: reconstruct and adjust scenes made of points, lines and planes.

The public names below are loaded when they are first used (PEP 562), so that ``import groma`` compiles nothing and
costs next to nothing. Sub-packages are reachable the same way: ``groma.geometry``, ``groma.cameras``,
``groma.factors``.
"""

import zlib as _zlib  # noqa: F401  (before pycolmap, whose library hides Python's own deflate and breaks it)

from groma._version import __version__ as __version__


def _read_stub() -> tuple[dict[str, tuple[str, str]], frozenset[str]]:
    """Return each public name with its module and its name there, and the sub-packages: as the stub imports them."""
    homes, packages = {}, set()
    with open(__file__.rpartition(".")[0] + ".pyi", encoding="utf-8") as stub:
        for line in stub:
            match line.split():
                case ["from", "groma", "import", package, *_]:
                    packages.add(package)
                case ["from", module, "import", name, *_] if name != "__version__":
                    homes[name] = module, name
                case [name, "=", name_there]:
                    homes[name] = homes.pop(name_there)
    return homes, frozenset(packages)


#: Public names by their home, and sub-packages and modules that are loaded in the same way.
_HOME, _SUBPACKAGES = _read_stub()
__all__ = sorted([*_HOME, *_SUBPACKAGES])  # pyright: ignore[reportUnsupportedDunderAll]  (it reads the stub)


def __getattr__(name: str) -> object:
    from importlib import import_module  # not before: a command answers Ctrl-C once this file is loaded

    if name in _HOME:
        module, name_there = _HOME[name]
        value = getattr(import_module(module), name_there)
    elif name in _SUBPACKAGES:
        value = import_module(f"groma.{name}")
    else:
        raise AttributeError(f"module 'groma' has no attribute {name!r}. Public names: {', '.join(__all__)}.")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])

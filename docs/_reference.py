# SPDX-License-Identifier: BSD-3-Clause
"""Two directives that look for what there is.

``package-reference``: one section per public module of a package. ``short-names``: the names of :mod:`groma` itself, a
table per package, each with its first sentence and a link to its documentation there.
"""

import importlib
import inspect
import pkgutil
from collections import defaultdict
from typing import cast

from _supported_names import public_names, supported
from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.domains.python import PythonDomain
from sphinx.util.docutils import SphinxDirective

import groma


class PackageReference(SphinxDirective):
    """Document the package, then each module in it; modules with a leading underscore only when named."""

    required_arguments = 1
    optional_arguments = 20

    def run(self) -> list[nodes.Node]:
        """Build the sections."""
        package = importlib.import_module(self.arguments[0])
        names = [package.__name__]
        found = {module.name for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")}
        names += sorted(name for name in found if "._" not in name)
        names += [f"{package.__name__}.{name}" for name in self.arguments[1:]]
        return [self._section(name) for name in dict.fromkeys(names)]

    def _section(self, name: str) -> nodes.Node:
        module = importlib.import_module(name)
        # Constants of a module are its own affair unless it names them, or they are supported.
        names = [*public_names(module), *supported().get(name, ())]
        if hasattr(module, "__path__"):  # what it passes on has its place in another section
            names = [one for one in names if getattr(getattr(module, one), "__module__", None) == name]
        members = ", ".join(dict.fromkeys(names))
        section = nodes.section(ids=[f"module-{name.replace('.', '-')}-section"])
        section += nodes.title(text=name)
        lines = [f".. automodule:: {name}", f"   :members: {members}" if members else "   :no-members:", ""]
        self.state.nested_parse(StringList(lines, source=f"<{name}>"), self.content_offset, section)
        return section


class ShortNames(SphinxDirective):
    """Tables of the names of groma: what is documented elsewhere can be searched by its short name."""

    def run(self) -> list[nodes.Node]:
        """Build the tables."""
        rooms: dict[str, list[str]] = defaultdict(list)
        for name in vars(groma)["__all__"]:
            if not inspect.ismodule(value := getattr(groma, name)):
                rooms[value.__module__.split(".")[1]].append(name)
        return [self._section(room, rooms[room]) for room in sorted(rooms)]

    def _section(self, room: str, names: list[str]) -> nodes.Node:
        section = nodes.section(ids=[f"names-of-{room}"])
        section += nodes.title(text=f"groma.{room}")
        lines = [".. list-table::", "   :widths: 30 70", ""]
        for name in names:
            value = getattr(groma, name)
            sentence = (inspect.getdoc(value) or "").partition("\n\n")[0].replace("\n", " ")
            lines += [f"   * - :py:obj:`{name} <{value.__module__}.{value.__qualname__}>`", f"     - {sentence}"]
            domain = cast(PythonDomain, self.env.get_domain("py"))
            domain.note_object(f"groma.{name}", "class" if inspect.isclass(value) else "function", section["ids"][0])
        self.state.nested_parse(StringList(lines, source=f"<groma.{room}>"), self.content_offset, section)
        return section


def setup(app: Sphinx) -> dict[str, object]:
    """Register the directives."""
    app.add_directive("package-reference", PackageReference)
    app.add_directive("short-names", ShortNames)
    return {"parallel_read_safe": True}

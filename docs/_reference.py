# SPDX-License-Identifier: BSD-3-Clause
"""The directive ``package-reference``: one section per public module of a package, found by looking."""

import importlib
import pkgutil

from _supported_names import public_names, supported
from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective


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
        names = [] if hasattr(module, "__path__") else [*public_names(module), *supported().get(name, ())]
        members = ", ".join(dict.fromkeys(names))
        section = nodes.section(ids=[f"module-{name.replace('.', '-')}-section"])
        section += nodes.title(text=name)
        lines = [f".. automodule:: {name}", f"   :members: {members}" if members else "   :no-members:", ""]
        self.state.nested_parse(StringList(lines, source=f"<{name}>"), self.content_offset, section)
        return section


def setup(app: Sphinx) -> dict[str, object]:
    """Register the directive."""
    app.add_directive("package-reference", PackageReference)
    return {"parallel_read_safe": True}

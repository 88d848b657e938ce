# SPDX-License-Identifier: BSD-3-Clause
"""Settings of the documentation. Build: sphinx-build -W -b html docs docs/_build/html."""

import os
import re
import sys
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.ext.napoleon.docstring import NumpyDocstring

import groma

os.environ.setdefault("NUMBA_CACHE_DIR", str(Path(__file__).resolve().parents[1] / ".cache" / "docs"))
sys.path.insert(0, str(Path(__file__).parent))

project = "groma"
author = "the groma developers"
copyright = "2026, the groma developers"
release = version = groma.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "_factor_table",
    "_figures",
    "_formulas",
    "_navigation",
    "_pose_conventions",
    "_reference",
    "_segment_figures",
    "_thresholds",
]
myst_enable_extensions = ["dollarmath", "amsmath", "deflist", "colon_fence"]
myst_heading_anchors = 3

# The notebooks are run when they or the machine are new.
nb_execution_mode = "cache"
nb_execution_raise_on_error = True
nb_execution_timeout = 600
nb_output_stderr = "remove"
nb_merge_streams = True

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_default_options = {"show-inheritance": True}
autodoc_preserve_defaults = True
# The contents beside a page say "loss", not "AdjustOptions.loss", which breaks over two lines.
toc_object_entries_show_parents = "hide"
# There are none; looking for them parses the source of every function.
autodoc_use_type_comments = False
# Signatures say FloatArray and not what that is made of.
autodoc_type_aliases = {name: name for name in ("BoolArray", "FloatArray", "IntArray")}
# Words in the prose of a parameter's type ("name", "kind") are looked up as if they were types; more than one class has
# an attribute of that name, and none is meant.
suppress_warnings = ["ref.python"]
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_preprocess_types = False

html_theme = "furo"
html_math_renderer = "drawn"
html_title = f"groma {release}"
html_static_path = ["_static"]
html_css_files = ["layout.css", "versions.css"]
html_js_files = ["versions.js"]
templates_path = ["_templates"]
# The theme's sidebar, with a choice of versions where the site has several (packaging/publish_documentation.py).
_PARTS = ("brand", "search", "scroll-start", "navigation", "scroll-end", "variant-selector")
html_sidebars = {"**": [f"sidebar/{part}.html" for part in _PARTS]}
html_sidebars["**"].insert(2, "versions.html")
#: The folder of the site that these pages go to: a release, or a branch.
html_context = {"published_as": os.environ.get("GROMA_DOCUMENTATION", release).removeprefix("v")}
exclude_patterns = ["_build", "_templates"]

#: What an array type is made of, and a name that Python defers, where the aliases above do not reach: inside others.
_ARRAY = re.compile(
    r"~?(?:numpy\.)?ndarray\[tuple\[~?(?:typing\.)?Any, (?:\.\.\.|…)\], ~?(?:numpy\.)?dtype\[~?(?:numpy\.)?(\w+)\]\]"
)
_DEFERRED = re.compile(r"~?(?:[\w.]+\.)?TypeAliasForwardRef\('(\w+)'\)")
_LIKE = re.compile(r"~?[\w.]*_Buffer \| .*?_NestedSequence\[complex \| bytes \| str\]")
_SHORT = {"float64": "FloatArray", "integer": "IntArray", "bool": "BoolArray", "bool_": "BoolArray"}
_BACK = re.compile(r'<a class="viewcode-back" href="((?:\.\./)*)([\w/-]+)\.html#([\w.]+)">')
_PIPES = re.compile(r"(`[^`]*`)|(?<!\\)\|([^|\s][^|]*?)\|")


def _short(text: str) -> str:
    text = _LIKE.sub("ArrayLike", text)
    text = _ARRAY.sub(lambda match: _SHORT.get(match[1], f"NDArray[{match[1]}]"), text)
    return _DEFERRED.sub(lambda match: match[1], text)


def _shorten_signature(
    app: Sphinx, what: str, name: str, obj: object, options: object, signature: str | None, returns: str | None
) -> tuple[str | None, str | None]:
    """Let signatures say FloatArray, or ``NDArray[uint8]``, wherever an array type stands."""
    return signature and _short(signature), returns and _short(returns)


def _shorten_attributes(app: Sphinx, doctree: nodes.document) -> None:
    """Do the same for the types of attributes and for what a name stands for; drop bases that say nothing."""
    for kind in (addnodes.desc_annotation, nodes.paragraph):
        for part in list(doctree.findall(kind)):
            text = part.astext()
            if (kind is addnodes.desc_annotation or text.startswith("alias of")) and _short(text) != text:
                part.children = [nodes.Text(_short(text))]
            elif text == "Bases: object":
                part.parent.remove(part)


def _escape_signs(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Let ``|d|`` be an absolute value and ``*shape`` a shape in running text; formulas and literals stay."""
    in_math = False
    for index, line in enumerate(lines):
        if line.strip() and not line.startswith(" "):
            in_math = False
        if ".. math::" in line or line.rstrip().endswith("::"):
            in_math = True
        if not in_math:
            line = _PIPES.sub(lambda match: match[1] or rf"\|{match[2]}\|", line)
            line = re.sub(r"(?<=[( ])\*(?=\w+[,)])", r"\\*", line)
            lines[index] = line


def _parse_attribute_as_text(self: NumpyDocstring) -> list[str]:
    """Parse the comment of an attribute as text; napoleon takes what stands before a colon for its type."""
    return NumpyDocstring(list(self._lines), self._config, self._app, "method", self._name, self._obj).lines()


def _link_back(app: Sphinx, page: str, template: str, context: dict[str, Any], doctree: nodes.document | None) -> None:
    """Let a source link to the name that it is documented under: viewcode takes one module for all names of a file."""
    entries = app.env.domains.python_domain.objects

    def right(match: re.Match[str]) -> str:
        document, name = match[2], match[3]
        last = f".{name.rpartition('.')[2]}"
        alike = (entry for key, entry in entries.items() if key.endswith(last) and entry.docname == document)
        found = entries.get(name) or next(alike, None)
        return f'<a class="viewcode-back" href="{match[1]}{found.docname}.html#{found.node_id}">' if found else "<a>"

    if page.startswith("_modules/"):
        context["body"] = _BACK.sub(right, context["body"])


def setup(app: Sphinx) -> None:
    """Register the five above, and links to pages of the sources."""
    app.connect("autodoc-process-signature", _shorten_signature)
    app.connect("doctree-read", _shorten_attributes)
    NumpyDocstring._parse_attribute_docstring = _parse_attribute_as_text
    app.connect("autodoc-process-docstring", _escape_signs)
    # Pages of the sources, six of seven of all pages, are left out where pages are only checked: sphinx-build -t check.
    if not app.tags.has("check"):
        app.setup_extension("sphinx.ext.viewcode")
        app.connect("html-page-context", _link_back)

# SPDX-License-Identifier: BSD-3-Clause
"""Settings of the documentation. Build: sphinx-build -W -b html docs docs/_build/html."""

import os
import sys
from pathlib import Path

import groma

os.environ.setdefault("NUMBA_CACHE_DIR", str(Path(__file__).resolve().parents[1] / ".cache" / "docs"))
sys.path.insert(0, str(Path(__file__).parent))

project = "groma"
author = "the groma developers"
copyright = "2026, the groma developers"
release = version = groma.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "_factor_table",
    "_reference",
]
myst_enable_extensions = ["dollarmath", "amsmath", "deflist", "colon_fence"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_preserve_defaults = True
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_preprocess_types = False

html_theme = "furo"
html_title = f"groma {release}"
exclude_patterns = ["_build"]

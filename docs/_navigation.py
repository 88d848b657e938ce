# SPDX-License-Identifier: BSD-3-Clause
"""The list of pages beside every page, from titles alone.

The theme shows titles, but Sphinx copies the whole table of contents of all pages for every page, and drops what is no
title from the copy. The reference has thousands of entries, so that is most of the time of a build.
"""

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx


def _title_alone(contents: nodes.bullet_list) -> nodes.bullet_list:
    """Return a page's contents with its title and the lists of pages in it, without its sections."""
    result = contents.copy()
    for entry in contents.children:
        pages = [part.deepcopy() for part in entry.findall(addnodes.toctree)]
        alone = entry.copy()
        alone += [part.deepcopy() for part in entry.children[:1]]
        if pages:
            alone += nodes.bullet_list("", *pages)
        result += alone
    return result


def _use_titles(app: Sphinx, page: str, template: str, context: dict, doctree: nodes.document | None) -> None:
    """Let the theme ask for the list of pages where tables of contents are titles."""
    env, whole = app.env, context["toctree"]

    def toctree(**options: object) -> str:
        kept = env.tocs
        env.tocs = titles
        try:
            return whole(**options)
        finally:
            env.tocs = kept

    titles = _titles_of(app)
    context["toctree"] = toctree


def _titles_of(app: Sphinx) -> dict[str, nodes.bullet_list]:
    if not hasattr(app, "_titles_of_pages"):
        app._titles_of_pages = {page: _title_alone(toc) for page, toc in app.env.tocs.items()}
    return app._titles_of_pages


def setup(app: Sphinx) -> dict[str, object]:
    """Replace the theme's source of the list, before the theme asks."""
    app.connect("html-page-context", _use_titles, priority=400)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

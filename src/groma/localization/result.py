# SPDX-License-Identifier: BSD-3-Clause
"""The folder of results: poses, the model with the queries in it, numbers, and a page."""

from __future__ import annotations

import html
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from groma._counted import counted
from groma.bounded.json_text import json_text
from groma.io import atomic_output, write_scene
from groma.localization.map_index import MapIndex
from groma.localization.registered import with_queries
from groma.localization.stored import StoredImage
from groma.scene import Scene
from groma.viz.report.page import PageContents, write_report


@dataclass(frozen=True, eq=False)
class LocalizeResult:
    """Queries in a map."""

    #: The map, and what was described of it.
    map: Scene
    index: MapIndex
    #: All queries, found or not.
    queries: tuple[StoredImage, ...]

    def count(self, status: str) -> int:
        """Number of queries with a status."""
        return sum(one.status == status for one in self.queries)

    def to_dict(self) -> dict[str, object]:
        """Return the content of ``localized.json``: an entry for each query, by name."""
        return {one.name: one.to_dict() for one in self.queries}

    def poses(self) -> str:
        """Return the content of ``poses.txt``, as hloc has it: name qw qx qy qz tx ty tz of what is localised."""
        rows = []
        for one in self.queries:
            if one.status == "localized":
                numbers = " ".join(repr(float(number)) for number in (*one.pose[[3, 0, 1, 2]], *one.pose[4:]))
                rows.append(f"{one.name} {numbers}\n")
        return "".join(rows)

    def scene(self, of_map: bool = True) -> Scene:
        """Return the map with the localised queries as further images; or these alone, with what they see."""
        chosen = [one for one in self.queries if one.status == "localized"]
        scene = with_queries(self.map, self.index, chosen)
        if of_map:
            return scene
        return scene.subset(np.arange(self.map.num_images, scene.num_images))

    def write(
        self,
        folder: str | os.PathLike[str],
        files: Mapping[str, Path],
        title: str = "Localised photographs",
        *,
        force: bool = False,
        work: str | os.PathLike[str] | None = None,
    ) -> None:
        """Write everything that ``groma localize`` writes to a folder, whole or not at all.

        Parameters
        ----------
        folder
            Made here.
        files
            The photographs by name, for the page.
        title
            Heading of the page.
        force
            Replace what is there.
        work
            Folder on the same disk in which the results are built; by default beside ``folder``.
        """
        with atomic_output(folder, force, work) as draft:
            write_scene(self.scene(), draft, format="colmap")
            (draft / "poses.txt").write_text(self.poses(), encoding="utf-8")
            (draft / "localized.json").write_text(json_text(self.to_dict()), encoding="utf-8")
            contents = PageContents(cards=_table(self.queries))
            alone = self.scene(of_map=False)
            named = {name: files[self._query_of(name)] for name in alone.images.names}
            shown = alone if alone.num_images else self.map
            write_report(draft / "report.html", None, shown, None, named, title, contents)

    def _query_of(self, name: str) -> str:
        known = {one.name for one in self.queries}
        return name if name in known else name.removeprefix("query/")


def _table(queries: Sequence[StoredImage]) -> str:
    """The queries as a card of the page."""
    rows = "".join(
        f'<tr><td class="name">{html.escape(one.name)}</td><td>{one.status}</td>'
        f"<td>{len(one.point):,}</td><td>{len(one.line):,}</td>"
        f'<td class="words">{html.escape(one.sentence)}</td></tr>'
        for one in queries
    )
    count = sum(one.status == "localized" for one in queries)
    return (
        '<section class="card wide"><h2>Queries</h2><p class="caption">'
        f"{count} of {counted(len(queries), 'photographs')} localised. "
        "The images show what of the map was found in each.</p>"
        "<table><thead><tr><th>photograph</th><th>status</th><th>points</th><th>lines</th><th></th></tr></thead>"
        f"<tbody>{rows}</tbody></table></section>"
    )

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

#: Head of the table of photographs, on the screen and on the page.
COLUMNS = ("photograph", "status", "points", "lines", "centre known to", "rotation")


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
            contents = PageContents(cards=card_of(self.queries))
            alone = self.scene(of_map=False)
            named = {name: files[self._query_of(name)] for name in alone.images.names}
            shown = alone if alone.num_images else self.map
            write_report(draft / "report.html", None, shown, None, named, title, contents)

    def _query_of(self, name: str) -> str:
        known = {one.name for one in self.queries}
        return name if name in known else name.removeprefix("query/")


def row_of(one: StoredImage) -> tuple[str, ...]:
    """Return a row of the table with the head :data:`COLUMNS`."""
    numbers = one.to_dict()
    sigma, turn = numbers["center_sigma"], numbers["rotation_sigma_deg"]
    center = "" if sigma is None else _two_digits(sum(value * value for value in sigma) ** 0.5)
    seen = (f"{numbers['num_point_inliers']:,}", f"{numbers['num_line_inliers']:,}")
    return one.name, one.status, *seen, center, "" if turn is None else f"{_two_digits(turn)}°"


def _two_digits(value: float) -> str:
    return f"{value:#.2g}".rstrip(".")


def card_of(queries: Sequence[StoredImage]) -> str:
    """Return the queries as a card of the page; where it is narrow, each is a block whose numbers bear their names."""
    rows = []
    for one in queries:
        name, *cells = row_of(one)
        told = "".join(f'<td data-name="{column}">{cell}</td>' for column, cell in zip(COLUMNS[1:], cells, strict=True))
        words = html.escape(one.sentence)
        rows.append(f'<tr><td class="name">{html.escape(name)}</td>{told}<td class="words">{words}</td></tr>')
    head = "".join(f"<th>{name}</th>" for name in COLUMNS)
    count = sum(one.status == "localized" for one in queries)
    return (
        '<section class="card wide"><h2>Photographs</h2><p class="caption">'
        f"{count} of {counted(len(queries), 'photographs')} localised. "
        "The images show what of the map was found in each. Standard deviations: of the centre, in units of the map, "
        f"and of the rotation.</p><table><thead><tr>{head}<th></th></tr></thead>"
        f"<tbody>{''.join(rows)}</tbody></table></section>"
    )

# SPDX-License-Identifier: BSD-3-Clause
"""The README as the package index shows it: links lead to the repository, and so do those beside the description.

In come the README and the address of the repository, in the variable ``GROMA_REPOSITORY`` while a release is built
(``.github/workflows/release.yml``). Without it the README stays as it is, and there are no addresses.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

_LINK = re.compile(r"(!?)(\[[^\]]*\])\((?!https?:|#)([^)\s]+)\)")


def linked(text: str, address: str, version: str) -> str:
    """Return Markdown whose relative links lead into a repository, at the tag of a version."""

    def absolute(found: re.Match[str]) -> str:
        mark, words, place = found.groups()
        return f"{mark}{words}({address}/{'raw' if mark else 'blob'}/v{version}/{place})"

    return _LINK.sub(absolute, text)


class Metadata(MetadataHookInterface):
    """Adds to the metadata what depends on the repository."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Add the description, and addresses where there is a repository."""
        text = Path(self.root, "README.md").read_text(encoding="utf-8")
        if address := os.environ.get("GROMA_REPOSITORY", "").rstrip("/"):
            text = linked(text, address, metadata["version"])
            pages = {"Documentation": "docs/index.md", "Changelog": "CHANGELOG.md"}
            metadata["urls"] = {"Source": address, "Issues": f"{address}/issues"} | {
                name: f"{address}/blob/v{metadata['version']}/{page}" for name, page in pages.items()
            }
        metadata["readme"] = {"content-type": "text/markdown", "text": text}

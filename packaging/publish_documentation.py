# SPDX-License-Identifier: BSD-3-Clause
"""Put the pages of one version beside those of others, and list the versions for the choice in the sidebar.

    python packaging/publish_documentation.py BUILT SITE VERSION

``SITE`` has a folder for each version, ``versions.json`` (the newest release first, other names such as ``main`` last)
and an ``index.html`` that leads to the first of them. What ``SITE/VERSION`` held before is replaced.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
from pathlib import Path

FORWARD = """<!doctype html>
<meta charset="utf-8">
<title>groma</title>
<link rel="canonical" href="{first}/">
<meta http-equiv="refresh" content="0; url={first}/">
<p><a href="{first}/">Documentation of groma {first}</a></p>
"""
_RELEASE = re.compile(r"\d+(\.\d+)*")
_NAME = re.compile(r"[0-9A-Za-z][0-9A-Za-z._-]*")


def order(name: str) -> tuple[bool, list[int], str]:
    """Return what versions are sorted by: releases by their numbers, behind everything else."""
    release = bool(_RELEASE.fullmatch(name))
    return release, [int(number) for number in name.split(".")] if release else [], name


def publish(built: Path, site: Path, version: str) -> list[str]:
    """Put pages into a site and return the versions that it has now."""
    if not _NAME.fullmatch(version):
        raise SystemExit(f"{version!r} is not a version: expected letters, digits, dots and dashes, such as 0.2.0.")
    if not (built / "index.html").is_file():
        raise SystemExit(f"{built} has no index.html. Build the pages first: sphinx-build -b html docs {built}")
    site.mkdir(parents=True, exist_ok=True)
    draft, place = site / f".{version}", site / version
    shutil.rmtree(draft, ignore_errors=True)
    shutil.copytree(built, draft, ignore=shutil.ignore_patterns(".doctrees", ".buildinfo"))
    shutil.rmtree(place, ignore_errors=True)
    draft.rename(place)
    names = (path.name for path in site.iterdir() if (path / "index.html").is_file() and path.name[0] != ".")
    versions = sorted(names, key=order, reverse=True)
    (site / "versions.json").write_text(json.dumps(versions) + "\n")
    (site / "index.html").write_text(FORWARD.format(first=versions[0]))
    # GitHub would leave out _static otherwise.
    (site / ".nojekyll").touch()
    return versions


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("built", type=Path)
    parser.add_argument("site", type=Path)
    parser.add_argument("version")
    arguments = parser.parse_args()
    print("Versions of the site:", ", ".join(publish(arguments.built, arguments.site, arguments.version)))


if __name__ == "__main__":
    main()

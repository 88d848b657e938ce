# SPDX-License-Identifier: BSD-3-Clause
"""The page of licences names every package that an installation brings, under the licence that the package declares."""

import re
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "licences.md"
#: How a row of the page begins, and what packages that stand in it say of themselves.
DECLARED = {
    "BSD": r"BSD", "MIT": r"\bMIT\b|MIT-CMU", "Apache": r"Apache", "ISC": r"ISC", "PSF": r"PSF|Python Software",
    "MPL": r"MPL",
}  # fmt: skip

pytestmark = pytest.mark.skipif(not PAGE.exists(), reason="the documentation is not there")


def name_of(requirement: str) -> str:
    return re.sub(r"[-_.]+", "-", re.match(r"[\w.-]+", requirement)[0]).lower()


def installed(name: str, found: dict[str, str]) -> dict[str, str]:
    """Declared licences of a package and of what it requires here; what is not installed is required elsewhere."""
    if name in found:
        return found
    try:
        package = distribution(name)
    except PackageNotFoundError:
        return found
    about = package.metadata
    kinds = [text for text in about.get_all("Classifier") or [] if text.startswith("License")]
    found[name] = " ".join([about.get("License-Expression") or "", (about.get("License") or "")[:200], *kinds])
    for requirement in package.requires or []:
        if "extra ==" not in requirement:
            installed(name_of(requirement), found)
    return found


def test_every_package_stands_in_the_row_of_its_licence():
    rows = dict(re.findall(r"^\| (BSD|MIT|Apache|ISC|PSF|MPL)[^|]*\| ([^|]+) \|$", PAGE.read_text(), re.MULTILINE))
    assert set(rows) == set(DECLARED)
    listed = {name: licence for licence, names in rows.items() for name in names.split(", ")}
    found = installed("groma", {})
    del found["groma"]
    assert len(found) > 25
    assert set(found) <= set(listed)
    for name, declared in found.items():
        assert re.search(DECLARED[listed[name]], declared), (name, declared)

# SPDX-License-Identifier: BSD-3-Clause
"""What packages are made from says the same everywhere: version, Pythons, dependencies; links lead somewhere."""

import json
import re
import runpy
import tomllib
from pathlib import Path

import pytest

import groma

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
#: Packages that conda-forge has under another name.
CONDA_NAMES = {"opencv-python-headless": "py-opencv"}


def _recipe():
    yaml = pytest.importorskip("yaml")
    return yaml.safe_load((ROOT / "packaging" / "conda" / "recipe.yaml").read_text(encoding="utf-8"))


def test_citation_and_conda_recipe_are_of_this_version_with_these_dependencies():
    recipe = _recipe()
    named = [re.fullmatch(r"([\w-]+)(.*)", line).groups() for line in PROJECT["dependencies"]]
    wanted = {f"{CONDA_NAMES.get(name, name)} {bounds}" for name, bounds in named}
    assert recipe["context"]["version"] == PROJECT["version"] == groma.__version__
    assert {*recipe["requirements"]["run"]} == wanted | {f"python {PROJECT['requires-python']}"}
    assert f"\nversion: {groma.__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    scripts = [f"{name} = {place}" for name, place in PROJECT["scripts"].items()]
    assert recipe["build"]["python"]["entry_points"] == scripts


@pytest.mark.parametrize("workflow", ["tests", "release"])
def test_workflows_go_through_every_python_of_the_metadata(workflow):
    text = (ROOT / ".github" / "workflows" / f"{workflow}.yml").read_text(encoding="utf-8")
    pythons = [line.rpartition(" ")[2] for line in PROJECT["classifiers"] if re.search(r":: 3\.\d+$", line)]
    assert len(pythons) > 3
    assert f"python: {json.dumps(pythons)}" in text


def test_links_of_the_readme_lead_somewhere_here_and_on_the_package_index():
    pytest.importorskip("hatchling")
    made = runpy.run_path(str(ROOT / "packaging" / "metadata.py"))
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    places = [place.partition("#")[0] for _, _, place in made["_LINK"].findall(text)]
    assert len(places) > 30
    assert [place for place in places if not (ROOT / place).exists()] == []
    linked = made["linked"](text, "https://example.org/groma", "1.2.3")
    assert not made["_LINK"].search(linked)
    for place in places:
        assert f"https://example.org/groma/blob/v1.2.3/{place}" in linked or f"/raw/v1.2.3/{place}" in linked
    assert "](https://example.org/groma/raw/v1.2.3/docs/images/demo.jpg)" in linked


def test_pages_of_versions_stand_side_by_side_and_the_newest_release_comes_first(tmp_path):
    publish = runpy.run_path(str(ROOT / "packaging" / "publish_documentation.py"))["publish"]
    built, site = tmp_path / "built", tmp_path / "site"
    (built / ".doctrees").mkdir(parents=True)
    for version in ("main", "0.9.0", "0.10.0", "0.2.1"):
        (built / "index.html").write_text(f"pages of {version}")
        versions = publish(built, site, version)
    assert versions == json.loads((site / "versions.json").read_text()) == ["0.10.0", "0.9.0", "0.2.1", "main"]
    assert "url=0.10.0/" in (site / "index.html").read_text()
    assert (site / "0.9.0" / "index.html").read_text() == "pages of 0.9.0"
    assert not (site / "main" / ".doctrees").exists()
    # Pages that are gone do not stay behind.
    (built / "guide.html").touch()
    publish(built, site, "main")
    (built / "guide.html").unlink()
    publish(built, site, "main")
    assert not (site / "main" / "guide.html").exists()


@pytest.mark.parametrize("version", ["../elsewhere", ".hidden", "", "a/b"])
def test_names_that_lead_out_of_the_site_are_no_versions(tmp_path, version):
    publish = runpy.run_path(str(ROOT / "packaging" / "publish_documentation.py"))["publish"]
    (tmp_path / "index.html").touch()
    with pytest.raises(SystemExit, match="is not a version"):
        publish(tmp_path, tmp_path / "site", version)

# SPDX-License-Identifier: BSD-3-Clause
"""The page of a folder whose ``summary.json`` is damaged anywhere: it is made, with the summary or without it."""

import copy
import json
import warnings

import pytest

from groma.adjustment.adjust import AdjustOptions, adjust
from groma.scene.synthetic.scenes import holistic
from groma.viz.report.page import PageContents, write_report
from groma.viz.report.saved import saved_report


@pytest.fixture(scope="module")
def summary():
    """A summary with all that the page can show of it, but with one step and stage only."""
    numbers = adjust(holistic(4, seed=1).start, AdjustOptions(max_iterations=2)).summary()
    numbers = {**numbers, "segments": {"mapped": 3}, "explanation": "As seen.", "history": numbers["history"][:1]}
    return json.loads(json.dumps(numbers))


def entries(value, path=()):
    """Yield the path of every entry of nested dictionaries and lists; of a list, its first."""
    inner = value.items() if isinstance(value, dict) else enumerate(value[:1]) if isinstance(value, list) else ()
    for key, one in inner:
        yield (*path, key)
        yield from entries(one, (*path, key))


def changed(value, path, new):
    """Return a copy with another value at a path; without it where ``new`` is None."""
    out = copy.deepcopy(value)
    inside = out
    for key in path[:-1]:
        inside = inside[key]
    if new is None:
        del inside[path[-1]]
    else:
        inside[path[-1]] = new
    return out


def test_a_summary_damaged_at_any_entry_never_stops_the_page(tmp_path, summary):
    scene = holistic(4, seed=1).start.points_only()
    paths = list(entries(summary))
    assert ("inliers", "points", "share", "after") in paths
    made = without = 0
    for path in paths:
        for new in (None, "<b>", [], {}, -1, True):
            (tmp_path / "summary.json").write_text(json.dumps(changed(summary, path, new)))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                report = saved_report(tmp_path)
            if report is None:
                without += 1
                continue
            made += 1
            contents = PageContents(report.outcomes, report.explanation)
            write_report(tmp_path / "page.html", None, scene, report, contents=contents)
    assert made > 100
    assert without > 50

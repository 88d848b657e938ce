# SPDX-License-Identifier: BSD-3-Clause
"""The benchmark of wrong answers: its interval, its pictures, trials that are not repeated, and its rows of windows."""

import importlib
import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import binom

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.fixture
def benchmark(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    monkeypatch.delitem(sys.modules, "localize_wrong", raising=False)
    return importlib.import_module("localize_wrong")


@pytest.mark.parametrize(("k", "n"), [(0, 1000), (1, 58), (30, 100), (7, 7)])
def test_the_interval_is_that_of_rates_which_make_the_count_unlikely(benchmark, k, n):
    low, high = benchmark.interval(k, n)
    assert 0.0 <= low <= k / n <= high <= 1.0
    if k > 0:
        assert binom.sf(k - 1, n, low) == pytest.approx(0.025)
    if k < n:
        assert binom.cdf(k, n, high) == pytest.approx(0.025)


def test_blocks_in_another_order_are_the_same_blocks(benchmark):
    image = np.arange(12 * 16, dtype=np.uint16).reshape(12, 16)
    other = benchmark._shuffled(image, np.random.default_rng(0))
    blocks = [{part.tobytes() for row in np.split(x, 3) for part in np.split(row, 4, axis=1)} for x in (image, other)]
    assert blocks[0] == blocks[1]
    assert not np.array_equal(image, other)


def test_trials_that_are_done_are_not_repeated_and_are_counted(benchmark, tmp_path):
    tried = []
    statuses = {"a": "localized", "b": "uncertain", "c": "localized"}

    def localize(picture):
        tried.append(picture)
        return SimpleNamespace(pose=SimpleNamespace(status=statuses[picture], sentence=""))

    def works(names):
        trials = [benchmark.Trial("kind", n, lambda n=n: n, lambda found, n=n: n == "a") for n in names]
        yield "place", lambda: SimpleNamespace(localize=localize), lambda _: trials

    file = tmp_path / "trials.jsonl"
    benchmark.tried(works("ab"), file, 1.0)
    benchmark.tried(works("abc"), file, 1.0)
    benchmark.tried(works("abcd"), file, -1.0)  # no time is left
    assert tried == ["a", "b", "c"]
    assert [json.loads(line)["wrong"] for line in file.read_text().splitlines()] == [True, False, False]
    told = benchmark.rate([file])
    assert "| place | kind | 3 | 2 | 1 | 1 |" in told
    assert "1 of 3 wrong: 33.33 %" in told


def test_windows_repeat_and_what_is_beside_them_does_not(benchmark):
    from _turning import Film, Renderer
    from _windows import CAMERA, STEP, facade

    def seen(world, along):
        """What a camera 4 metres before a facade sees of one upper window."""
        pose = np.array([0.0, 0, 0, 1, -along, 5.4, 4.0])
        return Renderer(world, CAMERA).picture(pose, pose, Film(0.1))[0]

    world, other = facade(0), facade(0, other=True)
    pictures = [seen(world, 10.5), seen(world, 10.5 + STEP), seen(other, 10.5)]
    window = (slice(220, 300), slice(300, 380))
    beside = (slice(130, 330), slice(480, 560))
    for picture in pictures[1:]:
        assert np.abs(picture[window] - pictures[0][window]).max() < 1.0
        assert np.abs(picture[beside] - pictures[0][beside]).mean() > 1.0
    assert pictures[0][window].std() > 10.0

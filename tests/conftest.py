# SPDX-License-Identifier: BSD-3-Clause
"""Settings that hold for every test: the kernel cache, hypothesis, the data beside the checkout.

Compiled kernels go to a folder of the checkout rather than beside the sources. Edits are noticed there as anywhere
(:mod:`groma._kernels.cache`). The variable is set before Numba is imported, which reads it then.
"""

import gc
import os
from pathlib import Path
from typing import Any

import hypothesis
import pytest

ROOT = Path(__file__).resolve().parents[1]
SHARED_DATA = ROOT.parent / "shared" / "data"
SHARED_GOLDEN = ROOT.parent / "shared" / "math" / "golden"

os.environ.setdefault("NUMBA_CACHE_DIR", str(ROOT / ".cache" / "numba"))
if "PYTEST_XDIST_WORKER" in os.environ:  # it keeps a core busy by itself
    os.environ |= dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")
os.environ.setdefault("GROMA_COMPILE_PROCESSES", "0")
#: Folders whose files take long, so that no worker is left with one of them at the end of a run.
LONG = ("tracking", "hostile", "mapping", "tests", "viz", "localization", "cli", "adjustment")

hypothesis.settings.register_profile(
    "groma",
    deadline=None,
    derandomize=True,
    print_blob=False,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
    database=None,
)
hypothesis.settings.load_profile("groma")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Give whole files to the workers of ``-n``: fixtures of a module are made once, and two workers seldom need the
    same function compiled at the same moment. In the order of the tests, not with the most numerous first."""
    from xdist.scheduler import LoadFileScheduling

    config.option.loadscopereorder = False
    return LoadFileScheduling(config, log) if config.getvalue("dist") == "load" else None


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Any:
    """Nothing goes away while tests are collected, and it stays: to look for it took a quarter of that time."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def _long_first(item: pytest.Item) -> tuple[int, int]:
    folder = item.path.parent.name
    return ("shared" not in item.keywords, LONG.index(folder) if folder in LONG else len(LONG))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put long files first in a run with several workers. Skip what needs the data beside the checkout where there is
    none.
    """
    if "PYTEST_XDIST_WORKER" in os.environ:
        items.sort(key=_long_first)
    if SHARED_DATA.is_dir():
        return
    skip = pytest.mark.skip(reason="needs the data beside the checkout (../shared/data)")
    for item in items:
        if "shared" in item.keywords:
            item.add_marker(skip)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the data beside the checkout."""
    if not SHARED_DATA.is_dir():
        pytest.skip("needs the data beside the checkout (../shared/data)")
    return SHARED_DATA


@pytest.fixture(scope="session")
def shared_golden() -> Path:
    """Folder of reference values beside the checkout."""
    if not SHARED_GOLDEN.is_dir():
        pytest.skip("needs the reference values beside the checkout")
    return SHARED_GOLDEN

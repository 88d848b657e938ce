# SPDX-License-Identifier: BSD-3-Clause
"""The page of corrections: its programs run, with several seeds, and every row of its tables has a check that passes
for the right form and not for the printed one."""

import re
from pathlib import Path

import pytest

PAGE = Path(__file__).resolve().parents[1] / "docs" / "maths" / "corrections.md"
TEXT = PAGE.read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
#: First cells of the rows of all tables, without heads and rules.
ROWS = [row for row in re.findall(r"^\| ([^|]+?) \|", TEXT, re.MULTILINE) if row != "eq."]


def run(seed: int) -> list[str]:
    """Run the programs of the page, one after the other in one namespace, and return what they checked."""
    namespace: dict = {}
    for number, block in enumerate(BLOCKS):
        block = block.replace("default_rng(0)", f"default_rng({seed})")
        exec(compile(block, f"{PAGE.name}, block {number}", "exec"), namespace)
    return namespace["checked"]


def test_every_row_is_checked_and_every_check_has_a_row():
    names = [name for row in ROWS for name in row.split(", ")]
    assert len(ROWS) >= 55
    assert set(run(0)) == set(names)


@pytest.mark.parametrize("seed", range(1, 13))
def test_corrections_hold(seed):
    run(seed)


@pytest.mark.parametrize(("right", "wrong"), [(1.0, 1.0), (2.0, 3.0)], ids=["both right", "both wrong"])
def test_a_check_can_fail(right, wrong):
    namespace: dict = {}
    exec(BLOCKS[0], namespace)
    namespace["check"]("a row", 1.0, 1.0, 2.0)
    with pytest.raises(AssertionError, match="a row"):
        namespace["check"]("a row", 1.0, right, wrong)

# SPDX-License-Identifier: BSD-3-Clause
"""Code blocks of the page of corrections run, in order and in one namespace."""

import re
from pathlib import Path

import pytest

PAGE = Path(__file__).resolve().parents[1] / "docs" / "maths" / "corrections.md"
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)


def test_there_are_checks():
    assert len(BLOCKS) >= 8
    assert sum(block.count("assert") for block in BLOCKS) >= 40


@pytest.mark.parametrize("number", range(1, len(BLOCKS)))
def test_corrections_hold(number):
    namespace: dict = {}
    exec(BLOCKS[0], namespace)
    for block in BLOCKS[1 : number + 1]:  # later blocks use names of earlier ones
        exec(compile(block, f"{PAGE.name}, block {number}", "exec"), namespace)

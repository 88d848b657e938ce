# SPDX-License-Identifier: BSD-3-Clause
"""The logger ``groma``: stages and warnings for programs that groma is a part of; silence where nobody listens."""

import logging
import subprocess
import sys

import pytest

import groma
from groma._log import logged_stages
from groma.scene import synthetic

pytestmark = pytest.mark.kernels


def test_stages_are_logged_once_and_passed_on(caplog):
    passed = []
    with caplog.at_level(logging.DEBUG, "groma"):
        say = logged_stages("mapping", lambda *event: passed.append(event))
        for event in (("first", 0, 1), ("second", 0, 3), ("second", 1, 3), ("second", 2, 3)):
            say(*event)
    assert passed == [("first", 0, 1), ("second", 0, 3), ("second", 1, 3), ("second", 2, 3)]
    told = [(record.name, record.levelname, record.getMessage()) for record in caplog.records]
    assert told == [
        ("groma.mapping", "INFO", "first"),
        ("groma.mapping", "INFO", "second"),
        ("groma.mapping", "DEBUG", "second: 1 of 3"),
        ("groma.mapping", "DEBUG", "second: 2 of 3"),
    ]


def test_an_adjustment_logs_its_steps_outcome_and_warnings(caplog):
    scene = synthetic.holistic(6, seed=3).start.points_only()
    with caplog.at_level(logging.DEBUG, "groma"):
        result = groma.adjust(scene, groma.AdjustOptions(max_iterations=1))
    told = {level: [r.getMessage() for r in caplog.records if r.levelno == level] for level in (10, 20, 30)}
    assert told[logging.DEBUG][0].startswith("step 1 of at most 1, cost ")
    assert len(told[logging.INFO]) == 1 and told[logging.INFO][0].startswith("6 images, ")
    assert result.report.warnings and told[logging.WARNING] == list(result.report.warnings)


def test_without_a_handler_nothing_is_printed():
    program = (
        "import logging, groma._log as log; log.log_warnings('mapping', ['odd']); print(logging.lastResort is None)"
    )
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert said.stdout == "False\n" and said.stderr == ""

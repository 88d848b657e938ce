# SPDX-License-Identifier: BSD-3-Clause
"""Ctrl-C in the middle of a solve: exit code 130, one line, nothing left half written."""

import os
import signal
import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(os.name == "nt", reason="signals of POSIX systems")

# The process sends itself the signal that Ctrl-C sends, when the solver reports its first step.
PROGRAM = """
import os, signal, sys
import groma.pipelines.adjust as module
adjust = module.adjust

def interrupted(scene, options=None, progress=None):
    def report(event):
        os.kill(os.getpid(), signal.SIGINT)
    return adjust(scene, options, report)

module.adjust = interrupted
sys.argv = ["groma", "adjust", sys.argv[1], "-o", "out.npz", "--json", "r.json"]
from groma.cli.main import main
main()
"""


def test_ctrl_c_in_mid_solve(tmp_path):
    from groma.io import write_scene
    from groma.scene import synthetic

    inputs = tmp_path / "in"
    inputs.mkdir()
    write_scene(synthetic.holistic(6, seed=0).start.points_only(), inputs / "start.npz")
    finished = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(inputs / "start.npz")],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    assert finished.returncode == 130
    assert finished.stderr == "groma: interrupted; nothing was written.\n"
    assert os.listdir(tmp_path) == ["in"]

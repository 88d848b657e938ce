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
import groma.adjustment.adjust as module
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
    assert finished.stderr == "groma: interrupted; nothing is left half written.\n"
    assert os.listdir(tmp_path) == ["in"]


def test_a_signal_that_a_library_swallows_is_not_forgotten():
    from groma.cli.shared.interrupt import interruptible

    calls = []
    before = signal.getsignal(signal.SIGTERM)
    for number in (signal.SIGINT, signal.SIGTERM):
        with pytest.raises(KeyboardInterrupt), interruptible() as interruption:
            progress = interruption.checking(lambda *event: calls.append(event))
            progress("a", 0, 1)
            with pytest.raises(KeyboardInterrupt):  # swallowed, as in a callback of a compiler
                os.kill(os.getpid(), number)
            progress("b", 0, 1)
        with pytest.raises(KeyboardInterrupt), interruptible():
            try:
                os.kill(os.getpid(), number)
            except KeyboardInterrupt:
                raise RuntimeError("no compiled object yet") from None
    with pytest.raises(RuntimeError, match="a real one"), interruptible():
        raise RuntimeError("a real one")
    assert calls == [("a", 0, 1), ("a", 0, 1)]
    assert signal.getsignal(signal.SIGTERM) is before


def test_ctrl_c_while_mapping_says_how_to_go_on(tmp_path, monkeypatch, capsys):
    from groma.cli.main import run
    from groma.mapping import map as mapping

    (tmp_path / "photos").mkdir()

    def interrupted(*arguments):
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(mapping, "map_images", interrupted)
    assert run(["map", str(tmp_path / "photos"), "-o", str(tmp_path / "out")]) == 130
    said = capsys.readouterr().err
    assert said.startswith("groma: interrupted; finished stages are kept in") and said.count("\n") == 1
    assert "the same command goes on from there" in said
    assert os.listdir(tmp_path) == ["photos"]


EARLY = """
import os, signal, sys
import groma.cli.main as main

class Loader:
    def find_spec(self, name, path=None, target=None):
        if name == "{package}":
            try:
                os.kill(os.getpid(), signal.{number})
            except KeyboardInterrupt:
                raise {error}("Cannot import the backend") from None

sys.meta_path.insert(0, Loader())
sys.argv = ["groma", "adjust", sys.argv[1], "-o", "out.npz"]
main.main()
"""


@pytest.mark.parametrize("number", ["SIGINT", "SIGTERM"])
@pytest.mark.parametrize(
    ("package", "error"),
    [("typer", "ImportError"), ("numpy", "ImportError"), ("numba", "RuntimeError"), ("pycolmap", "RuntimeError")],
)
def test_a_signal_while_a_package_is_imported_is_an_interrupt(tmp_path, number, package, error):
    from groma.io import write_scene
    from groma.scene import synthetic

    (tmp_path / "in").mkdir()
    write_scene(synthetic.holistic(6, seed=0).start.points_only(), tmp_path / "in" / "model")
    finished = subprocess.run(
        [sys.executable, "-c", EARLY.format(number=number, package=package, error=error), str(tmp_path / "in/model")],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    assert (finished.returncode, finished.stderr) == (130, "groma: interrupted; nothing is left half written.\n")
    assert os.listdir(tmp_path) == ["in"]


BEFORE = """
import os, signal, sys
from groma.cli.main import main

class Loader:
    def find_spec(self, name, path=None, target=None):
        if name == "groma.cli.shared.interrupt":
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Loader())
sys.argv = ["groma", "--version"]
main()
"""


def test_a_signal_before_signals_are_answered_is_an_interrupt():
    finished = subprocess.run(
        [sys.executable, "-c", BEFORE],
        capture_output=True,
        text=True,
        timeout=100,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    assert (finished.returncode, finished.stdout) == (130, "")
    assert finished.stderr == "groma: interrupted; nothing is left half written.\n"


def test_sigterm_after_pycolmap_is_loaded_is_an_interrupt():
    program = (
        "import os, signal, time\n"
        "from groma.io.colmap.load import load_pycolmap\n"
        "def end(number, frame): print('mine', flush=True); os._exit(3)\n"
        "signal.signal(signal.SIGTERM, end)\n"
        "load_pycolmap()\n"
        "os.kill(os.getpid(), signal.SIGTERM)\n"
        "time.sleep(5)\n"
    )
    finished = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=100)
    assert (finished.returncode, finished.stdout, finished.stderr) == (3, "mine\n", "")

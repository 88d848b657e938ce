# SPDX-License-Identifier: BSD-3-Clause
"""Classes of gates: complete, frozen, on the page of thresholds; the count of tuned numbers."""

import importlib.util
import sys
from dataclasses import FrozenInstanceError, dataclass, fields, replace
from pathlib import Path

import numpy as np
import pytest

from groma import gates
from groma.gates import chi_square_gate, gate, gate_classes, is_gate_class, numbers, table
from groma.tracking import TrackOptions
from groma.tracking.gates import LineGates, TrackingGates

ROOT = Path(__file__).resolve().parents[1]
CLASSES = gate_classes()


def test_all_rooms_have_gates():
    rooms = {kind.__module__.split(".")[1] for kind in CLASSES}
    assert {"estimators", "evaluation", "features", "mapping", "solver", "tracking"} <= rooms
    assert len(CLASSES) == len(set(CLASSES)) > 25
    assert TrackingGates not in CLASSES  # a group of gates has no numbers of its own


@pytest.mark.parametrize("kind", CLASSES, ids=lambda kind: kind.__name__)
def test_numbers_say_what_they_are(kind):
    assert kind.__doc__ and kind.__doc__[0] != kind.__name__
    assert table(kind)
    for name, value, unit, meaning, origin in table(kind):
        assert unit and meaning, name
        assert origin.startswith(gates.ORIGINS), f"{name}: {origin}"
        assert len(origin.split()) > 1 and not origin.endswith(":"), f"{name}: origin says nothing"
        assert all(isinstance(one, int | float) for one in np.atleast_1d(value).tolist())
        assert np.isfinite(value).all(), name
        if name not in ("unknown_overlap", "shares"):  # stands for "not known"; the last round adds nothing
            assert (np.asarray(value) > 0).all(), name


@pytest.mark.parametrize("kind", CLASSES, ids=lambda kind: kind.__name__)
def test_classes_are_frozen(kind):
    instance = kind()
    with pytest.raises(FrozenInstanceError):
        setattr(instance, fields(kind)[0].name, 1.0)


def test_incomplete_fields_are_found():
    @dataclass(frozen=True)
    class SomeGates:
        first: float = gate(1.0, "px", "a distance", "cost: nothing")
        second: float = 2.0

    assert is_gate_class(SomeGates)
    with pytest.raises(KeyError):
        table(SomeGates)
    assert numbers(SomeGates()) == (1.0, 2.0)


def test_chi_square_gate():
    assert chi_square_gate(0.05, 1) == pytest.approx(1.959964**2, rel=1e-6)
    assert chi_square_gate(0.001, 2) == pytest.approx(-2.0 * np.log(0.001))


def test_gates_are_options_of_the_tracker():
    changed = replace(TrackingGates(), lines=LineGates(min_length=20.0))
    assert TrackOptions(gates=changed).gates.lines.min_length == 20.0
    assert TrackOptions().gates == TrackingGates()


def _module(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module


def test_page_lists_every_number():
    pytest.importorskip("sphinx")
    page = _module(ROOT / "docs" / "_thresholds.py")
    assert "{thresholds}" in (ROOT / "docs" / "thresholds.md").read_text()
    built = page.Thresholds.run(None)
    text = "\n".join(node.astext() for node in built)
    rows = sum(len(list(node.findall(page.nodes.row))) for node in built)
    assert rows == sum(len(fields(kind)) + 1 for kind in CLASSES)
    for kind in CLASSES:
        assert kind.__name__ in text
        for name, _, _, meaning, origin in table(kind):
            assert name in text and meaning in text and origin in text


def test_count_of_tuned_numbers(tmp_path):
    counting = _module(ROOT / "benchmarks" / "tuned_numbers.py")
    (tmp_path / "room").mkdir()
    (tmp_path / "room" / "some.py").write_text(
        "LIMIT, OTHER = 3.5, 1e-9\n"
        "COLOURS = ['red']\n"
        "SOURCE = 'chosen on some scenes'\n"
        "class ThingGates:\n    near: float = gate(4.0, 'px', 'a distance', SOURCE)\n"
        "def some(x, share=0.3, count=0):\n    return x > 7 and x * 2.5 + 1.0 and x[3] == 5\n"
        "@kernel\ndef quick(x):\n    return 0.25 * x if x < 9.5 else 1.5 * x\n"
    )
    found = counting.count(tmp_path)["room"]
    assert found == {"named": 1, "gates chosen": 1, "defaults": 1, "integers": 1, "floats": 2}


def test_numbers_that_no_decision_hangs_on_stand_apart(tmp_path):
    """Each rule of the count by a number that it takes, beside one that it leaves."""
    counting = _module(ROOT / "benchmarks" / "tuned_numbers.py")

    def counted(name, text):
        path = tmp_path / "house" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        found = counting.count(tmp_path / "house")[name.split("/")[0].removesuffix(".py")]
        path.unlink()
        return dict(found)

    assert counted("a/b.py", "#: Rows at once\n#: (cost: memory).\nROWS = 512\n#: Near.\nNEAR = 7\n") == {
        "stated": 1, "named": 1}  # fmt: skip
    assert counted("a/b.py", "def f(a):\n    return 5.5 * a  # derived from a\n") == {"stated": 1}
    assert counted("a/b.py", "def f(a):\n    # Derived from\n    # a.\n    b = 5.5 * a\n    return 1.5 * b\n") == {
        "stated": 1, "floats": 1}  # fmt: skip
    assert counted("a/b.py", "_NONE = 65535  # of the format\n") == {"formats": 1}
    fields = (
        "class Options:\n    #: Steps (chosen on a scene).\n    steps: int = 50\n    #: Length.\n    size: int = 9\n"
    )
    assert counted("a/b.py", fields + "    rows: ClassVar[int] = 3\n") == {"stated": 1, "defaults": 1, "shapes": 1}
    assert counted("io/b.py", "def f(a):\n    return a > 12 or a > 12.5\n") == {"formats": 1, "floats": 1}
    assert counted("viz/b.py", "WIDTH = 560\n") == {"drawings": 1} == counted("io/drawn.py", "WIDTH = 560\n")
    assert counted("a/check.py", "STEP = 0.25\n") == {"made": 1} == counted("scene/synthetic/b.py", "STEP = 0.25\n")
    assert counted("a/b.py", "def some_example(r):\n    return 0.3 * r\ndef other(r):\n    return 0.3 * r\n") == {
        "made": 1, "floats": 1}  # fmt: skip
    sizes = "def f(a):\n    return len(a) < 5, a.shape[0] < 3, a.sum() < 4, len(a) < 8, a[3] < 5\n"
    assert counted("a/b.py", sizes) == {"shapes": 3, "integers": 2}
    formulas = (
        "def f(a):\n    return 100.0 * a, a / 3.0, 10.0 ** a, a < 180.0, np.log(10.0), sys.version_info > (3, 9)\n"
    )
    assert counted("a/b.py", formulas) == {"formulas": 4}
    states = "A, B, C, D = 0, 1, 2, 3\nE, F, G = 1, 2, 3\n"
    assert counted("a/b.py", states) == {"shapes": 1, "named": 1}
    exponents = "def f(a):\n    return np.exp(np.clip(a, -30.0, 30.0)), np.exp(9.0 * a), np.clip(a, -30.0, 30.0)\n"
    assert counted("a/b.py", exponents) == {"formulas": 2, "floats": 3}
    others = "def f(a):\n    return a > 100.0, 3.0 * a, a / 5.0, a ** 10.0, np.log(a + 10.0)\n"
    assert counted("a/b.py", others) == {"floats": 5}

# SPDX-License-Identifier: BSD-3-Clause
"""Where the tuned numbers of groma are: fields of frozen dataclasses, each with its unit, meaning and origin.

A class of gates stands in the file whose decisions it makes, or in ``gates.py`` of its room, and its name ends in
``Gates``; levels of tests that rooms share are :class:`NormalGates`. Functions take an instance as an argument with a
default, so that a number can be changed without editing code, and the page of thresholds in the documentation is made
from the classes::

    @dataclass(frozen=True)
    class FollowingGates:
        '''Which measurements of a frame agree with its pose.'''

        max_residual: float = gate(
            3.5, "sigma", "largest residual of a coordinate", "derived from normal noise: exceeded once in 2 000"
        )

Where there is a noise model a gate is a quantile at a stated probability (:func:`chi_square_gate`), not a number of
pixels. Options that a user is meant to change stay in the ``...Options`` classes; numerical guards stay in kernels.
Constants on which no decision about data hangs, such as sizes of pieces of work, and defaults of options say where they
come from in their comment: ``#: Rows compared at a time (cost: memory).``
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field, fields, is_dataclass
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import Any

#: Standard deviation of normal noise over the median of its absolute values (derived from its distribution).
SIGMA_OF_MEDIAN = 1.4826
#: How the origin of a number may begin.
ORIGINS = ("derived from", "chosen on", "convention:", "cost:")
#: Origins that many numbers share: the data that they were chosen on.
LINE_MAPS, STRUCTURE = "chosen on benchmarks/lines.py", "chosen on benchmarks/structure.py"
SURVEYED = "chosen on benchmarks/surveyed.py"
STRECHA, KINECT = "chosen on Strecha's scenes", "chosen on Kinect images"
SEQUENCES = "chosen on cabinet, redkitchen and KITTI 06"
#: And a bound on cost that many have.
SEARCH = "cost: time of a search"


def gate(default: Any, unit: str, meaning: str, origin: str) -> Any:
    """Declare a tuned number as a field of a frozen dataclass.

    Parameters
    ----------
    default
        The number, or a tuple of numbers.
    unit
        For example ``px``, ``rad``, ``sigma``, ``images``, ``share``, ``scene units``, or ``1`` for a ratio.
    meaning
        What it decides, as a phrase.
    origin
        Begins with one of :data:`ORIGINS`: *derived from* a model, *chosen on* named scenes, a *convention:* of the
        field, or a bound on *cost:* that no result depends on.
    """
    return field(default=default, metadata={"unit": unit, "meaning": meaning, "origin": origin})


@dataclass(frozen=True)
class NormalGates:
    """Where what normal noise explains ends, and most begins: levels that tests of all rooms share."""

    alike: float = gate(2.0, "sigma", "of a difference that noise often makes", "derived from normal noise: 1 in 22")
    far: float = gate(3.0, "sigma", "of a difference that noise seldom makes", "derived from normal noise: 1 in 370")
    coordinate: float = gate(3.5, "sigma", "of a coordinate that disagrees", "derived from normal noise: 1 in 2 000")
    mistake: float = gate(4.0, "sigma", "of a difference that is a mistake", "derived from normal noise: 1 in 16 000")
    sure: float = gate(5.0, "sigma", "of a difference that is stated as a fact", "convention: five sigma")
    outlier: float = gate(3e-3, "probability", "of a residual that noise exceeds", "convention: three sigma")
    gross: float = gate(1e-3, "probability", "of calling a good measurement wrong", "convention: Baarda")
    false_alarm: float = gate(0.01, "probability", "of an error found where there is none", "convention: 1 in 100")
    significance: float = gate(0.05, "probability", "of an effect found where there is none", "convention: 1 in 20")
    never: float = gate(1e-4, "probability", "of what is taken to be impossible", "convention: 1 in 10 000")
    majority: float = gate(0.5, "share", "above which it is most of them", "convention: more than half")
    sample: int = gate(100, "values", "whose scatter tells their noise", "derived from normal noise: good to 7 %")


NORMAL = NormalGates()


def is_gate_class(value: object) -> bool:
    """Whether a value is a class of gates."""
    return isinstance(value, type) and is_dataclass(value) and value.__name__.endswith("Gates")


def gate_classes() -> list[type]:
    """Return all classes of gates of the package, by module and name; imports the modules that declare some."""
    found: list[type] = []
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        if not re.search(r"^class \w+Gates\b", path.read_text(encoding="utf-8"), re.MULTILINE):
            continue
        parts = path.relative_to(Path(__file__).parents[1]).with_suffix("").parts
        module = import_module(".".join(parts).removesuffix(".__init__"))
        declared = [
            kind for kind in vars(module).values() if is_gate_class(kind) and kind.__module__ == module.__name__
        ]
        found += [kind for kind in declared if any("unit" in item.metadata for item in fields(kind))]
    return found


def table(gates: type) -> list[tuple[str, Any, str, str, str]]:
    """Return name, number, unit, meaning and origin of every gate of a class."""
    return [
        (item.name, item.default, item.metadata["unit"], item.metadata["meaning"], item.metadata["origin"])
        for item in fields(gates)
    ]


def numbers(gates: Any) -> tuple[float, ...]:
    """Return the numbers of gates in the order of their fields, as kernels take them."""
    return tuple(float(getattr(gates, item.name)) for item in fields(gates))


@lru_cache(maxsize=64)
def chi_square_gate(probability: float, dof: int) -> float:
    r"""Return the squared normalised residual that noise exceeds with the given probability.

    .. math:: P(\chi^2_{\text{dof}} > \text{gate}) = \text{probability}
    """
    if dof == 2:
        return -2.0 * math.log(probability)
    from scipy.special import chdtri  # takes longer to import than most of what needs it takes to run

    return float(chdtri(dof, probability))

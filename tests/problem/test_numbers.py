"""Numbers that no solve can use are refused where a problem is made, whatever the type of the factor."""

import dataclasses

import numpy as np
import pytest

from groma.errors import InputError
from groma.factors.contract import registered
from groma.problem.problem import Problem
from groma.problem.variables import Variables

pytestmark = pytest.mark.kernels


@pytest.mark.parametrize("name", sorted(registered()))
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_every_measurement_of_every_factor_must_be_finite(name, value):
    """Which factor, which row and which field is said, in one line."""
    example = registered()[name].example(np.random.default_rng(0))
    variables = {group: Variables(manifold, state) for group, (manifold, state) in example.variables.items()}
    Problem(variables, [example.factor])
    fields = [f.name for f in dataclasses.fields(example.factor)]
    spoiled = {
        f: np.array(getattr(example.factor, f)) for f in fields if isinstance(getattr(example.factor, f), np.ndarray)
    }
    spoiled["sqrt_information"] = np.ones(len(example.factor))
    for field, rows in spoiled.items():
        if rows.dtype.kind == "f" and rows.size:
            rows.reshape(len(rows), -1)[1, -1] = value
            with pytest.raises(InputError, match=field) as caught:
                Problem(variables, [dataclasses.replace(example.factor, **{field: rows})])
            said = str(caught.value)
            assert "\n" not in said
            assert "must be positive" in said or (
                ("row 1 is" in said or "Factor 1 of" in said)
                and (name in said or type(example.factor).__name__ in said)
            )

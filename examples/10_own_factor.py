# SPDX-License-Identifier: BSD-3-Clause
"""A factor of your own: positions from measured distances to known anchors (trilateration)."""

import numpy as np

import groma
from groma.factors.losses import Cauchy
from groma.geometry import Euclidean


# The residual: predicted minus measured distance. Derivatives are taken by groma, and everything is compiled.
@groma.factor("range", slots=[("anchor", "point"), ("tag", "point")], residual_size=1, data_size=1)
def Range(data, anchor, tag, out):  # noqa: N802 (becomes a class)
    """Distance between two points."""
    x, y, z = tag[0] - anchor[0], tag[1] - anchor[1], tag[2] - anchor[2]
    out[0] = (x * x + y * y + z * z) ** 0.5 - data[0]


# Six anchors, fifty tags; every distance is measured to 2 cm, and one in twenty is wrong.
rng = np.random.default_rng(0)
anchors = np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0], [10, 10, 1], [0, 0, 4], [10, 10, 4]], float)
truth = rng.uniform(1, 9, (50, 3)) * [1, 1, 0.4]
anchor_idx, tag_idx = np.divmod(np.arange(6 * 50), 50)
measured = np.linalg.norm(truth[tag_idx] - anchors[anchor_idx], axis=1) + 0.02 * rng.normal(size=300)
measured[rng.random(300) < 0.05] += 1.5

problem = groma.Problem(
    variables={
        "anchors": groma.Variables(Euclidean(3, "point"), anchors, constant=True),
        "tags": groma.Variables(Euclidean(3, "point"), np.tile([5.0, 5.0, 2.0], (50, 1))),
    },
    factors=[
        Range(
            anchor=groma.Ref("anchors", anchor_idx),
            tag=groma.Ref("tags", tag_idx),
            data=measured[:, None],
            sqrt_information=1 / 0.02,
            loss=Cauchy(3.0),
        )
    ],
)
solution = groma.solve(problem)
error = np.linalg.norm(solution["tags"] - truth, axis=1)
print(solution.report.termination.sentence)
print(f"median error of a position: {100 * np.median(error):.1f} cm")

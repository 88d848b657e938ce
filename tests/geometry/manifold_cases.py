# SPDX-License-Identifier: BSD-3-Clause
"""All charts of the library, as parameters for the tests."""

import pytest

from groma.geometry._manifold import Euclidean, Manifold
from groma.geometry.line_charts import LINE_CHARTS
from groma.geometry.plane_charts import PLANE_CHARTS
from groma.geometry.point3 import POINT_CHARTS
from groma.geometry.pose_charts import POSE_CHARTS
from groma.geometry.unit3 import DIRECTION_CHARTS

TABLES = {
    "pose": POSE_CHARTS,
    "line": LINE_CHARTS,
    "plane": PLANE_CHARTS,
    "direction": DIRECTION_CHARTS,
    "point": POINT_CHARTS,
    "intrinsics": {"euclidean": Euclidean(4, "intrinsics")},
    "vector": {"euclidean": Euclidean(9)},
}

#: Every chart, with an identifier such as ``line-cartesian``.
MANIFOLDS: list[Manifold] = [manifold for table in TABLES.values() for manifold in table.values()]
CASES = [
    pytest.param(manifold, id=f"{kind}-{name}") for kind, table in TABLES.items() for name, manifold in table.items()
]

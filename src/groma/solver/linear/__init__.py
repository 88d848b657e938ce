# SPDX-License-Identifier: BSD-3-Clause
"""The linear algebra of one step.

In come normal equations by blocks. Landmarks are eliminated (``schur.py``), what is left is the reduced system, and it
is solved densely, sparsely or by conjugate gradients (``choice.py``; ``contract.py`` says how to add a solver). Out
comes the step of the cameras, and by back-substitution that of the landmarks. Covariances use the same blocks without
damping (``elimination.py``, ``fronts.py``).
"""

# SPDX-License-Identifier: BSD-3-Clause
"""Uncertainty of a solved problem.

In comes a problem at its solution; it is linearised once, landmarks are eliminated by square-root factors where they
are badly conditioned, and the marginal covariances are read off a selected inverse (``marginals.py``), in the datum
that is asked for (``datum.py``, ``s_transform.py``). What the data do not determine is found and left out
(``rank_deficient.py``). Out come covariances of poses, landmarks and quantities derived from them (``quantities.py``).
"""

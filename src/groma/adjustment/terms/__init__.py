# SPDX-License-Identifier: BSD-3-Clause
"""From tables of a scene to factors: one file per kind of measurement.

Each file ends in its :class:`~groma.adjustment.terms.contract.Term`; :data:`groma.adjustment.assemble.TERMS` lists
them. To add one, see :mod:`groma.adjustment.terms.contract`.
"""

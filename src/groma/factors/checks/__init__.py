# SPDX-License-Identifier: BSD-3-Clause
"""Proof that a factor is right: its derivatives against central differences, and reference values.

In comes a factor with its example; its Jacobian is compared with central differences through the charts' own
``retract``, its residual with zero on perfect data and with itself after the world moved. Out come tables of
deviations, for tests, for ``groma selfcheck`` and for factors from outside.
"""

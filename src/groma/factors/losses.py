# SPDX-License-Identifier: BSD-3-Clause
"""Robust losses: placeholder until its author lands it (contract in the class below)."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Loss:
    """A robust loss rho(s) on the squared whitened norm s."""


@dataclass(frozen=True)
class Trivial(Loss):
    """Plain least squares, rho(s) = s."""

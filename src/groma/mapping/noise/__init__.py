# SPDX-License-Identifier: BSD-3-Clause
"""Weights from residuals: the noise of observations, of landmarks, and errors that neighbours in an image share."""

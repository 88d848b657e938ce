# SPDX-License-Identifier: BSD-3-Clause
"""Pictures of scenes and solves. Imported only when asked for."""

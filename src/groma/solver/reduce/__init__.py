# SPDX-License-Identifier: BSD-3-Clause
"""Solves whose landmarks come in shards: what each shard adds to the shared system, and the loop over them."""

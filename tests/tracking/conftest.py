# SPDX-License-Identifier: BSD-3-Clause
"""Helpers of these tests are found here."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

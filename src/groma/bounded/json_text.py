# SPDX-License-Identifier: BSD-3-Clause
"""Numbers of a run as JSON: what ``summary.json`` in a result folder and ``--json`` hold."""

import json


def json_text(content: dict[str, object]) -> str:
    """Return ``content`` as JSON; numbers that are not finite become null, which every JSON reader accepts."""
    return json.dumps(plain(content), indent=2, allow_nan=False) + "\n"


def plain(value: object) -> object:
    """Convert NumPy numbers and arrays, enumerations and paths to JSON types; non-finite numbers to None."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (str, bool, int)) or value is None:
        return value
    if hasattr(value, "tolist"):
        return plain(value.tolist())  # type: ignore[attr-defined]
    if isinstance(value, float):
        return value if value - value == 0 else None
    return str(value)

# SPDX-License-Identifier: BSD-3-Clause
"""Put the tables of the latest results into ``docs/evidence/speed.md``.

    python benchmarks/tables.py

Each benchmark leaves a Markdown table in ``benchmarks/results/NAME.md``; it replaces what stands in the page between
``<!-- NAME -->`` and ``<!-- end -->``. A table that is not there leaves the page as it is.
"""

from __future__ import annotations

import re
import sys

from _workshop import RESULTS, ROOT

PAGE = ROOT / "docs" / "evidence" / "speed.md"


def main() -> int:
    text = PAGE.read_text()
    for name in re.findall(r"<!-- (?!end)(\w+) -->", text):
        path = RESULTS / f"{name}.md"
        if not path.is_file():
            print(f"{name}: no table; the page keeps the one it has.")
            continue
        pattern = re.compile(rf"(<!-- {name} -->\n).*?(<!-- end -->)", re.DOTALL)
        text, count = pattern.subn(lambda found, path=path: f"{found[1]}{path.read_text().strip()}\n{found[2]}", text)
        print(f"{name}: {'filled in' if count else 'its end mark is missing'}.")
    PAGE.write_text(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())

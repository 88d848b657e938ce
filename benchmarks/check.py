# SPDX-License-Identifier: BSD-3-Clause
"""Compare the latest results with ``baseline.json``; exit 1 if something became worse.

    python benchmarks/check.py [--update] [--require-all]

A metric fails when it is worse than its baseline by more than the tolerance (a fraction of the baseline, where it has
one), or beyond its limit, which is a promise and not a habit. Times are compared as ratios to the best peer in the same
run, and only where there was no peer as multiples of a calibration loop, so the baseline holds on other machines.
``--update`` writes the present values as the new baseline and keeps units, directions, tolerances and limits.
"""

from __future__ import annotations

import argparse
import json
import sys

from _workshop import HERE, RESULTS

BASELINE = HERE / "baseline.json"


def measured() -> dict[str, float]:
    """Return {problem.metric: value} of all results at hand."""
    found = {}
    for path in sorted(RESULTS.glob("*.json")):
        result = json.loads(path.read_text())
        if isinstance(result, dict) and "metrics" in result:
            found.update({f"{result['problem']}.{name}": value for name, value in result["metrics"].items()})
    return found


def verdict(entry: dict, value: float) -> str:
    """Return what is wrong with a value, or nothing."""
    sign = 1 if entry["direction"] == "lower" else -1
    if "tolerance" in entry:
        allowed = entry["value"] + sign * entry["tolerance"] * abs(entry["value"])
        if sign * (value - allowed) > 0:
            return f"worse than {allowed:.6g}"
    if "limit" in entry and sign * (value - entry["limit"]) > 0:
        return f"beyond its limit {entry['limit']:.6g}"
    return ""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--update", action="store_true", help="make the present values the baseline")
    parser.add_argument(
        "--require-all", action="store_true", help="fail when a metric of the baseline was not measured"
    )
    arguments = parser.parse_args()
    baseline, values = json.loads(BASELINE.read_text()), measured()
    if not values:
        print(f"There are no results in {RESULTS}. Run benchmarks/run.py or another benchmark first.")
        return 2
    if arguments.update:
        for name, entry in baseline["metrics"].items():
            entry["value"] = float(f"{values.get(name, entry['value']):.6g}")
        BASELINE.write_text(json.dumps(baseline, indent=2) + "\n")
        print(f"Wrote {BASELINE}.")
        return 0
    failed = missing = 0
    for name, entry in baseline["metrics"].items():
        if name not in values:
            missing += 1
            continue
        if entry.get("unless_measured") in values:
            continue
        wrong = verdict(entry, values[name])
        failed += bool(wrong)
        mark = f"FAILED, {wrong}" if wrong else "ok"
        print(f"{name:42s} {values[name]:12.6g}  baseline {entry['value']:12.6g}  {mark}  [{entry['unit']}]")
    print(f"{failed} failed; {missing} of {len(baseline['metrics'])} were not measured.")
    return int(failed > 0 or (arguments.require_all and missing > 0))


if __name__ == "__main__":
    sys.exit(main())

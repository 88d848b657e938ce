# SPDX-License-Identifier: BSD-3-Clause
"""Compiled functions are loaded beside the work that comes before them; nothing is compiled for it."""

import json
import os
import subprocess
import sys

from groma.compilation import needed

COMPILE = """
import sys
from pathlib import Path
from groma.compilation import needed
needed.PLACE = Path(sys.argv[1])
module, name, kinds = needed.needed("few")[0]
needed.function(module, name).compile(kinds)
"""
LOAD = """
import sys, threading, time
from pathlib import Path
from groma._kernels.cache import counts
from groma.compilation import needed
from groma.compilation.loading import loading
needed.PLACE = Path(sys.argv[1])
with loading("few", int(sys.argv[2])):
    while any(thread.name == "groma-load" for thread in threading.enumerate()):
        time.sleep(0.01)
there = [kinds in needed.function(module, name).overloads for module, name, kinds in needed.needed("few")]
print(counts.compiled, counts.loaded, *there)
"""


def test_what_lies_on_disk_is_loaded_and_nothing_else(tmp_path):
    """Of two functions one was compiled before: with two threads it is loaded, with one it waits to be called."""
    first, second = [entry for entry in needed.needed("adjust") if entry[0] == "groma.problem.sorting"][:2]
    types = list(map(repr, (*first[2], *second[2])))
    listed = {"modules": ["groma.problem.sorting"], "types": types, "work": {"few": []}}
    for _, name, kinds in (first, second):
        listed["work"]["few"].append([0, name, [types.index(repr(kind)) for kind in kinds]])
    (tmp_path / "needed.json").write_text(json.dumps(listed))
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}

    def run(code, *more):
        call = [sys.executable, "-c", code, str(tmp_path / "needed.json"), *more]
        return subprocess.run(call, capture_output=True, text=True, check=True, env=environment).stdout.split()

    run(COMPILE)
    assert run(LOAD, "2") == ["0", "1", "True", "False"]
    assert run(LOAD, "1") == ["0", "0", "False", "False"]

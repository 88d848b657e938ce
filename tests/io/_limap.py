# SPDX-License-Identifier: BSD-3-Clause
"""LIMAP 2 as another program: what it reads in a model, in words.

It is the Python that runs the tests where LIMAP can be imported, or the one named by GROMA_LIMAP_PYTHON.
"""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

#: Empty where there is none.
LIMAP_PYTHON = os.environ.get("GROMA_LIMAP_PYTHON") or (sys.executable if importlib.util.find_spec("limap") else "")

BRIDGE = """
import json, sys
import pycolmap
from limap.scene import HolisticReconstruction
pycolmap.logging.minloglevel = 3
source, target = sys.argv[1:]
model = HolisticReconstruction()
assert HolisticReconstruction.exists_model(source)
model.read(source)
s = model.structure_recon
(model.write_binary if target.endswith("binary") else model.write_text)(target)
print(json.dumps(dict(
    valid=model.check_validity(),
    images=sorted(s.structures2d),
    lines={i: [*l.start, *l.end] for i, l in s.lines3D.items()},
    tracks={i: [(e.image_id, e.point2D_idx) for e in l.track.elements] for i, l in s.lines3D.items()},
    segments={i: [[*l.start, *l.end] for l in v.lines] for i, v in s.structures2d.items()},
    owners={i: [l.line3D_id for l in v.lines] for i, v in s.structures2d.items()},
    groups={i: [g.type.name, list(g.params), [p.idx for p in g.points], [l.idx for l in g.lines],
                [(e.image_id, e.point2D_idx) for e in g.track.elements]] for i, g in s.groups3D.items()},
    flat={i: [[g.type.name, [p.idx for p in g.points], [l.idx for l in g.lines], g.group3D_id] for g in v.groups]
          for i, v in s.structures2d.items()},
    edges=sorted((e.point_idx, e.line_idx, e.w) for e in s.wireframe.get_all_edges()),
)))
"""


def through_limap(source: Path, target: Path) -> dict:
    """Let LIMAP read a model and write it again; return what it read."""
    target.mkdir()
    done = subprocess.run(
        [LIMAP_PYTHON, "-c", BRIDGE, str(source), str(target)], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])

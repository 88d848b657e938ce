# SPDX-License-Identifier: BSD-3-Clause
"""Build a wheel that brings compiled functions along, so that the first command is as fast as the second.

    python packaging/platform_wheel.py [--baseline x86-64-v3] [--platform manylinux_2_17_x86_64] [-o dist]

Run it with the Python, NumPy, Numba and llvmlite that the wheel is for: compiled functions hold for their versions and
for processors that have all instructions of the baseline. Elsewhere they are ignored, and groma compiles as ever.

The wheel of the sources is built and unpacked; all functions of ``src/groma/compilation/needed.json`` are compiled with
it for the baseline; what came out is put into the package, and the wheel packed again under a name for this Python and
platform.
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import json
import os
import subprocess
import sys
import sysconfig
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
#: Instructions of each baseline, as LLVM names them.
_V2 = "+cx16,+sahf,+popcnt,+sse3,+ssse3,+sse4.1,+sse4.2"
BASELINES = {"x86-64-v2": _V2, "x86-64-v3": f"{_V2},+avx,+avx2,+bmi,+bmi2,+f16c,+fma,+lzcnt,+movbe,+xsave"}

#: Compiles everything, and prints the processor and where each function that Python calls was put.
COMPILE = """
import json
from numba.core.registry import cpu_target
from groma._kernels import cache as kernel_cache
from groma.compilation import needed
from groma.compilation.ahead import compile_ahead
wanted = {(module, name) for work in needed.works() for module, name, _ in needed.needed(work)}
for work in needed.works():
    compile_ahead(work)
used = zip(kernel_cache.used_paths(), kernel_cache.used_functions())
files = [(str(path), module) for path, (module, name, _) in used if (module, name) in wanted]
print(json.dumps([cpu_target.target_context.codegen().magic_tuple(), files]))
"""


def compile_into(package: Path, baseline: str) -> int:
    """Compile with the package in a folder, for a baseline, and put what came out into it; return how many files."""
    with tempfile.TemporaryDirectory() as cache:
        environment = {
            **os.environ, "PYTHONPATH": os.fspath(package.parent), "NUMBA_CACHE_DIR": cache, "NUMBA_CPU_NAME": baseline,
            "NUMBA_CPU_FEATURES": BASELINES[baseline],
        }  # fmt: skip
        call = [sys.executable, "-W", "ignore", "-c", COMPILE]
        said = subprocess.run(call, check=True, stdout=subprocess.PIPE, text=True, env=environment, cwd=cache).stdout
        processor, files = json.loads(said.splitlines()[-1])
        place = package / "_compiled_ahead"
        for path, module in files:
            (place / module).mkdir(parents=True, exist_ok=True)
            (place / module / Path(path).name).write_bytes(Path(path).read_bytes())
        (place / "processor.json").write_text(json.dumps({"processor": processor}) + "\n")
    return len(files)


def pack(folder: Path, target: Path, tag: str) -> Path:
    """Pack an unpacked wheel under another tag."""
    (information,) = folder.glob("*.dist-info")
    lines = (information / "WHEEL").read_text().splitlines()
    lines = [f"Tag: {tag}" if line.startswith("Tag:") else line for line in lines]
    (information / "WHEEL").write_text("\n".join(lines).replace("Purelib: true", "Purelib: false") + "\n")
    record = information / "RECORD"
    record.unlink()
    rows, files = [], sorted(path for path in folder.rglob("*") if path.is_file())
    for path in files:
        digest = base64.urlsafe_b64encode(hashlib.sha256(path.read_bytes()).digest()).rstrip(b"=").decode()
        rows.append(f"{path.relative_to(folder).as_posix()},sha256={digest},{path.stat().st_size}")
    record.write_text("\n".join([*rows, f"{record.relative_to(folder).as_posix()},,"]) + "\n")
    target.mkdir(parents=True, exist_ok=True)
    place = target / f"{information.name.removesuffix('.dist-info')}-{tag}.whl"
    with zipfile.ZipFile(place, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as wheel:
        for path in [*files, record]:
            wheel.write(path, path.relative_to(folder).as_posix())
    return place


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--baseline", choices=tuple(BASELINES), default="x86-64-v3")
    parser.add_argument("--output", "-o", type=Path, default=ROOT / "dist", metavar="DIR")
    platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
    parser.add_argument("--platform", default=platform, help="as in the name of the wheel; no system library is linked")
    arguments = parser.parse_args()
    python = f"cp{sys.version_info[0]}{sys.version_info[1]}"
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", place, os.fspath(ROOT)]
        subprocess.run(build, check=True)
        (pure,) = folder.glob("*.whl")
        with zipfile.ZipFile(pure) as wheel:
            wheel.extractall(folder / "unpacked")
        count = compile_into(folder / "unpacked" / "groma", arguments.baseline)
        made = pack(folder / "unpacked", arguments.output, f"{python}-{python}-{arguments.platform}")
        sizes = [path.stat().st_size / 1e6 for path in (pure, made)]
    print(
        f"{made}: {count} compiled functions for {arguments.baseline}, {sizes[1]:.1f} MB instead of {sizes[0]:.1f} MB"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())

# SPDX-License-Identifier: BSD-3-Clause
"""Set up the programs that groma is compared with, each in an environment of its own.

    python benchmarks/peers.py                        # all of them
    python benchmarks/peers.py gtsam scipy            # these
    python benchmarks/peers.py --list                 # what is there
    python benchmarks/peers.py jaxls --source jaxls=PATH_OR_URL

Environments lie in ``.cache/benchmarks/envs/NAME``; one that works is left as it is (``--fresh`` makes it anew). Ceres
is built from ``contestants/*.cpp`` where CMake and the library are there. A peer that cannot be set up is skipped with
the reason, and so are its runs.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from _workshop import CACHE, build_ceres

ENVIRONMENTS = CACHE / "envs"


@dataclass(frozen=True)
class Peer:
    """A peer that pip installs: what to install, and what must be importable afterwards."""

    name: str
    packages: tuple[str, ...]
    check: str
    #: Where pip gets the last package from, if not from the index.
    source: str | None = None

    @property
    def python(self) -> Path:
        """The interpreter of its environment."""
        folder = ENVIRONMENTS / self.name
        return folder / "Scripts" / "python.exe" if sys.platform == "win32" else folder / "bin" / "python"

    def works(self) -> bool:
        """Whether its environment is there and can import what it is for."""
        return self.python.is_file() and self.missing() is None

    def missing(self) -> str | None:
        """Return why it cannot be imported, or None."""
        done = subprocess.run([self.python, "-c", self.check], capture_output=True, text=True)
        return None if done.returncode == 0 else (done.stderr.strip().splitlines() or ["it cannot be imported"])[-1]


PEERS = (
    Peer("pycolmap", ("numpy", "pycolmap"), "import pycolmap._core.pyceres"),
    Peer("limap", ("numpy", "pylimap"), "import limap.estimators.bundle_adjustment"),
    Peer("gtsam", ("numpy", "gtsam>=4.3"), "import gtsam; gtsam.SfmLevenbergMarquardtOptimizer"),
    # The package of this name on the index is another one.
    Peer("jaxls", ("numpy", "jax"), "import jaxls; jaxls.Cost", "git+https://github.com/brentyi/jaxls.git"),
    Peer("scipy", ("numpy", "scipy"), "import scipy.optimize"),
    Peer("spatialmath", ("numpy", "spatialmath-python"), "from spatialmath import Line3"),
)


def set_up(peer: Peer, fresh: bool = False, source: str | None = None) -> str:
    """Make the environment of a peer; return a sentence about what happened."""
    if not fresh and peer.works():
        return "is there"
    folder = ENVIRONMENTS / peer.name
    shutil.rmtree(folder, ignore_errors=True)
    packages = [*peer.packages, *filter(None, [source or peer.source])]
    commands = (
        [sys.executable, "-m", "venv", str(folder)],
        [str(peer.python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *packages],
    )
    for command in commands:
        done = subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL)
        if done.returncode:
            errors = [line for line in done.stderr.splitlines() if line.startswith(("ERROR", "error", "fatal"))]
            shutil.rmtree(folder, ignore_errors=True)
            return f"skipped: {(errors or done.stderr.strip().splitlines() or ['pip failed'])[-1]}"
    wrong = peer.missing()
    return "set up" if wrong is None else f"skipped: {wrong}"


def python_of(name: str) -> Path | None:
    """Return the interpreter that has a peer, or None."""
    peer = next(peer for peer in PEERS if peer.name == name)
    return peer.python if peer.works() else None


def main() -> int:
    names = [peer.name for peer in PEERS] + ["ceres"]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("peers", nargs="*", metavar="PEER", help=", ".join(names))
    parser.add_argument("--list", action="store_true", help="say what is there, install nothing")
    parser.add_argument("--fresh", action="store_true", help="make the environments anew")
    parser.add_argument(
        "--source", action="append", default=[], metavar="PEER=SOURCE", help="what pip installs instead"
    )
    arguments = parser.parse_args()
    wanted = arguments.peers or names
    sources = dict(item.split("=", 1) for item in arguments.source)
    if unknown := {*wanted, *sources} - {*names}:
        parser.error(f"no such peer: {', '.join(sorted(unknown))}; there are {', '.join(names)}")
    ENVIRONMENTS.mkdir(parents=True, exist_ok=True)
    for peer in PEERS:
        if peer.name not in wanted:
            continue
        if arguments.list:
            print(f"{peer.name:12s} {'is there' if peer.works() else 'is not set up'}", flush=True)
            continue
        print(f"{peer.name:12s} ", end="", flush=True)
        print(set_up(peer, arguments.fresh, sources.get(peer.name)), flush=True)
    if "ceres" in wanted and not arguments.list and build_ceres() is not None:
        print(f"{'ceres':12s} built")
    return 0


if __name__ == "__main__":
    sys.exit(main())

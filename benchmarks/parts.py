# SPDX-License-Identifier: BSD-3-Clause
"""A scene larger than memory: time and memory of an adjustment in parts, by observations and by ranks.

    python benchmarks/parts.py [--millions 1 4 16 50] [--steps 5] [--threads 2] [--work FOLDER] [--keep auto]
    python benchmarks/parts.py --ranks 1 2 --rounds 5 --threads 1 [--millions 4] [--corridor]
    python benchmarks/parts.py --plain-sums --rounds 5 --threads 1 [--millions 4] [--corridor]
    python benchmarks/parts.py --states 50 --ranks 1 2 4

The scene is an aerial block: photographs straight down on a grid, each point of the ground in about ten of them, 9 000
points in a photograph, 0.5 px of noise. It is written part by part, so that it never is in memory. Every size is solved
by :func:`groma.adjustment.parts.adjust_parts` in a process of its own; 50 million observations take 2 GB of disk.
Reported are CPU time per step, peak memory of the process, bytes per observation, and the exponent of growth.

With ``--ranks`` the same parts are adjusted by so many processes together (``mpiexec`` must be at hand), in turn, for
so many rounds. Reported are ratios to the first number, medians over the rounds: wall time per step, CPU time per step
of the busiest rank (it waits actively), peak memory of a rank; the bytes that a rank puts into the sums of a step; and
the time foreseen for many ranks. That assumes: work on parts divides evenly, the shared system is solved by each, and
a sum takes two passes of its bytes at ``BANDWIDTH`` and two latencies per doubling of ranks. ``--corridor`` takes a
walk round a corridor in place of the block: points, lines, planes, and what lies on them.

With ``--plain-sums`` one process adjusts in turn with sums of twice the digits, as always, and with plain ones.

With ``--states`` a corridor of so many images with known poses is solved at once and in parts by so many ranks, without
damping, until the gradient gets no smaller; reported are the largest differences of states, metres and radians. The
cost is known to its rounding, eps, and grows by half a square of the distance to the minimum in standard deviations. So
no cost tells apart what lies within sqrt(2 eps cost) standard deviations of it, which is what lines are compared with.
"""

import argparse
import json
import resource
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
from pathlib import Path

import numpy as np

#: Photographs: size and focal length in pixels, height over the ground and spacing along and across, metres.
WIDTH, HEIGHT, FOCAL, ALTITUDE = 1200, 900, 1000.0, 100.0
SPACING = np.array([36.0, 28.0])
NOISE_PX = 0.5
#: Points of the ground per square metre.
DENSITY = 9000 / (WIDTH * HEIGHT * (ALTITUDE / FOCAL) ** 2)
PER_IMAGE = 9000
PART = 1_000_000
#: Network between ranks: bytes per second and seconds per message, as of 25-gigabit Ethernet.
BANDWIDTH, LATENCY = 2.5e9, 30e-6
#: Start: standard deviations of rotations (radians), of camera centres and points (metres).
START = (0.002, 0.3, 0.3)


def make(folder: Path, observations: float, part: int = PART, seed: int = 0) -> int:
    """Write an aerial block in parts; return its number of observations."""
    from groma.geometry import quaternion, se3
    from groma.io.archive import write_archive
    from groma.scene import Cameras, PointObservations, Points, Scene

    rng = np.random.default_rng(seed)
    count = max(64, round(observations / PER_IMAGE))
    across = max(8, round(np.sqrt(count / 4)))
    along = -(-count // across)
    grid = np.stack(np.meshgrid(np.arange(along), np.arange(across), indexing="ij"), axis=-1).reshape(-1, 2)
    centers = np.column_stack([grid * SPACING + rng.normal(0, 1.0, grid.shape), np.full(len(grid), ALTITUDE)])
    down = np.array([1.0, 0.0, 0.0, 0.0])  # x along, y across reversed, looking down
    turn = quaternion.multiply(quaternion.exp(rng.normal(0, 0.02, (len(grid), 3))), down)
    poses = np.hstack([turn, -quaternion.rotate(turn, centers)])
    rough = quaternion.multiply(quaternion.exp(rng.normal(0, START[0], (len(grid), 3))), turn)
    start = np.hstack([rough, -quaternion.rotate(rough, centers + rng.normal(0, START[1], centers.shape))])
    camera = Cameras(
        np.array([1]), ("PINHOLE",), np.array([[FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]]), np.array([WIDTH]),
        np.array([HEIGHT]),
    )  # fmt: skip
    names = [f"{i:03d}_{j:03d}.jpg" for i, j in grid]
    empty = Scene.from_images(camera, names, np.zeros(len(names), np.int64), start)
    extent = np.array([along - 1, across - 1]) * SPACING
    strips = max(1, round(observations / part))
    reach = np.stack(np.meshgrid(np.arange(-2, 3), np.arange(-2, 3), indexing="ij"), axis=-1).reshape(-1, 2)
    total = 0
    for number in range(strips):
        low, high = extent[0] * number / strips, extent[0] * (number + 1) / strips
        points = rng.poisson(DENSITY * (high - low) * extent[1])
        xyz = np.column_stack(
            [rng.uniform(low, high, points), rng.uniform(0, extent[1], points), rng.normal(0, 3, points)]
        )
        near = np.round(xyz[:, :2] / SPACING).astype(np.int64)
        image, point, pixel = [], [], []
        for offset in reach:
            cell = near + offset
            rows = np.flatnonzero(((cell >= 0) & (cell < [along, across])).all(axis=1))
            photograph = cell[rows, 0] * across + cell[rows, 1]
            seen = se3.transform_points(poses[photograph], xyz[rows])
            where = FOCAL * seen[:, :2] / seen[:, 2:] + [WIDTH / 2, HEIGHT / 2]
            inside = ((where > 0) & (where < [WIDTH, HEIGHT])).all(axis=1)
            image.append(photograph[inside])
            point.append(rows[inside])
            pixel.append(where[inside] + rng.normal(0, NOISE_PX, (int(inside.sum()), 2)))
        image_idx, point_idx, pixels = np.concatenate(image), np.concatenate(point), np.concatenate(pixel)
        order = np.argsort(point_idx, kind="stable")
        ids = np.arange(len(xyz)) + 1
        cut = empty.replace(
            points=Points(
                ids, xyz + rng.normal(0, START[2], xyz.shape), np.zeros((len(xyz), 3), np.uint8), np.zeros(len(xyz))
            ),
            point_observations=PointObservations(
                image_idx[order], point_idx[order], pixels[order], np.full(len(order), -1)
            ),
        )
        write_archive(cut, folder / f"part-{number:05d}.npz", force=True)
        total += len(order)
    return total


def run(folder: Path, arguments: argparse.Namespace, output: Path) -> dict:
    """Adjust the parts of a folder in this process, and in all that were started with it."""
    from groma.adjustment.parts import adjust_parts, parts_of
    from groma.solver.options import SolverOptions
    from groma.solver.reduce.mpi import reducer_of_launcher

    options = SolverOptions(
        max_iterations=arguments.steps, threads=arguments.threads, shared_system=arguments.shared_system,
        function_tolerance=0.0, gradient_tolerance=0.0, step_tolerance=0.0,
    )  # fmt: skip
    reducer = reducer_of_launcher()
    began, steps_at = (time.process_time(), time.perf_counter()), []
    result = adjust_parts(
        parts_of(folder), output, options=options, keep=arguments.keep, reducer=reducer, force=True,
        progress=lambda _: steps_at.append(time.process_time()),
    )  # fmt: skip
    report, peak = result.report, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {
        "rank": reducer.rank,
        "cpu_s": sum(map(float, reducer.gather(str(time.process_time() - began[0])))),
        "wall_s": time.perf_counter() - began[1],
        "steps": report.iterations,
        "step_cpu_s": max(map(float, reducer.gather(str((steps_at[-1] - steps_at[0]) / max(1, len(steps_at) - 1))))),
        "step_s": (report.history[-1].seconds - report.history[0].seconds) / max(1, report.iterations - 1),
        "seconds": report.seconds,
        "initial_cost": report.initial_cost,
        "final_cost": report.final_cost,
        "residuals": report.num_residuals,
        "unknowns": report.num_unknowns,
        "solver": report.linear_solver,
        "bytes": getattr(reducer, "bytes_summed", 0) // (report.iterations + 1),
        "peak_mib": max(map(float, reducer.gather(str(peak)))),
    }


def started(folder: Path, arguments: argparse.Namespace, ranks: int = 1, plain: bool = False) -> dict:
    """Adjust the parts of a folder in processes of their own; return what rank 0 reports."""
    own = [sys.executable, __file__, "--run", folder, "--steps", arguments.steps, "--threads", arguments.threads]
    own += ["--keep", arguments.keep, "--shared-system", arguments.shared_system]
    own += ["--plain-sums"] if plain else []
    return json.loads(launched(own, ranks).splitlines()[-1])


def launched(command: list, ranks: int) -> bytes:
    """Run a command in so many processes together; return what they print."""
    if ranks > 1:
        launcher = shutil.which("mpiexec", path=sysconfig.get_path("scripts")) or "mpiexec"
        command = [launcher, "-n", ranks, *command]
    return subprocess.run([str(word) for word in command], check=True, capture_output=True).stdout


def compare_ranks(folder: Path, observations: int, arguments: argparse.Namespace) -> None:
    """Adjust the parts with each number of ranks in turn, and print ratios."""
    rows: dict[int, list[dict]] = {ranks: [] for ranks in arguments.ranks}
    for _ in range(arguments.rounds):
        for ranks, found in rows.items():
            found.append(started(folder, arguments, ranks))
    first = rows[arguments.ranks[0]]
    print(f"{observations:,} observations, {arguments.rounds} rounds in turn, --keep {arguments.keep}\n")
    print("| ranks | step | CPU of a rank in a step | memory of a rank | MiB | bytes of a step | final cost |")
    print("|--:|--:|--:|--:|--:|--:|--:|")
    for ranks, found in rows.items():
        step, spent, peak = (
            np.median([own[key] / base[key] for own, base in zip(found, first, strict=True)])
            for key in ("step_s", "step_cpu_s", "peak_mib")
        )
        cost, size = found[0]["final_cost"], found[0]["bytes"]
        size = f"{found[0]['peak_mib']:.0f} | {size:,}"
        print(f"| {ranks} | {step:.2f} | {spent:.2f} | {peak:.2f} | {size} | {cost:.17g} |")
    alone = rows[min(rows)][0]
    num_bytes = max(row["bytes"] for found in rows.values() for row in found)
    solve = alone["seconds"]["solve"] / (alone["steps"] + 1)
    parts = float(np.median([row["step_cpu_s"] for row in rows[min(rows)]])) * min(rows) - solve
    print(f"\nOf {parts + solve:.2f} s of CPU time for a step of one rank {solve:.3f} s solve the system. Foreseen:")
    for ranks in (1, 16, 64, 256):
        message = (2 * num_bytes / BANDWIDTH + 2 * LATENCY * np.log2(ranks)) if ranks > 1 else 0.0
        print(
            f"  {ranks:4d} ranks: {parts / ranks + solve + message:.3f} s a step, of which {message:.4f} s for the sum"
        )


def compare_sums(folder: Path, observations: int, arguments: argparse.Namespace) -> None:
    """Adjust the parts with exact and with plain sums in turn, and print what exact ones cost."""
    rounds = [[started(folder, arguments, plain=plain) for plain in (False, True)] for _ in range(arguments.rounds)]
    spent = [exact["step_cpu_s"] / plain["step_cpu_s"] for exact, plain in rounds]
    exact, plain = rounds[0]
    print(
        f"{observations:,} observations, {arguments.rounds} rounds: CPU time of a step with exact sums over plain ones "
        f"{np.median(spent):.3f} ({min(spent):.3f} to {max(spent):.3f}); a step takes {plain['step_cpu_s']:.2f} s. "
        f"Final costs {exact['final_cost']:.17g} and {plain['final_cost']:.17g}."
    )


def sum_plainly() -> None:
    """Let sums forget their rounding errors, as plain ones do."""
    from groma.solver.reduce import exact_sums

    def add(sums: np.ndarray, values: np.ndarray, rows: np.ndarray | None = None) -> None:
        sums.real[... if rows is None else rows] += values

    exact_sums.add = add


def make_corridor(folder: Path, observations: float, part: int) -> int:
    """Write a walk round a corridor in parts; return its number of observations."""
    from groma.adjustment.parts import write_parts
    from groma.scene import synthetic

    scene = synthetic.corridor(max(12, round(observations / 1220))).start
    write_parts(scene, folder, part)
    print(f"{scene}\n")
    return scene.num_observations


def compare_states(images: int, ranks: list[int], work: Path) -> None:
    """Print the largest differences between the states of a solve at once and of parts."""
    from groma.adjustment.assemble import assemble, disassemble
    from groma.adjustment.assembly_options import AssemblyOptions
    from groma.adjustment.parts import join_parts, parts_of, write_parts
    from groma.adjustment.uncertainty import position_sigma, uncertainty
    from groma.geometry import line3
    from groma.scene import PosePriors, synthetic
    from groma.solver.solve import solve

    made = synthetic.corridor(images)
    count = made.start.num_frames
    priors = PosePriors(np.arange(count), made.truth.frames.rig_from_world, np.full((count, 6), 0.01))
    paths = write_parts(made.start.replace(pose_priors=priors), work / "parts", made.start.num_observations // 12)
    whole = join_parts(paths)
    print(f"{whole}, {len(paths)} parts\n")
    problem = assemble(whole, AssemblyOptions()).problem
    solution = solve(solve(problem, states_options()).problem, states_options("gauss_newton"))
    solved = disassemble(whole, solution.problem)
    ends = uncertainty(solved, problem=solution.problem).segment_ends
    sigma = position_sigma(ends.reshape(-1, 3, 3)).reshape(-1, 2)
    print("| ranks | poses | points | lines | planes | same files as of the first |\n|--:|--:|--:|--:|--:|---|")
    files = []
    for number in ranks:
        output = work / f"of-{number}"
        launched([sys.executable, __file__, "--run-states", work / "parts", "--work", output], number)
        found = join_parts(parts_of(output))
        files.append([path.read_bytes() for path in parts_of(output)])
        off = [
            np.abs(getattr(getattr(found, table), column) - getattr(getattr(solved, table), column)).max()
            for table, column in (("frames", "rig_from_world"), ("points", "xyz"), ("planes", "hesse"))
        ]
        distance = line3.distance_to_point(found.lines.plucker[:, None], solved.lines.segments)
        off.insert(2, distance.max())
        print(
            f"| {number} | {' | '.join(f'{value:.1e}' for value in off)} | {'yes' if files[-1] == files[0] else 'no'} |"
        )
    least = np.sqrt(2.0 * np.finfo(float).eps * solution.report.final_cost)
    largest = np.sort(distance.max(axis=1))[-2:]
    print(f"\nlines differ by at most {(distance / sigma).max():.1e} standard deviations; the cost tells {least:.1e}")
    print(f"one line differs by {largest[1]:.1e}, all others by at most {largest[0]:.1e}")


def states_options(method: str = "levenberg_marquardt"):
    """Return options with which a solve goes on until nothing changes."""
    from groma.solver.options import SolverOptions

    return SolverOptions(
        method=method, linear_solver="dense", threads=1, max_iterations=50,
        function_tolerance=0.0, gradient_tolerance=0.0, step_tolerance=0.0,
    )  # fmt: skip


def run_states(folder: Path, output: Path) -> None:
    """Solve parts together with the other processes, with damping and then without, and write them."""
    from groma.adjustment.assembly_options import AssemblyOptions
    from groma.adjustment.parts import parts_of
    from groma.adjustment.parts.checkpoint import Checkpoint
    from groma.adjustment.parts.opened import open_parts
    from groma.adjustment.parts.run import Run, Solved
    from groma.factors.losses import Trivial
    from groma.solver.reduce.mpi import Ranks
    from groma.solver.reduce.shards import solve_shards

    reducer = Ranks()
    opened = open_parts(parts_of(folder), AssemblyOptions(), reducer)
    variables = opened.variables
    for method in ("levenberg_marquardt", "gauss_newton"):
        solution = solve_shards(variables, opened.shards(Trivial()), states_options(method), None, reducer, 1e9)
        variables = solution.variables
    output.mkdir(exist_ok=True)
    run = Run(opened, [Trivial()], states_options(), None, reducer, 1e9, Checkpoint(output, "", opened, reducer))
    states = {name: group.state for name, group in variables.items()}
    run.write(Solved(states, solution.report, (), Trivial()), output)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--millions", type=float, nargs="+", default=[1, 4, 16, 50])
    parser.add_argument("--steps", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--work", type=Path, help="folder for the parts; default: a temporary one")
    parser.add_argument("--keep", default="never", help="keep parts in memory: auto, always, never")
    parser.add_argument("--ranks", type=int, nargs="+", help="compare numbers of processes")
    parser.add_argument("--part", type=int, default=PART, help="observations of a part")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--corridor", action="store_true", help="points, lines and planes in place of a block")
    parser.add_argument("--plain-sums", action="store_true", help="compare exact sums with plain ones")
    parser.add_argument("--shared-system", default="auto", help="formed, or products of conjugate gradients")
    parser.add_argument("--states", type=int, metavar="IMAGES", help="compare states with those of a solve at once")
    parser.add_argument("--run", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--run-states", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.run_states is not None:
        run_states(arguments.run_states, arguments.work)
        return
    if arguments.states is not None:
        with tempfile.TemporaryDirectory(dir=arguments.work) as work:
            compare_states(arguments.states, arguments.ranks or [1, 2, 4], Path(work))
        return
    if arguments.run is not None:
        if arguments.plain_sums:
            sum_plainly()
        row = run(arguments.run, arguments, arguments.run.parent / f"{arguments.run.name}-adjusted")
        if row["rank"] == 0:
            print(json.dumps(row))
        return
    if arguments.ranks is not None or arguments.plain_sums:
        compare, make_scene = compare_ranks if arguments.ranks else compare_sums, make
        if arguments.corridor:
            make_scene = make_corridor
        with tempfile.TemporaryDirectory(dir=arguments.work) as work:
            for million in arguments.millions:
                folder = Path(work) / f"{million:g}"
                folder.mkdir()
                compare(folder, make_scene(folder, 1e6 * million, arguments.part), arguments)
        return
    print(
        "| observations | parts | unknowns | solver | steps | CPU s per step | wall s | peak MiB | reduced chi-square |"
    )
    print("|--:|--:|--:|---|--:|--:|--:|--:|--:|")
    rows = []
    with tempfile.TemporaryDirectory(dir=arguments.work) as work:
        for million in arguments.millions:
            folder = Path(work) / f"{million:g}"
            folder.mkdir()
            observations = make(folder, 1e6 * million, arguments.part)
            row = started(folder, arguments)
            rows.append((observations, row))
            chi = 2 * row["final_cost"] / NOISE_PX**2 / (row["residuals"] - row["unknowns"])
            per_step = row["cpu_s"] / (row["steps"] + 1)
            cells = (
                f"{observations:,}", len(list(folder.iterdir())), f"{row['unknowns']:,}", row["solver"], row["steps"],
                f"{per_step:.1f}", f"{row['wall_s']:.0f}", f"{row['peak_mib']:.0f}", f"{chi:.4f}",
            )  # fmt: skip
            print("| " + " | ".join(map(str, cells)) + " |", flush=True)
            for used in Path(work).iterdir():
                shutil.rmtree(used)
    if len(rows) > 1:
        size = np.log([observations for observations, _ in rows])
        slope = np.polyfit(size, np.log([row["cpu_s"] for _, row in rows]), 1)[0]
        print(f"\nGrowth of the CPU time: exponent {slope:.2f}.")


if __name__ == "__main__":
    main()

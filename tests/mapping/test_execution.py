# SPDX-License-Identifier: BSD-3-Clause
"""Work in independent pieces: its order, its end, and the same result whoever does it."""

import ctypes
import importlib.util
import multiprocessing
import os
import shutil
import subprocess
import sys
import sysconfig
import threading
import time
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import nullcontext
from functools import cache, partial

import numpy as np
import pytest
from _wireframe import arc, random_lines, wireframe

from groma.execution import (
    available_cores,
    begin,
    beside,
    map_largest_first,
    map_ranges,
    map_work,
    num_workers,
    work_with,
)
from groma.mapping.lines.build import map_lines
from groma.mapping.lines.options import MapLinesOptions


def processes() -> ProcessPoolExecutor:
    return ProcessPoolExecutor(2, multiprocessing.get_context("spawn"))


@pytest.mark.parametrize("workers", [1, 3])
def test_work_keeps_its_order_and_ends_with_an_error(workers):
    said = []
    with work_with(workers):
        found = map_work(lambda i: i * i, range(7), lambda done, total: said.append((done, total)))
        assert found == [i * i for i in range(7)]
        assert said == [(done, 7) for done in range(8)]
        assert map_work(str, []) == []
        done = []

        def interrupted(number, _):
            if number == 2:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            map_work(lambda i: (time.sleep(1e-4), done.append(i)), range(10_000), interrupted)
        assert len(done) < 10_000
        with pytest.raises(ZeroDivisionError):
            map_work(lambda i: 1 // i, [1, 0, 1])
        assert map_work(abs, [-1, -2]) == [1, 2]  # the executor is as good as before


def test_the_calling_thread_takes_part_and_no_more_pieces_are_begun_than_there_are_workers():
    running, most, places, lock = 0, 0, set(), threading.Lock()

    def work(i):
        nonlocal running, most
        with lock:
            running += 1
            most = max(most, running)
            places.add(threading.current_thread())
        time.sleep(1e-3)
        with lock:
            running -= 1
        return i

    with work_with(2):
        assert map_work(work, range(60)) == list(range(60))
    assert most <= 2 and threading.current_thread() in places


def test_pieces_do_not_wait_for_threads_that_other_work_keeps_busy():
    free = threading.Event()
    with work_with(2):
        busy = [begin(free.wait) for _ in range(2)]
        assert map_work(abs, [-1, -2, -3]) == [1, 2, 3]
        free.set()
        assert [ask() for ask in busy] == [True, True]


def test_a_piece_that_fails_in_another_thread_ends_the_work():
    main, done = threading.current_thread(), []

    def work(i):
        if threading.current_thread() is not main:
            raise ZeroDivisionError
        done.append(i)
        time.sleep(1e-3)

    with work_with(2), pytest.raises(ZeroDivisionError):
        map_work(work, range(10_000))
    assert len(done) < 10_000


def test_what_is_done_beside_a_block_goes_on_in_a_thread_and_is_done_when_it_ends():
    met, done = threading.Barrier(2, timeout=30.0), []
    with work_with(2), beside(lambda: (met.wait(), done.append("beside"))):
        met.wait()  # neither gets past it without the other
    assert done == ["beside"]
    with work_with(1), beside(lambda: done.append("after")):
        assert done == ["beside"]
    assert done == ["beside", "after"]
    for workers in (1, 2):
        with work_with(workers):
            with pytest.raises(ZeroDivisionError), beside(lambda: 1 // 0):
                done.append("block")
            with pytest.raises(KeyError, match="block"), beside(lambda: done.append("never lost") or 1 // 0):
                raise KeyError("block")
    assert done.count("block") == 2


@pytest.mark.parametrize("workers", [1, 2])
def test_the_largest_are_done_first_and_results_keep_their_order(workers):
    started, said = [], []

    def work(item):
        started.append(item)
        return 10 * item

    with work_with(workers):
        found = map_largest_first(work, range(5), [3, 1, 4, 1, 5], lambda done, total: said.append((done, total)))
    assert found == [0, 10, 20, 30, 40]
    assert sorted(started[:2]) == [2, 4] and sorted(started) == [0, 1, 2, 3, 4]
    assert said == [(done, 5) for done in range(6)]


def test_what_was_begun_goes_on_in_a_thread_and_is_done_once():
    met, calls = threading.Barrier(2, timeout=30.0), []
    with work_with(2):
        ask = begin(lambda: (met.wait(), calls.append("beside"), 7)[-1])
        met.wait()  # neither gets past it without the other
        assert (ask(), ask()) == (7, 7)
    with work_with(1):
        ask = begin(lambda: calls.append("asked") or 8)
        assert calls == ["beside"]
        assert (ask(), ask()) == (8, 8)
    assert calls == ["beside", "asked"]
    for workers in (1, 2):
        with work_with(workers), pytest.raises(ZeroDivisionError):
            begin(lambda: 1 // 0)()


def test_threads_share_what_was_begun_and_is_divided():
    met = threading.Barrier(2, timeout=30.0)
    with work_with(3):  # neither piece gets past it without the other
        assert len(begin(lambda: map_work(lambda _: met.wait(), range(2)))()) == 2


def test_what_no_thread_has_begun_is_done_by_who_asks():
    free, place = threading.Event(), []
    with work_with(2):
        busy = [begin(free.wait) for _ in range(2)]
        begin(lambda: place.append(threading.current_thread()))()
        free.set()
        assert [ask() for ask in busy] == [True, True]
    assert place == [threading.current_thread()]


def test_workers_are_those_given_outermost_and_none_inside_a_worker():
    assert num_workers() == 1
    with work_with(3):
        assert num_workers() == 3
        with work_with(1):
            assert num_workers() == 3
        assert map_work(lambda _: num_workers(), range(4)) == [1] * 4
    with work_with():
        assert num_workers() == available_cores()
    with ThreadPoolExecutor(5) as pool, work_with(pool):
        assert num_workers() == 5
    assert num_workers() == 1


@pytest.mark.parametrize("workers", [1, 4])
def test_ranges_cover_all_rows_once(workers):
    count = np.zeros(1001, int)

    def add(part):
        count[part] += 1

    with work_with(workers):
        map_ranges(add, len(count), 64)
        map_ranges(add, 0, 64)
    assert (count == 1).all()


@pytest.mark.parametrize("make", [partial(nullcontext, 1), partial(nullcontext, 3), processes], ids=["1", "3", "spawn"])
def test_lines_do_not_depend_on_who_maps_them(make):
    same_lines_as_alone(make())


@pytest.mark.skipif(importlib.util.find_spec("mpi4py") is None, reason="mpi4py is not installed")
def test_lines_mapped_by_mpi():
    mpiexec = shutil.which("mpiexec", path=sysconfig.get_path("scripts")) or shutil.which("mpiexec")
    if mpiexec is None:
        pytest.skip("there is no mpiexec")
    command = [mpiexec, "-n", "3", sys.executable, "-m", "mpi4py.futures", __file__]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    said = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, env=environment)
    assert said.returncode == 0, said.stderr
    assert said.stdout.split() == ["2", "workers", "agree"]


@pytest.mark.skipif(importlib.util.find_spec("distributed") is None, reason="dask.distributed is not installed")
def test_lines_mapped_by_dask():
    from distributed import Client

    with Client(n_workers=2, threads_per_worker=1, dashboard_address=None) as client:
        same_lines_as_alone(client.get_executor())


@cache
def mapped_alone():
    """A small wireframe, and what one thread maps."""
    rng = np.random.default_rng(4)
    world = wireframe(arc(5), random_lines(40, rng), rng)
    with work_with(1):
        return world, map_lines(world.scene, world.segments, None, MapLinesOptions())


def same_lines_as_alone(workers):
    """Compare all that mapping says."""
    world, alone = mapped_alone()
    with workers as chosen:
        assert isinstance(chosen, int | Executor)
        with work_with(chosen):
            found = map_lines(world.scene, world.segments, None, MapLinesOptions())
    assert alone.num_lines > 20
    for name in ("lines", "segments", "image_idx", "segment_idx", "line_idx", "residual", "uncertainty"):
        np.testing.assert_array_equal(getattr(found, name), getattr(alone, name))


if __name__ == "__main__":
    from mpi4py.futures import MPIPoolExecutor

    with MPIPoolExecutor() as ranks:
        number = ranks.num_workers
        same_lines_as_alone(ranks)
        print(number, "workers agree")


ARENAS = """
import ctypes, sys, threading
from groma.execution import share_memory
if sys.argv[1] == "shared":
    share_memory()
libc = ctypes.CDLL(None)
libc.malloc.restype, libc.fopen.restype = ctypes.c_void_p, ctypes.c_void_p
all_there = threading.Barrier(4)
def take():
    all_there.wait()  # threads that live at the same time
    libc.malloc(5000)
    all_there.wait()
threads = [threading.Thread(target=take) for _ in range(4)]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
file = ctypes.c_void_p(libc.fopen(sys.argv[2].encode(), b"w"))
libc.malloc_info(0, file)
libc.fclose(file)
print(open(sys.argv[2]).read().count("<heap nr="))
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="a matter of glibc")
def test_threads_take_memory_from_one_place(tmp_path):
    """Counted by glibc itself: one arena, where four threads at once have several otherwise."""
    if not hasattr(ctypes.CDLL(None), "malloc_info"):
        pytest.skip("not glibc")
    environment = {name: value for name, value in os.environ.items() if name != "MALLOC_ARENA_MAX"}

    def arenas(how):
        call = [sys.executable, "-c", ARENAS, how, str(tmp_path / how)]
        return int(subprocess.run(call, capture_output=True, text=True, check=True, env=environment).stdout)

    assert arenas("shared") == 1
    assert arenas("apart") > 1


ROOM = """
import ctypes, resource, sys
from groma.execution import share_memory
if sys.argv[1] == "kept":
    share_memory()
libc = ctypes.CDLL(None)
libc.malloc.restype, libc.free.argtypes = ctypes.c_void_p, (ctypes.c_void_p,)
def use():
    blocks = [libc.malloc(2**20) for _ in range(64)]
    for block in blocks:
        ctypes.memset(block, 1, 2**20)
    for block in blocks:
        libc.free(block)
use()
use()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
use()
print((resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before) * resource.getpagesize())
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="a matter of glibc")
def test_memory_is_kept_for_the_next_photograph():
    """The bytes of new pages that the same 64 MiB need when they are taken for the third time."""
    if not hasattr(ctypes.CDLL(None), "malloc_info"):
        pytest.skip("not glibc")
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}

    def new_bytes(how):
        call = [sys.executable, "-c", ROOM, how]
        return int(subprocess.run(call, capture_output=True, text=True, check=True, env=environment).stdout)

    assert new_bytes("kept") < 2**20  # one of the 64 blocks
    assert new_bytes("given back") > 32 * 2**20  # half of them

# SPDX-License-Identifier: BSD-3-Clause
"""Processes on one machine or on many that solve one problem together, by MPI.

A launcher (``mpiexec``, ``srun``) starts the same command several times and gives each process its number, the rank. In
a step every rank visits its own shards, and one Allreduce of one buffer sums what they found; all then solve the same
shared system. mpi4py is imported here, and only where there is more than one rank.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from concurrent.futures import Executor
from contextlib import AbstractContextManager
from typing import Any

import numpy as np

from groma._typing import ComplexArray, IntArray
from groma.errors import InputError
from groma.execution import available_cores
from groma.solver.reduce import exact_sums
from groma.solver.reduce.contract import Reducer
from groma.solver.reduce.single import SingleProcess

#: Environment variables of the rank and the number of ranks: MPICH and its kin, Open MPI, srun --mpi=pmix.
LAUNCHERS = (
    ("PMI_RANK", "PMI_SIZE"),
    ("OMPI_COMM_WORLD_RANK", "OMPI_COMM_WORLD_SIZE"),
    ("PMIX_RANK", "SLURM_STEP_NUM_TASKS"),
)

#: Numbers in one message, because MPI makes copies of it; and numbers added at once (cost: memory).
SUMMED_AT_ONCE, ADDED_AT_ONCE = 1 << 19, 1 << 14

#: A launcher passes on what a rank has printed when it comes to it, and drops the rest once it is told to end all ranks
#: (cost: of waiting before a failure).
_PASSING_ON_SECONDS = 0.2


def started_as(environment: Mapping[str, str] = os.environ) -> tuple[int, int]:
    """Return rank and number of ranks set by a launcher; (0, 1) for a process without one."""
    for rank, size in LAUNCHERS:
        if environment.get(rank, "").isdigit() and environment.get(size, "").isdigit():
            return int(environment[rank]), int(environment[size])
    return 0, 1


class Ranks:
    """The :class:`groma.solver.reduce.contract.Reducer` of all processes that a launcher started together.

    Raises
    ------
    InputError
        If mpi4py is missing, or its MPI is not that of the launcher.
    """

    def __init__(self) -> None:
        try:
            from mpi4py import MPI
        except ImportError as error:
            raise InputError(
                f"{started_as()[1]} processes were started together, and to work together they need MPI: "
                f'pip install "groma[mpi]" ({error}).'
            ) from error
        self._mpi: Any = MPI
        self._world: Any = MPI.COMM_WORLD
        self.rank, self.size = int(self._world.rank), int(self._world.size)
        if self.size != started_as()[1] and started_as()[1] > 1:
            raise InputError(
                f"{started_as()[1]} processes were started together, but mpi4py sees {self.size}: the launcher is of "
                f"another MPI. Use the mpiexec of the one that mpi4py uses, {MPI.Get_library_version()[:30]!r}."
            )
        self.num_neighbours, self.num_cores = self._share_of_machine()
        self._add: Any = MPI.Op.Create(_add, commute=True)
        #: Bytes of this rank in the largest sum, and in all; it sends and receives up to twice as many.
        self.bytes_per_sum = self.bytes_summed = 0

    def sum(self, values: ComplexArray) -> ComplexArray:  # noqa: D102
        self.bytes_per_sum, self.bytes_summed = (
            max(self.bytes_per_sum, values.nbytes),
            self.bytes_summed + values.nbytes,
        )
        flat = values.reshape(-1)
        for first in range(0, len(flat), SUMMED_AT_ONCE):
            self._world.Allreduce(self._mpi.IN_PLACE, flat[first : first + SUMMED_AT_ONCE], op=self._add)
        return values

    def union(self, numbers: IntArray) -> IntArray:  # noqa: D102
        counts = np.array(self._world.allgather(len(numbers)))
        found = np.empty(int(counts.sum()), np.int64)
        own = np.ascontiguousarray(numbers, np.int64)
        self._world.Allgatherv(own, [found, counts])
        return np.unique(found)

    def gather(self, text: str) -> list[str]:  # noqa: D102
        return self._world.allgather(text)

    def _share_of_machine(self) -> tuple[int, int]:
        """Return how many ranks there are on this machine, and how many of its cores this one may use."""
        machine = self._world.Split_type(self._mpi.COMM_TYPE_SHARED)
        own = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set(range(available_cores()))
        there, ranks = set().union(*machine.allgather(own)), int(machine.size)
        machine.Free()
        return ranks, max(1, min(len(own), len(there) // ranks))

    def others_as_executor(self) -> AbstractContextManager[Executor | None]:
        """Return a context: on rank 0 an executor of which all others are the workers, on these None, at its end."""
        from mpi4py.futures import MPICommExecutor

        context: Any = MPICommExecutor(self._world, root=0)
        return context

    def abort(self) -> None:
        """End all ranks: one of them has failed, and the others would wait for it."""
        time.sleep(_PASSING_ON_SECONDS)
        self._world.Abort(1)


def reducer_of_launcher() -> Reducer:
    """Return the reducer for how this process was started: all ranks of a launcher, or the process alone.

    Raises
    ------
    InputError
        As :class:`Ranks`.
    """
    return Ranks() if started_as()[1] > 1 else SingleProcess()


def _add(others: Any, sums: Any, _datatype: Any) -> None:
    """Add exact sums in buffers of MPI, in place; piece by piece, so that they stay in cache."""
    total, more = np.frombuffer(sums, np.complex128), np.frombuffer(others, np.complex128)
    for first in range(0, len(total), ADDED_AT_ONCE):
        part = slice(first, first + ADDED_AT_ONCE)
        exact_sums.add_sums(total[part], more[part])

"""Peers in worker processes, one a core, each with its own share of the programs and its own warm workspaces."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable
from multiprocessing.connection import Connection

import numpy as np

from benchmarks.suite import peers
from benchmarks.suite.peers import Solve
from benchmarks.suite.problems import Programs

# The programs are small: without this every solver's threads would fight over the cores.
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}


class Workers:
    """A context with as many processes as cores; they wait without using the processor."""

    def __init__(self, processes: int) -> None:
        context = multiprocessing.get_context("spawn")
        before = dict(os.environ)
        os.environ.update(ONE_THREAD)
        self._pipes, self._processes = [], []
        for _ in range(processes):
            here, there = context.Pipe()
            process = context.Process(target=_work, args=(there,), daemon=True)
            process.start()
            there.close()
            self._pipes.append(here)
            self._processes.append(process)
        os.environ.clear()
        os.environ.update(before)

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *_: object) -> None:
        for pipe, process in zip(self._pipes, self._processes, strict=True):
            pipe.close()
            process.join()

    def load(self, peer: str, batch: Programs) -> Loaded:
        """Spread programs over the processes, or give all to one where the peer has threads of its own."""
        pipes = self._pipes[: 1 if peer in peers.THREADED else None]
        parts = [(batch[rows],) for rows in np.array_split(np.arange(len(batch)), len(pipes))]
        return Loaded(pipes, peer, getattr(peers, peer), parts, len(batch))

    def spread(self, name: str, make: Callable[..., Solve], count: int, part: Callable[[np.ndarray], tuple]) -> Loaded:
        """What `make`, a function of a module, makes of the arguments for some of `count` rows, in every process."""
        rows = np.array_split(np.arange(count), len(self._pipes))
        return Loaded(self._pipes, name, make, [part(own) for own in rows], count)


class Loaded:
    """A peer with its programs; valid until the next of the same name."""

    def __init__(
        self, pipes: list[Connection], peer: str, make: Callable[..., Solve], parts: list[tuple], count: int
    ) -> None:
        self._pipes, self._peer, self.count = pipes, peer, count
        for pipe, part in zip(pipes, parts, strict=True):
            pipe.send((peer, make, part))
        self.setup_seconds = max(pipe.recv() for pipe in pipes)
        """Import, workspaces and, where there is any, compilation."""
        self.answers = np.full(count, np.nan)

    def run(self) -> float:
        """Solve everything once; seconds of processor time that the workers took together."""
        for pipe in self._pipes:
            pipe.send((self._peer, None, ()))
        replies = [pipe.recv() for pipe in self._pipes]
        self.answers = np.concatenate([answers for answers, _ in replies])
        return sum(cpu for _, cpu in replies)


def _work(pipe: Connection) -> None:
    loaded = {}
    while True:
        try:
            peer, make, part = pipe.recv()
        except EOFError:
            return
        if make is not None:
            start = time.perf_counter()
            loaded[peer] = make(*part)
            pipe.send(time.perf_counter() - start)
            continue
        start = time.process_time()
        answers = loaded[peer]()
        pipe.send((answers, time.process_time() - start))

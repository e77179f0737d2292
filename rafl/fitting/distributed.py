"""Training in several processes: recordings are shared out and results gathered (torch.distributed, gloo).

All processes run the same program. Each simulates its share of the recordings; the results are gathered in the
recordings' order, so that all processes go on with the same numbers and take the same decisions. Process 0 alone
writes files.
"""

import json
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import TypeVar, cast

import numba
import numpy as np
import torch
import torch.distributed as dist
from numpy.typing import NDArray

from rafl.common.errors import InputError, SimulationError
from rafl.data.objective import Recordings

T = TypeVar("T")
# A process may wait for the simulations of another as long as they take; one that has ended is noticed at once.
TIMEOUT = timedelta(days=30)
SHARED_ERRORS = (InputError, SimulationError)  # raised in all processes where one raises them


class OtherProcessError(Exception):
    """Another process of the training has ended."""


@dataclass(frozen=True)
class ProcessGroup:
    """The training processes, seen from one of them.

    Attributes:
        rank: number of this process, from 0.
        count: number of processes.
    """

    rank: int = 0
    count: int = 1

    @property
    def is_main(self) -> bool:
        """Whether this is process 0, which writes files and reports."""
        return self.rank == 0

    def share(self, items: Sequence[T]) -> list[T]:
        """This process's share of some items; none if there are fewer items than processes."""
        return list(items[self.rank :: self.count])

    def sum_over_processes(self, tensors: Sequence[torch.Tensor]) -> None:
        """Replace tensors, in place, by their sums over all processes."""
        if self.count == 1:
            return
        flat = torch.cat([tensor.reshape(-1) for tensor in tensors])
        with _waiting_for_others():
            dist.all_reduce(flat)
        _distribute(flat, tensors)

    def copy_from_main(self, tensors: Sequence[torch.Tensor]) -> None:
        """Replace tensors, in place, by those of process 0."""
        if self.count == 1:
            return
        flat = torch.cat([tensor.detach().reshape(-1).double() for tensor in tensors])
        with _waiting_for_others():
            dist.broadcast(flat, 0)
        _distribute(flat, tensors)

    def broadcast(self, value: T, source: int = 0) -> T:
        """One process's value, of numbers, texts, lists and dictionaries, in all processes."""
        if self.count == 1:
            return value
        text = json.dumps(value).encode() if self.rank == source else b""
        size = torch.tensor([len(text)])
        with _waiting_for_others():
            dist.broadcast(size, source)
            content = torch.zeros(int(size), dtype=torch.uint8)
            if self.rank == source:
                content = torch.from_numpy(np.frombuffer(text, np.uint8).copy())
            dist.broadcast(content, source)
        shared: T = json.loads(content.numpy().tobytes())
        return shared

    def wait(self) -> None:
        """Wait until all processes have reached this call."""
        if self.count > 1:
            with _waiting_for_others():
                dist.barrier()

    @contextmanager
    def fail_together(self) -> Iterator[None]:
        """A block that fails in all processes if it fails in one. Inside it, processes must exchange nothing.

        Raises:
            InputError, SimulationError: the error of the process of lowest number that failed.
            OtherProcessError: that process lacks memory or cannot read or write a file; itself, it raises that error.
        """
        own: Exception | None = None
        try:
            yield
        except (*SHARED_ERRORS, OSError, MemoryError) as error:
            own = error
        failed = torch.zeros(self.count)
        failed[self.rank] = own is not None
        self.sum_over_processes([failed])
        if not failed.any():
            return
        first = int(failed.argmax())
        if first == self.rank and own is not None:
            self.broadcast([type(own).__name__, str(own)], first)
            raise own
        kind, text = self.broadcast(["", ""], first)
        for shared in SHARED_ERRORS:
            if kind == shared.__name__:
                raise shared(text)
        raise OtherProcessError(f"process {first} of the training has failed: {kind} {text}".rstrip())

    def on_main(self, compute: Callable[[], T]) -> T:
        """What process 0 computes, in all processes, as `broadcast`; its errors as in `fail_together`."""
        found: T | None = None
        with self.fail_together():
            found = compute() if self.is_main else None
        return self.broadcast(cast(T, found))

    def by_recording(
        self,
        batches: Sequence[Recordings],
        width: int,
        compute: Callable[[Recordings, list[int]], NDArray[np.float64]],
    ) -> NDArray[np.float64]:
        """Numbers of every recording, (R, width), each row computed by one of the processes.

        Args:
            batches: recordings, R in total.
            width: numbers for each recording.
            compute: called with some recordings of one batch, and with their numbers among all; returns their rows.

        Raises:
            SimulationError: `compute` raised it in one of the processes; raised in all.
        """
        table = torch.zeros(sum(len(recordings.names) for recordings in batches), width, dtype=torch.float64)
        own, first = self.share(range(len(table))), 0
        with self.fail_together():
            for recordings in batches:
                last = first + len(recordings.names)
                rows = [row for row in own if first <= row < last]
                if rows:
                    part = recordings if len(rows) == last - first else recordings.select([r - first for r in rows])
                    table[rows] = torch.from_numpy(compute(part, rows))
                first = last
        self.sum_over_processes([table])
        return table.numpy()


ALONE = ProcessGroup()


def _distribute(flat: torch.Tensor, tensors: Sequence[torch.Tensor]) -> None:
    """Copy the elements of a flat tensor into several, in order."""
    parts = torch.split(flat, [tensor.numel() for tensor in tensors])
    for tensor, part in zip(tensors, parts, strict=True):
        tensor.detach().copy_(part.reshape(tensor.shape))


@contextmanager
def _waiting_for_others() -> Iterator[None]:
    """A block that exchanges something with the other processes.

    Raises:
        OtherProcessError: one of them has ended.
    """
    try:
        yield
    except RuntimeError as error:
        raise OtherProcessError(f"another process of the training has ended: {error}") from error


def rank() -> int:
    """This process's number among those that torchrun started; 0 without torchrun."""
    return int(os.environ.get("RANK", "0"))


def process_count() -> int:
    """Number of processes that torchrun started; 1 without torchrun."""
    return int(os.environ.get("WORLD_SIZE", "1"))


@contextmanager
def process_group() -> Iterator[ProcessGroup]:
    """The processes that torchrun started, or this one alone. Those of one machine share its threads."""
    count = process_count()
    if count == 1:
        yield ALONE
        return
    dist.init_process_group("gloo", timeout=TIMEOUT)
    threads = numba.get_num_threads()
    if "NUMBA_NUM_THREADS" not in os.environ:
        numba.set_num_threads(max(threads // int(os.environ.get("LOCAL_WORLD_SIZE", count)), 1))
    try:
        yield ProcessGroup(rank(), count)
    finally:
        numba.set_num_threads(threads)
        dist.destroy_process_group()

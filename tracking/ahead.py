"""What is needed soon is made before it is asked for, in a thread of its own."""

import queue
import threading
from collections.abc import Callable, Generator
from contextlib import closing
from typing import TypeVar

Thing = TypeVar("Thing")

# Pictures decoded before they are asked for, as the first takes its time: how many handfuls of how many bytes. Two
# threads that wait for each other at every picture lose a twentieth of their time.
HANDFULS, HANDFUL = 12, 2**22
LEAST = 2**18  # bytes that a thing counts for


def ahead(source: Generator[Thing], size_of: Callable[[Thing], int]) -> Generator[Thing]:
    """The same things, made in a thread of their own and handed over by the handful.

    Args:
        source: makes them.
        size_of: one of them [bytes].
    """
    made: queue.Queue[list[Thing] | BaseException | None] = queue.Queue(HANDFULS)
    stopped = threading.Event()

    def put(item: list[Thing] | BaseException | None) -> None:
        while not stopped.is_set():
            try:
                made.put(item, timeout=0.2)
            except queue.Full:
                continue
            return

    def work() -> None:
        handful: list[Thing] = []
        size = 0
        try:
            with closing(source):
                for thing in source:
                    handful.append(thing)
                    size += max(size_of(thing), LEAST)
                    if size >= HANDFUL:
                        put(handful)
                        handful, size = [], 0
                    if stopped.is_set():
                        return
            put(handful)
            put(None)
        except Exception as error:  # handed to whoever reads
            put(handful)
            put(error)

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    try:
        while (item := made.get()) is not None:
            if isinstance(item, BaseException):
                raise item
            item.reverse()
            while item:
                yield item.pop()  # and keeps no picture that nobody else does
    finally:
        stopped.set()
        thread.join()

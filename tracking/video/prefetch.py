"""What is needed soon is made before it is asked for, in a thread of its own."""

import queue
import threading
from collections.abc import Callable, Generator
from contextlib import closing
from typing import TypeVar

Thing = TypeVar("Thing")

AHEAD = 48 * 2**20  # bytes of pictures decoded before they are asked for, as the first takes its time
LEAST = 2**18  # bytes that a thing counts for


def ahead(source: Generator[Thing], size_of: Callable[[Thing], int]) -> Generator[Thing]:
    """The same things, made in a thread of their own.

    Each is handed over at once: where many were on their way, the processor's cache would not hold them all, and
    whoever makes the next would wait for memory.

    Args:
        source: makes them.
        size_of: one of them [bytes].
    """
    # These queues are far quicker than those that have a length: decoding hardly notices them.
    made: queue.SimpleQueue[tuple[list[Thing], int] | Exception | None] = queue.SimpleQueue()
    taken: queue.SimpleQueue[int | None] = queue.SimpleQueue()  # bytes; None where no more is wanted

    def work() -> None:
        room = AHEAD
        try:
            with closing(source):
                for thing in source:
                    size = max(size_of(thing), LEAST)
                    made.put(([thing], size))
                    del thing
                    room -= size
                    while room < 0 or not taken.empty():
                        back = taken.get()
                        if back is None:
                            return
                        room += back
            made.put(None)
        except Exception as error:  # handed to whoever reads
            made.put(error)

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    try:
        while (item := made.get()) is not None:
            if isinstance(item, Exception):
                raise item
            things, size = item
            taken.put(size)
            yield things.pop()  # and keeps no picture that nobody else does
    finally:
        taken.put(None)
        thread.join()

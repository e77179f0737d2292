"""Run a generator ahead of its reader in a thread of its own."""

import queue
import threading
from collections.abc import Callable, Generator
from contextlib import closing
from typing import TypeVar

Item = TypeVar("Item")

MAX_PREFETCH_BYTES = 48 * 2**20  # of images decoded in advance; they accumulate while the first frame is processed
MIN_ITEM_BYTES = 2**18  # smaller items count as this many


def prefetch(source: Generator[Item], size_of: Callable[[Item], int]) -> Generator[Item]:
    """Yield the source's items, which a separate thread produces in advance.

    Each item is handed over singly. Batches would overflow the processor's cache, and the producer would wait for
    memory. An exception of the source is raised after the items before it. Closing the generator closes the source.

    Args:
        source: produces the items.
        size_of: size of an item [bytes].
    """
    # SimpleQueue is far faster than a queue of bounded length; its cost beside decoding is negligible.
    produced: queue.SimpleQueue[tuple[list[Item], int] | Exception | None] = queue.SimpleQueue()
    consumed: queue.SimpleQueue[int | None] = queue.SimpleQueue()  # bytes; None tells the thread to stop

    def produce() -> None:
        free_bytes = MAX_PREFETCH_BYTES
        try:
            with closing(source):
                for item in source:
                    size = max(size_of(item), MIN_ITEM_BYTES)
                    produced.put(([item], size))
                    del item
                    free_bytes -= size
                    while free_bytes < 0 or not consumed.empty():
                        returned = consumed.get()
                        if returned is None:
                            return
                        free_bytes += returned
            produced.put(None)
        except Exception as error:  # raised again in the reader's thread
            produced.put(error)

    thread = threading.Thread(target=produce, daemon=True)
    thread.start()
    try:
        while (message := produced.get()) is not None:
            if isinstance(message, Exception):
                raise message
            items, size = message
            consumed.put(size)
            yield items.pop()  # so that no reference to the image remains here
    finally:
        consumed.put(None)
        thread.join()

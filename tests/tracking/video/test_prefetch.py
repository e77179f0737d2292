"""Prefetching in a thread."""

import threading
import time
from collections.abc import Generator
from contextlib import closing

import pytest

from rafl.tracking.video.prefetch import MAX_PREFETCH_BYTES, prefetch


class Source:
    """Yields numbers, and records how many and whether it was closed."""

    def __init__(self, count: int, fails: bool = False) -> None:
        self.produced = 0
        self.closed = threading.Event()
        self.count, self.fails = count, fails

    def numbers(self) -> Generator[int]:
        try:
            for number in range(self.count):
                self.produced = number + 1
                yield number
            if self.fails:
                raise OSError("the disk is gone")
        finally:
            self.closed.set()


def test_items_come_in_order_and_then_the_error() -> None:
    assert list(prefetch(Source(1000).numbers(), lambda _: 1)) == list(range(1000))
    items = prefetch(Source(7, fails=True).numbers(), lambda _: 1)
    assert [next(items) for _ in range(7)] == list(range(7))
    with pytest.raises(OSError, match="the disk is gone"):
        next(items)


@pytest.mark.parametrize(("size", "max_extra"), [(MAX_PREFETCH_BYTES // 4, 4), (2 * MAX_PREFETCH_BYTES, 0)])
def test_prefetch_is_limited_by_size(size: int, max_extra: int) -> None:
    """At most the requested items, those within the limit, and one in production."""
    source = Source(100)
    with closing(prefetch(source.numbers(), lambda _: size)) as items:
        for requested in range(1, 10):
            next(items)
            time.sleep(0.02)
            assert source.produced <= requested + max_extra + 1
    assert source.produced < 20


def test_closing_stops_the_source() -> None:
    source = Source(10**9)
    items = prefetch(source.numbers(), lambda _: MAX_PREFETCH_BYTES // 10)
    assert next(items) == 0
    items.close()
    assert source.closed.is_set()
    produced = source.produced
    time.sleep(0.02)
    assert source.produced == produced

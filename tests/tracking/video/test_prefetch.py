"""Making things ahead, in a thread of its own."""

import threading
import time
from collections.abc import Generator
from contextlib import closing

import pytest
from rafl.tracking.video.prefetch import AHEAD, ahead


class Source:
    """Counts, and says how far it has come and whether it was closed."""

    def __init__(self, count: int, fails: bool = False) -> None:
        self.made = 0
        self.closed = threading.Event()
        self.count, self.fails = count, fails

    def numbers(self) -> Generator[int]:
        try:
            for number in range(self.count):
                self.made = number + 1
                yield number
            if self.fails:
                raise OSError("the disk is gone")
        finally:
            self.closed.set()


def test_all_things_in_order_and_then_the_error() -> None:
    assert list(ahead(Source(1000).numbers(), lambda _: 1)) == list(range(1000))
    things = ahead(Source(7, fails=True).numbers(), lambda _: 1)
    assert [next(things) for _ in range(7)] == list(range(7))
    with pytest.raises(OSError, match="the disk is gone"):
        next(things)


@pytest.mark.parametrize(("size", "most"), [(AHEAD // 4, 4), (2 * AHEAD, 0)])
def test_no_more_is_made_than_there_is_room_for(size: int, most: int) -> None:
    """The thing that is asked for, those there is room for, and one more that may be on its way."""
    source = Source(100)
    with closing(ahead(source.numbers(), lambda _: size)) as things:
        for asked in range(1, 10):
            next(things)
            time.sleep(0.02)
            assert source.made <= asked + most + 1
    assert source.made < 20


def test_who_stops_reading_stops_the_making() -> None:
    source = Source(10**9)
    things = ahead(source.numbers(), lambda _: AHEAD // 10)
    assert next(things) == 0
    things.close()
    assert source.closed.is_set()
    made = source.made
    time.sleep(0.02)
    assert source.made == made

"""A message while numba compiles kernels for the first time on a computer."""

import functools
import sys

from numba.core import event

COMPILE_EVENT = "numba:compile"  # numba sends it for a real compilation, not for a kernel loaded from its cache
MESSAGE = "compiling numerical kernels for this computer: about a minute, only once"


class _Announcement(event.Listener):
    """Prints one line when the first kernel is compiled."""

    def __init__(self) -> None:
        self.printed = False

    def on_start(self, event: event.Event) -> None:
        """Print the line, once."""
        if not self.printed:
            self.printed = True
            print(MESSAGE, file=sys.stderr)

    def on_end(self, event: event.Event) -> None:
        """Nothing is printed at the end of a compilation."""


@functools.cache
def announce_compilation() -> None:
    """Print one line on standard error as soon as this process compiles a kernel that is not in numba's cache."""
    event.register(COMPILE_EVENT, _Announcement())  # type: ignore[no-untyped-call]  # numba has no types

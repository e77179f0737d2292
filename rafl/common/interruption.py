"""How a command is interrupted: by Ctrl-C (SIGINT) or by the system (SIGTERM), once, and never in vain."""

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

# Until an interruption that was lost is repeated [s]: Python has then left the code that cannot raise it.
REPEAT_AFTER = 0.01


class Terminated(KeyboardInterrupt):
    """The system asks the program to end (SIGTERM). What follows Ctrl-C follows: temporary files are removed."""


@contextmanager
def interruptible() -> Iterator[None]:
    """Let SIGTERM raise `Terminated`, once, and repeat interruptions that are lost.

    Python prints and drops an exception that is raised inside a destructor or a callback of the garbage collector,
    so a signal that arrives there would not end the command. It is sent again.

    SIGTERM is left alone where the program that started this one has chosen what it does, and outside the main
    thread.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    takes_sigterm = signal.getsignal(signal.SIGTERM) is signal.SIG_DFL

    def terminate(number: int, frame: object) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # nothing interrupts the removal of temporary files
        raise Terminated

    def repeat(lost: "sys.UnraisableHookArgs") -> None:
        if not issubclass(lost.exc_type, KeyboardInterrupt):
            report(lost)
            return
        number = signal.SIGINT
        if issubclass(lost.exc_type, Terminated):
            number = signal.SIGTERM
            signal.signal(signal.SIGTERM, terminate)
        again = threading.Timer(REPEAT_AFTER, os.kill, (os.getpid(), number))
        again.daemon = True
        again.start()

    report, sys.unraisablehook = sys.unraisablehook, repeat
    if takes_sigterm:
        signal.signal(signal.SIGTERM, terminate)
    try:
        yield
    finally:
        if takes_sigterm:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
        sys.unraisablehook = report

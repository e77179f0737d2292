"""Where the motion that a recording is used for begins, and in which state."""

from dataclasses import dataclass
from typing import Any, Literal

from numpy.typing import NDArray

from rafl.capture.release.free_motion import FreeMotion
from rafl.capture.release.release import find_release

Array = NDArray[Any]


@dataclass(frozen=True)
class MotionStart:
    """The first frame that is used, and the state of the specimen in it.

    Attributes:
        frame: number of the frame.
        rest_start: first frame of the interval of rest that ends at `frame`; equals `frame` if there is none.
        moving: whether the specimen moves in the frame.
        source: where the frame comes from.
        not_free: number of frames between the release and `frame` that no free motion explains.
    """

    frame: int
    rest_start: int
    moving: bool
    source: str
    not_free: int = 0

    @property
    def rest_frames(self) -> slice:
        """Frames at rest before the motion; the first one of the motion if there are none."""
        return slice(self.rest_start, max(self.frame, self.rest_start + 1))


def find_motion_start(position: Array, initial: Literal["auto", "rest", "moving"], given: int | None) -> MotionStart:
    """Find the first frame of the free motion and whether the specimen moves in it.

    A recording that moves from its first frame on starts there. Otherwise it starts at the release, or where the motion
    has become free after it.

    Args:
        position: marker positions as recorded [m], (T, M, 3), NaN where missing; evenly spaced in time.
        initial: state of the specimen: known, or to be found.
        given: the first frame if it is known.
    """
    source = "the motion" if given is None else "given"
    if initial == "moving":
        return MotionStart(given or 0, given or 0, True, "the beginning" if given is None else source)
    release = find_release(position, given)
    start, rest_start, moving, not_free = release.start, release.rest_start, False, 0
    motion = FreeMotion.of(position[start:]) if initial == "auto" else None
    if motion is not None:
        moving = rest_start == start and motion.moves()
        whole = FreeMotion.of(position) if moving and given is None else None
        if whole is not None and whole.moves() and whole.free_from() == 0:
            start = 0
        elif given is None:
            not_free = motion.free_from() or 0
    if not_free:
        start += not_free
        motion = FreeMotion.of(position[start:])
        moving = motion is not None and motion.moves()
        rest_start = start if moving else find_release(position, start).rest_start
        not_free = not_free if rest_start == start else 0
    return MotionStart(start, start if moving else rest_start, moving, source, not_free)

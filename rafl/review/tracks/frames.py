"""Frames of a video as JPEG images by number, cached and decoded in advance."""

import threading
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import simplejpeg
from numpy.typing import NDArray

from rafl.tracking.detection.detect import to_eight_bits
from rafl.tracking.video.frame_access import open_frames
from rafl.tracking.video.reader import Video

Array = NDArray[Any]

QUALITY = 88
MAX_CACHE_BYTES = 64 * 2**20  # of a video's images
AHEAD, BEHIND = 24, 8  # frames around the one shown that are prepared in advance


class FrameStore:
    """The frames of one video; any number of threads may ask."""

    def __init__(self, video: Video) -> None:
        self.frames = open_frames(video)
        self.decoding = threading.Lock()
        self.closed = False
        self.cache: OrderedDict[int, bytes | None] = OrderedDict()
        self.cached_bytes = 0
        self.caching = threading.Lock()
        self.shown, self.step = 0, 1
        self.background = ThreadPoolExecutor(1, thread_name_prefix="frames")
        self.preparing = False

    def image(self, number: int) -> Array | None:
        """Grey levels of a frame, (H, W); None if it is damaged or absent."""
        with self.decoding:
            return None if self.closed else self.frames.image(number)

    def jpeg(self, number: int) -> bytes | None:
        """A frame as a grey JPEG image; None if it is damaged or absent. Those after it are prepared."""
        found, content = self._look_up(number)
        if not found:
            content = self._encode(number)
        self.step = -1 if number < self.shown else 1
        self.shown = number
        with self.caching:
            if not self.preparing and not self.closed:
                self.preparing = True
                self.background.submit(self._prepare)
        return content

    def close(self) -> None:
        """End the work in the background and close the file."""
        with self.decoding:
            self.closed = True
            self.frames.close()
        with self.caching:
            self.background.shutdown(wait=False, cancel_futures=True)

    def _look_up(self, number: int) -> tuple[bool, bytes | None]:
        with self.caching:
            if number not in self.cache:
                return False, None
            self.cache.move_to_end(number)
            return True, self.cache[number]

    def _encode(self, number: int) -> bytes | None:
        image = self.image(number)
        content = None
        if image is not None:
            grey = to_eight_bits(image)[..., None]
            content = simplejpeg.encode_jpeg(grey, quality=QUALITY, colorspace="GRAY")
        with self.caching:
            if number not in self.cache:
                self.cache[number] = content
                self.cached_bytes += len(content or b"")
            while self.cached_bytes > MAX_CACHE_BYTES and len(self.cache) > AHEAD + BEHIND:
                self.cached_bytes -= len(self.cache.popitem(last=False)[1] or b"")
        return content

    def _prepare(self) -> None:
        """Encode the frames that a reader will want next, until all are there."""
        try:
            while (number := self._next_wanted()) is not None:
                self._encode(number)
        finally:
            with self.caching:
                self.preparing = False

    def _next_wanted(self) -> int | None:
        ahead = range(self.shown + 1, self.shown + AHEAD + 1)
        behind = range(self.shown - 1, max(self.shown - BEHIND, 0) - 1, -1)
        wanted = (*ahead,) if self.step > 0 else (*behind, *ahead)
        with self.caching:
            if self.closed:
                return None
            return next((number for number in wanted if number not in self.cache), None)

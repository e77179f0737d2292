"""Grey images from files that a stranger may have made: their size is read before they are decoded."""

import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps

from rafl.common.errors import InputError

# Largest image that is decoded [px]: a small file may claim any size and fill the memory. Cameras have up to 65e6.
MAX_PIXELS = 100_000_000
# What Pillow raises for damaged files, depending on their format.
DAMAGE = (OSError, ValueError, SyntaxError, TypeError, IndexError, EOFError, struct.error)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height [px] of an image as it is displayed, from its header.

    Raises:
        InputError: the file is no image, or the image has more than `MAX_PIXELS`.
    """
    with _open_image(path) as image:
        width, height = image.size
        turned = image.getexif().get(ExifTags.Base.Orientation, 1) >= 5
        return (height, width) if turned else (width, height)


def read_grey_image(path: Path) -> NDArray[np.uint8]:
    """Read an image as grey levels, (H, W). More than 8 bits are scaled to the image's own range.

    Raises:
        InputError: the file is damaged, no image, or the image has more than `MAX_PIXELS`.
    """
    with _open_image(path) as image:
        image.draft("L", None)  # a JPEG file has the grey levels as they are
        upright = ImageOps.exif_transpose(image)
        if upright.mode in ("F", "I") or upright.mode.startswith("I;"):
            deep = np.asarray(upright, dtype=np.float32)
            return np.asarray(cv2.normalize(deep, None, 0, 255, cv2.NORM_MINMAX), dtype=np.uint8)
        return np.array(upright.convert("L"))


@contextmanager
def _open_image(path: Path) -> Iterator[Image.Image]:
    """Open an image whose size is allowed. Errors and warnings in the block become an `InputError`."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # damaged metadata do not matter
        try:
            with Image.open(path) as image:
                width, height = image.size
                if width * height > MAX_PIXELS:
                    raise Image.DecompressionBombError
                yield image
        except Image.DecompressionBombError as error:
            raise InputError(
                f"expected an image of at most {MAX_PIXELS // 1_000_000} megapixels in {path}, found more; replace it"
            ) from error
        except DAMAGE as error:
            raise InputError(f"expected an image of the board in {path}, which cannot be read; replace it") from error

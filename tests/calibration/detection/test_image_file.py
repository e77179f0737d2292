import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from rafl.calibration.detection.image_file import image_size, read_grey_image
from rafl.common.errors import InputError


def png_chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def huge_png(width: int, height: int) -> bytes:
    """A small PNG file that unpacks to width x height zeros."""
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + png_chunk(b"IDAT", zlib.compress(bytes(1 << 20))) + png_chunk(b"IEND", b"")


@pytest.mark.parametrize("side", [11_000, 65_000])
@pytest.mark.filterwarnings("error")
def test_image_that_would_fill_the_memory_is_not_decoded(side: int, tmp_path: Path) -> None:
    path = tmp_path / "bomb.png"
    path.write_bytes(huge_png(side, side))
    for read in (image_size, read_grey_image):
        with pytest.raises(InputError, match="at most 100 megapixels in"):
            read(path)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".bmp"])
@pytest.mark.filterwarnings("error")
def test_truncated_images_are_refused_and_print_nothing(
    suffix: str, tmp_path: Path, random: np.random.Generator, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"image{suffix}"
    image = random.integers(0, 255, (80, 120), dtype=np.uint8)
    content = cv2.imencode(suffix, image)[1].tobytes()
    path.write_bytes(content)
    assert image_size(path) == (120, 80)
    assert np.abs(read_grey_image(path).astype(float) - image).mean() < 10.0
    for length in (0, 3, 30, len(content) // 2):
        path.write_bytes(content[:length])
        with pytest.raises(InputError, match="cannot be read; replace it"):
            read_grey_image(path)
    assert capfd.readouterr() == ("", "")


def test_images_of_16_bits_use_their_own_range(tmp_path: Path) -> None:
    """A camera of 12 bits in a file of 16."""
    image = np.linspace(0, 4095, 256).round().astype(np.uint16).reshape(16, 16)
    cv2.imwrite(str(tmp_path / "deep.tif"), image)
    cv2.imwrite(str(tmp_path / "deep.png"), image)
    for name in ("deep.tif", "deep.png"):
        assert np.abs(read_grey_image(tmp_path / name).ravel().astype(int) - np.arange(256)).max() <= 1

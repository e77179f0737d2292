"""Recording of a model frame that a hand sways: 28 dots, 160 frames, one camera."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from support import SHARED, Run, write_video

from rafl.tracking.linking.follow import follow
from rafl.tracking.video.frame import Frame
from rafl.tracking.video.reader import Reading, open_video

FOLDER = SHARED / "real" / "sway_frame"
pytestmark = [
    pytest.mark.real,
    pytest.mark.skipif(not FOLDER.is_dir(), reason=f"real recordings absent at {FOLDER}"),
]

CALIB = """format: rafl-calibration/1
cameras:
  front:
    model: orthographic
    image_size: [1300, 2046]
    pixels_per_mm: [1.6, 1.6]
    offset_px: [0, 0]
    plane: {normal: [0, 0, 1], offset_mm: 0}
"""


def test_every_dot_is_tracked(run: Run, tmp_path: Path) -> None:
    (tmp_path / "calib.yaml").write_text(CALIB)
    result = run("rafl-track", FOLDER, "--calib", "calib.yaml", "--fps", "22.7", "--jobs", "1")
    assert result.returncode == 0, result.stderr
    with h5py.File(tmp_path / "tracks" / "sway_frame.h5") as file:
        names = list(file.attrs["marker_names"])
        pixel = file["cameras/front/pixel"][()]
        measured = (file["state"][()] == 1).mean()
        assert float(file.attrs["fps"]) == pytest.approx(22.7)
    assert names == [f"r{row}c{column}" for row in (1, 2, 3, 4) for column in range(1, 8)]
    assert measured > 0.995
    # Positions of the dots in the first frame, read by eye.
    rows, columns = (471, 931, 1420, 1904), (148, 310, 466, 625, 778, 940, 1111)
    by_eye = np.array([(x, y) for y in rows for x in columns])
    assert np.abs(pixel[0] - by_eye).max() < 30
    # Each row is a stiff bar: constant spacings show that no identities are swapped.
    spacing = np.diff(pixel.reshape(160, 4, 7, 2)[..., 0], axis=2)
    assert np.nanmax(np.abs(spacing / np.nanmedian(spacing, axis=0) - 1.0)) < 0.05
    # Before the hand comes, the model sways slightly. The even and the odd columns of a row show the same motion; what
    # differs between the dots of a row is noise.
    motion = np.diff(pixel[:40], axis=0).reshape(39, 4, 7, 2) / np.sqrt(2)
    even, odd = motion[:, :, ::2, 0].mean(axis=2), motion[:, :, 1::2, 0].mean(axis=2)
    assert min(np.corrcoef(even[:, row], odd[:, row])[0, 1] for row in range(4)) > 0.85
    noise = np.sqrt(7 / 6) * (motion - motion.mean(axis=2, keepdims=True)).std(axis=0)
    assert np.median(noise) < 0.02


@dataclass(frozen=True)
class OccludedVideo:
    """Replaces the video: its frames, with a grey bar over them from the second frame on, if bars are given."""

    bars: tuple[tuple[slice, slice], ...] = ()  # rows and columns, by frame
    path: Path = FOLDER
    predicted_frames: bool = False

    def read(self) -> Reading:
        return Reading(self.frames())

    def frames(self) -> Iterator[Frame]:
        for number, path in enumerate(sorted(FOLDER.glob("*.jpg"))):
            image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            assert image is not None
            if number and self.bars:
                image[self.bars[number]] = 120
            yield Frame(number / 22.7, image)


@pytest.mark.slow
@pytest.mark.parametrize("downwards", [False, True])
def test_passing_bar_does_not_change_identities(downwards: bool) -> None:
    """The bar occludes two of seven columns or one of four rows at a time; partly occluded dots get a larger sigma."""
    unoccluded = follow(OccludedVideo(), lambda: None)
    ends, half = ((0, 2046), 260) if downwards else ((-200, 1500), 200)
    middle = np.linspace(*ends, 160).astype(int)
    bars = [slice(max(at - half, 0), max(at + half, 0)) for at in middle]
    everything = slice(None)
    video = OccludedVideo(tuple((bar, everything) if downwards else (everything, bar) for bar in bars))
    tracks = follow(video, lambda: None)
    order = np.linalg.norm(unoccluded.start[:, None] - tracks.start, axis=2).argmin(axis=1)
    assert sorted(order) == list(range(28))
    error = np.abs(tracks.pixel[:, order] - unoccluded.pixel)
    limit = np.maximum(0.3, 5.0 * tracks.sigma[:, order])
    assert (error > limit).sum() <= 2
    occluded = np.abs(unoccluded.pixel[..., int(downwards)] - middle[:, None]) < half + 15
    occluded[0] = False
    assert np.isfinite(error[~occluded]).mean() > 0.995


@pytest.mark.slow
def test_sigma_covers_the_compression_error(tmp_path: Path) -> None:
    """Encoded again with H.264, the positions deviate from the earlier ones by as much as sigma states."""
    original = follow(OccludedVideo(), lambda: None)
    path = tmp_path / "a.mkv"
    images = [frame.image for frame in OccludedVideo().frames() if frame.image is not None]
    write_video(path, "libx264", "yuv420p", options={"crf": "23"}, frames=images)
    compressed = follow(open_video(path), lambda: None)
    order = np.linalg.norm(original.start[:, None] - compressed.start, axis=2).argmin(axis=1)
    error, sigma = compressed.pixel[:, order] - original.pixel, compressed.sigma[:, order]
    measured = np.isfinite(error)
    assert measured.mean() > 0.995
    error, sigma = error[measured], sigma[measured]
    assert np.sqrt((error**2).mean()) < 0.07
    assert 0.75 < np.sqrt((sigma**2).mean() / (error**2).mean()) < 1.8
    assert 0.6 < np.mean(np.abs(error) < sigma) < 0.88
    assert np.mean((np.abs(error) > 0.25) & (np.abs(error) > 4.0 * sigma)) < 3e-3

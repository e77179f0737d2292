"""Dots on stickers that are hardly larger than the dots, so that their blurred edges merge."""

import cv2
import numpy as np
import pytest

from rafl.tracking.detection.appearance import find_markers
from rafl.tracking.linking.tracker import Tracker

SIZE = (420, 240)
SUPERSAMPLING = 4  # samples across a pixel
STICKER_OFFSETS = ((0, 0), (4, -3), (-3, 4))  # px: of a sticker's centre from its dot's


def draw_stickers(
    positions: np.ndarray, half: int, strip: float, blur: float, random: np.random.Generator
) -> np.ndarray:
    """Draw dots of radius 10 px at positions (D, 2) on grey squares, whose upper strip has its own level, on black."""
    fine = np.full((SIZE[1] * SUPERSAMPLING, SIZE[0] * SUPERSAMPLING), 12.0, np.float32)
    for number, (x, y) in enumerate(positions):
        dx, dy = STICKER_OFFSETS[number % 3]
        left, right, top, bottom, end = (
            round((edge + 0.5) * SUPERSAMPLING)
            for edge in (x + dx - half, x + dx + half, y + dy - half, y + dy + half, y + dy - half + 9)
        )
        fine[top:bottom, left:right] = 150.0
        fine[top:end, left:right] = strip
        centre = [round(((value + 0.5) * SUPERSAMPLING - 0.5) * 16) for value in (x, y)]
        cv2.circle(fine, centre, 10 * SUPERSAMPLING * 16, 8.0, -1, shift=4)
    blurred = cv2.GaussianBlur(fine, (0, 0), blur * SUPERSAMPLING)
    level = blurred.reshape(SIZE[1], SUPERSAMPLING, SIZE[0], SUPERSAMPLING).mean(axis=(1, 3))
    return np.clip(np.rint(level + random.normal(0.0, 2.0, level.shape)), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("half", "strip", "blur"), [(20, 150.0, 4.0), (18, 150.0, 4.0), (25, 220.0, 5.0)])
def test_defocused_dots_on_stickers_are_tracked(
    random: np.random.Generator, half: int, strip: float, blur: float
) -> None:
    rest = np.array([(60 + 75 * column, 60 + 70 * row) for row in range(2) for column in range(5)], float)
    rest += random.uniform(-1.0, 1.0, rest.shape)
    time = np.arange(40)[:, None]
    swing = np.concatenate([6.0 * np.sin(0.5 * time), 4.0 * np.sin(0.3 * time)], axis=1)
    truth = rest + swing[:, None] * rest[:, :1] / SIZE[0]
    found = find_markers(draw_stickers(truth[0], half, strip, blur, random))
    assert found is not None
    order = np.linalg.norm(truth[0][:, None] - found[1].centre, axis=2).argmin(axis=1)
    assert sorted(order) == list(range(10))
    tracker = Tracker(*found)
    dots = [tracker.advance(draw_stickers(positions, half, strip, blur, random)) for positions in truth[1:]]
    assert np.isfinite([each.sigma for each in dots]).mean() > 0.98
    error = np.array([each.centre[order] for each in dots]) - truth[1:]
    assert (error - error.mean(axis=0)).std() < 0.07  # a sticker's edge shifts its dot by the same in every frame

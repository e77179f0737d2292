"""Corners of a ChArUco board in an image, whichever of OpenCV's two layouts it was printed with."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rafl.calibration.detection.pyramid import refine_corners, search_levels

Array = NDArray[Any]

# Half the side of the window in which a corner is refined, relative to the gap between the corner and the marker next
# to it; foreshortening must not bring the marker into the window.
WINDOW_SHARE = 0.8
MIN_MARKERS = 2  # from which the layout is known


def find_charuco(image: NDArray[np.uint8], board: "cv2.aruco.CharucoBoard") -> tuple[Array, Array]:
    """Find the corners of a ChArUco board.

    OpenCV before 4.6 started boards with an even number of rows with a white square instead of a black one. The layout
    is the one whose markers a homography maps best to those that are seen.

    Args:
        image: grey levels, (H, W).
        board: the board, in either layout; it is set to the one that is found.

    Returns:
        Positions on the board (P, 2) in its unit, and pixels (P, 2).
    """
    share = WINDOW_SHARE * 0.5 * (1.0 - board.getMarkerLength() / board.getSquareLength())
    best: tuple[Array, Array] = np.zeros((0, 2)), np.zeros((0, 2))
    every = np.asarray(board.getChessboardCorners(), dtype=float)[:, :2]
    for level in search_levels(image):
        markers, ids, _ = cv2.aruco.ArucoDetector(board.getDictionary()).detectMarkers(level.image)
        if ids is None or len(ids) < MIN_MARKERS:
            continue
        misfits = {}
        for legacy in (False, True):
            board.setLegacyPattern(legacy)
            misfits[legacy] = _marker_misfit(board, markers, ids)
        board.setLegacyPattern(misfits[True] < misfits[False])
        corners, which, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(level.image, None, None, markers, ids)
        if which is None or len(which) <= max(len(best[0]), 1):
            continue
        # The pixel origin of these corners is a pixel's edge in OpenCV 4 and its centre in OpenCV 5. Refined corners
        # are relative to the centre in both.
        pixels = level.to_image(np.asarray(corners, dtype=float).reshape(-1, 2))
        best = every[np.ravel(which)], refine_corners(image, pixels, share)
        if len(which) == len(every):
            break
    return best


def _marker_misfit(board: "cv2.aruco.CharucoBoard", markers: Any, ids: NDArray[np.int32]) -> float:
    """Median distance [px] between the markers' corners and those of the best perspective view of the board."""
    places = dict(zip(np.ravel(board.getIds()).tolist(), board.getObjPoints(), strict=True))
    known = [(places[i], seen) for i, seen in zip(np.ravel(ids).tolist(), markers, strict=True) if i in places]
    if len(known) < MIN_MARKERS:
        return float("inf")
    own = np.concatenate([np.asarray(place, dtype=float)[:, :2] for place, _ in known])
    pixels = np.concatenate([np.asarray(seen, dtype=float).reshape(-1, 2) for _, seen in known])
    homography = cv2.findHomography(own, pixels, cv2.LMEDS)[0]
    if homography is None:
        return float("inf")
    return float(np.median(np.linalg.norm(cv2.perspectiveTransform(own[None], homography)[0] - pixels, axis=1)))

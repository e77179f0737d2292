"""Marker positions over time as a table with one row per frame and marker."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

Array = NDArray[Any]


def marker_table(time: Array, names: Sequence[str], position: Array) -> pd.DataFrame:
    """Columns frame, time_s, marker, x_mm, y_mm, z_mm from times (T) [s] and positions (T, M, 3) [m]."""
    frames, markers = position.shape[:2]
    table = pd.DataFrame(
        {
            "frame": np.repeat(np.arange(frames), markers),
            "time_s": np.repeat(time, markers),
            "marker": np.tile(np.array(names, dtype=object), frames),
        }
    )
    for axis, name in enumerate("xyz"):
        table[f"{name}_mm"] = 1e3 * position[..., axis].ravel()
    return table

"""Figures of simulated specimens for reports."""

import base64
import io
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from numpy.typing import NDArray

from rafl.fem.mesh import HexMesh

Array = NDArray[Any]

plt.rcParams["text.parse_math"] = False  # a name with $ is a name


def encode_png(figure: Figure) -> str:
    """Return the figure as a PNG in base64 text, and close it."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    plt.close(figure)
    return base64.b64encode(buffer.getvalue()).decode()


def _add_axes_3d(figure: Figure, index: int, count: int, q: Array, title: str) -> Any:
    """Add equally scaled axes that hold the positions q (N, 3) [m], as number `index` (from 1) of `count` in a row."""
    axes = figure.add_subplot(1, count, index, projection="3d")
    low, high = 1e3 * q.min(0), 1e3 * q.max(0)
    middle, half = 0.5 * (low + high), 0.55 * float((high - low).max())
    axes.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half))
    axes.set(zlim=(middle[2] - half, middle[2] + half), xlabel="x [mm]", ylabel="y [mm]", zlabel="z [mm]", title=title)
    axes.set_box_aspect((1, 1, 1), zoom=0.88)
    axes.view_init(elev=18, azim=-62)
    axes.tick_params(labelsize=7)
    return axes


def draw_specimens(mesh: HexMesh, frames: list[tuple[str, Array, Array]]) -> str:
    """Draw the specimen's surface and the recorded markers in 3-D, one plot per frame.

    Args:
        mesh: of the specimen.
        frames: title, vertex positions (N, 3) and recorded markers (M, 3) [m] of each.

    Returns:
        The figure as a PNG in base64 text.
    """
    figure = plt.figure(figsize=(4.6 * len(frames), 4.2), layout="constrained")
    all_positions = np.concatenate([q for _, q, _ in frames])
    for k, (title, q, markers) in enumerate(frames):
        axes = _add_axes_3d(figure, k + 1, len(frames), all_positions, title)
        surface = Poly3DCollection(
            1e3 * q[mesh.surface], facecolor="#9bc1e3", edgecolor="#3b6f9e", linewidth=0.4, alpha=0.35
        )
        axes.add_collection3d(surface)
        axes.computed_zorder = False  # else the surface, in front or not, is drawn over all markers
        known = 1e3 * markers[np.isfinite(markers[:, 0])]
        axes.scatter(*known.T, color="#c0392b", s=6, depthshade=False, zorder=surface.zorder + 1)
    return encode_png(figure)

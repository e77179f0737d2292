"""Picture of a description: the dots on each face of the body, as recorded and carried back."""

import io

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection, PolyCollection

from rafl.capture.description.describe import Description
from rafl.capture.description.naming import LETTERS, on_face

VIEWS = {"y-min": "left", "y-max": "right", "z-max": "top", "z-min": "bottom", "x-max": "tip", "x-min": "clamp"}
WIDTH_IN = 9.0  # of the picture
NAME_OFFSET_PT = (3.0, 3.0)  # from a dot to its name


def draw_description(description: Description, title: str) -> bytes:
    """A PNG file of every face that has dots: the undeformed body with the dots named, and the body as recorded."""
    plt.switch_backend("agg")
    mesh, found = description.shape.mesh, description.undeformed
    faces = np.array(description.faces)
    shown = [face for face in LETTERS if (faces == face).any()]
    both = np.concatenate([mesh.vertices, found.q])
    spans = [np.ptp(on_face(face, both), axis=0) for face in shown]
    heights = [0.9 + (WIDTH_IN - 1.0) * float(span[1] / max(span[0], span[1])) for span in spans]
    figure, grid = plt.subplots(
        len(shown),
        1,
        figsize=(WIDTH_IN, sum(heights) + 0.5),
        height_ratios=heights,
        layout="constrained",
        squeeze=False,
    )
    for axes, face in zip(grid[:, 0], shown, strict=True):
        for points, colours in ((found.q, ("#f3d9d5", "#d8a49c")), (mesh.vertices, ("#dbe8f4", "#8fb3d3"))):
            quads = 1e3 * on_face(face, points[mesh.surface].reshape(-1, 3)).reshape(-1, 4, 2)
            axes.add_collection(PolyCollection(list(quads), facecolor=colours[0], edgecolor=colours[1], linewidth=0.4))
        own = faces == face
        recorded, rest = (1e3 * on_face(face, points[own]) for points in (found.carried.position, found.carried.rest))
        axes.add_collection(LineCollection(list(np.stack([recorded, rest], axis=1)), color="#c0392b", linewidth=0.8))
        axes.plot(*recorded.T, "o", markersize=2.5, color="#c0392b")
        axes.plot(*rest.T, "o", markersize=4, color="#1f4e79")
        for dot, place in zip(np.flatnonzero(own), rest, strict=True):
            name = description.names[dot]
            axes.annotate(name, place, xytext=NAME_OFFSET_PT, textcoords="offset points", fontsize=7, parse_math=False)
        along, across = ("y", "z") if face[0] == "x" else ("x", "z") if face[0] == "y" else ("x", "y")
        # Rows of side faces and ends go down, along -z.
        axes.yaxis.set_major_formatter(lambda value, _, down=across == "z": f"{-value + 0.0 if down else value:g}")
        axes.set(aspect="equal", xlabel=f"{along} [mm]", ylabel=f"{across} [mm]", title=f"{VIEWS[face]} ({face})")
        axes.autoscale_view()
        axes.invert_yaxis()
    figure.suptitle(
        f"{title}\nblue: undeformed, with the places of the dots; red: as recorded", fontsize=9, parse_math=False
    )
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=130)
    plt.close(figure)
    return file.getvalue()

"""A layout of dots for a box, drawn to scale as a sheet that wraps around it."""

import io
from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from rafl.common.errors import InputError
from rafl.tracking.linking.layout import MarkerEntry, MarkerGrid

# Lengths in dot diameters. Detection wants about four between neighbours, and dots away from edges; jaws hide what is
# nearest to the clamp.
MIN_SPACING, MAX_SPACING, MARGIN, CLAMP_MARGIN = 3.0, 4.0, 2.0, 3.0
MIN_COLUMNS = 3  # and one more where there is one row
A4_MM = (297.0, 210.0)
PAGE_MARGIN_MM, CAPTION_MM = 10.0, 22.0  # around the sheet, and below it for the scale bar
SCALE_BAR_MM = 50.0


@dataclass(frozen=True)
class Stencil:
    """Dots for the two side faces of a box: a grid on each, and one dot more in a row of the next column.

    The additional dot ends the last row, at the tip, so that neither a mirror image nor exchanged sides fit.

    Attributes:
        size_mm: of the box.
        dot_mm: diameter of the dots.
        markers: grid and additional dot of the left face, then of the right.
    """

    size_mm: tuple[float, float, float]
    dot_mm: float
    markers: tuple[MarkerGrid | MarkerEntry, ...]


def design_stencil(size_mm: tuple[float, float, float], dot_mm: float) -> Stencil:
    """A layout of dots for the side faces of a box clamped at x-min.

    Raises:
        InputError: the box is too small for dots of this size.
    """
    length, width, height = size_mm
    columns, across = _spread(length - (CLAMP_MARGIN + MARGIN) * dot_mm, dot_mm)
    rows, down = _spread(height - 2.0 * MARGIN * dot_mm, dot_mm)
    if columns < MIN_COLUMNS + (rows == 1) or height < 2.0 * MARGIN * dot_mm:
        raise InputError(
            f"expected a side face with room for {MIN_COLUMNS} columns of {dot_mm:g} mm dots, found {length:g} x "
            f"{height:g} mm; choose a smaller --dot-mm"
        )
    first = CLAMP_MARGIN * dot_mm + 0.5 * (length - (CLAMP_MARGIN + MARGIN) * dot_mm - (columns - 1) * across)
    top = 0.5 * (height + (rows - 1) * down)
    x = [round(first + column * across, 2) for column in (0, columns - 1)]
    z = [round(top - row * down, 2) for row in (0, rows - 1)]
    used = columns - 1 - (rows == 1)  # one row more by an even step would look the same from both ends
    markers: list[MarkerGrid | MarkerEntry] = []
    for letter, face, y in (("L", "y-min", 0.0), ("R", "y-max", width)):
        values = {"rows": rows, "columns": used, "spacing_mm": [round(across, 2), round(down, 2)]}
        markers.append(MarkerGrid.model_validate({"name": letter, "face": face, "at_mm": (x[0], y, z[0]), **values}))
        markers.append(MarkerEntry(name=f"{letter}{rows * used + 1}", at_mm=(x[1], y, z[1])))
    return Stencil(size_mm, dot_mm, tuple(markers))


def _spread(extent: float, dot: float) -> tuple[int, float]:
    """Number of dots of a diameter over an extent, and their spacing."""
    widest = MAX_SPACING * dot
    steps = max(int(np.ceil(extent / widest - 1e-9)), 0)
    if extent < MIN_SPACING * dot * steps:
        steps -= 1
    return steps + 1, min(extent / steps, widest) if steps else widest


def draw_stencil(stencil: Stencil) -> Figure:
    """The sheet on a page at a scale of 1:1: the left face, above it the top, above it the right face upside down."""
    length, width, height = stencil.size_mm
    sheet = np.array([length, 2.0 * height + width])
    least = sheet + 2.0 * PAGE_MARGIN_MM + (0.0, CAPTION_MM)
    least[0] = max(least[0], SCALE_BAR_MM + 2.0 * PAGE_MARGIN_MM)
    fitting = [page for page in (A4_MM, A4_MM[::-1]) if (least <= page).all()]
    page = np.array(fitting[0] if fitting else least)
    figure = Figure(figsize=tuple(page / 25.4))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, page[0]), ylim=(0.0, page[1]))  # [mm] of the page
    axes.axis("off")
    left, bottom = 0.5 * (page[0] - length), PAGE_MARGIN_MM + CAPTION_MM
    axes.add_patch(Rectangle((left, bottom), *sheet, fill=False, linewidth=0.6))
    for fold in (height, height + width):
        axes.plot([left, left + length], [bottom + fold] * 2, "k--", linewidth=0.4)
    for text, middle in (("left", 0.5 * height), ("top", height + 0.5 * width), ("right", 1.5 * height + width)):
        axes.text(left + 1.0, bottom + middle, f"clamp, {text}", rotation=90, va="center", fontsize=5)
    for item in stencil.markers:
        for marker in item.markers():
            x, y, z = marker.at_mm
            up = z if y == 0.0 else 2.0 * height + width - z
            axes.add_patch(Circle((left + x, bottom + up), 0.5 * stencil.dot_mm, color="black", linewidth=0.0))
            axes.text(left + x, bottom + up - 0.75 * stencil.dot_mm, marker.name, ha="center", va="top", fontsize=4)
    bar = np.array([left, left + SCALE_BAR_MM])
    axes.plot(bar, [PAGE_MARGIN_MM + 12.0] * 2, "k|-", linewidth=0.6, markersize=8, gid="scale")
    axes.text(bar[0], PAGE_MARGIN_MM + 8.0, _CAPTION, va="top", fontsize=6)
    return figure


_CAPTION = (
    f"The bar is {SCALE_BAR_MM:g} mm long: print at 100 %, without fitting to the page, and measure it.\n"
    "Cut along the solid line, fold along the dashed ones, and wrap the sheet around the body, print outwards."
)


def stencil_pdf(stencil: Stencil) -> bytes:
    """The sheet as a PDF file."""
    plt.switch_backend("agg")
    figure = draw_stencil(stencil)
    file = io.BytesIO()
    figure.savefig(file, format="pdf")
    plt.close(figure)
    return file.getvalue()

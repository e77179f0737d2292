"""The layout of dots to print, and its scale."""

import re

import numpy as np
import pytest

from rafl.capture.description.stencil import SCALE_BAR_MM, design_stencil, draw_stencil, stencil_pdf
from rafl.common.errors import InputError
from rafl.tracking.linking.layout import MarkerLayout

SIZES = [((100.0, 30.0, 30.0), 3.0), ((100.0, 20.0, 20.0), 3.0), ((60.0, 8.0, 8.0), 2.0), ((400.0, 80.0, 60.0), 6.0)]


@pytest.mark.parametrize(("size", "dot"), SIZES)
def test_dots_are_apart_off_the_edges_and_unlike_their_mirror_image(size: tuple[float, ...], dot: float) -> None:
    layout = MarkerLayout.of(list(design_stencil(size, dot).markers))
    places = 1e3 * layout.positions
    for side in (0.0, size[1]):
        own = places[places[:, 1] == side][:, [0, 2]]
        distances = np.linalg.norm(own[:, None] - own, axis=2) + np.where(np.eye(len(own)), np.inf, 0.0)
        assert distances.min() >= 2.99 * dot
        assert np.median(distances.min(axis=1)) <= 4.01 * dot
        assert own.min() >= 2.0 * dot - 0.01
        assert (np.array([size[0], size[2]]) - own).min() >= 2.0 * dot - 0.01
        mirrored = own * [-1.0, 1.0] + [own[:, 0].min() + own[:, 0].max(), 0.0]
        misfit = np.linalg.norm(mirrored[:, None] - own, axis=2).min(axis=1)
        assert misfit.max() > dot


@pytest.mark.parametrize(("size", "dot"), SIZES)
def test_the_page_is_to_scale(size: tuple[float, ...], dot: float) -> None:
    stencil = design_stencil(size, dot)
    figure = draw_stencil(stencil)
    (axes,) = figure.axes
    (bar,) = (line for line in axes.lines if line.get_gid() == "scale")
    ends = axes.transData.transform(bar.get_xydata()) / figure.dpi * 25.4  # [mm] on paper
    assert np.ptp(ends[:, 0]) == pytest.approx(SCALE_BAR_MM, abs=1e-6)
    box = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", stencil_pdf(stencil))
    assert box is not None
    np.testing.assert_allclose(np.array(box.groups(), dtype=float) / 72.0, figure.get_size_inches(), rtol=1e-4)


def test_a_face_without_room_is_refused() -> None:
    with pytest.raises(InputError, match="choose a smaller --dot-mm"):
        design_stencil((20.0, 30.0, 30.0), 3.0)
    with pytest.raises(InputError, match="choose a smaller --dot-mm"):
        design_stencil((100.0, 30.0, 10.0), 3.0)

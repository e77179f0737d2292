"""A specimen with markers on one side, as one camera sees it."""

from dataclasses import replace

import pytest

from rafl.capture.specimen.specimen import Specimen
from rafl.tracking.linking.layout import MarkerLayout


@pytest.fixture(scope="session")
def front(small_specimen: Specimen) -> Specimen:
    """The specimen with the markers of one side only."""
    kept = small_specimen.layout.positions[:, 1] == 0.0
    names = tuple(name for name, own in zip(small_specimen.layout.names, kept, strict=True) if own)
    layout = MarkerLayout(names, small_specimen.layout.positions[kept], 0.0)
    return replace(small_specimen, layout=layout)

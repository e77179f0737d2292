"""Regression tests: recordings of the tracking benchmark in which a marker once got another marker's identity."""

from pathlib import Path

import numpy as np
import pytest


def restore_generator(state: int, increment: int, spare: int | None = None) -> np.random.Generator:
    """A generator that continues from a state of numpy's PCG64, with its spare 32 bits if there are any."""
    random = np.random.Generator(np.random.PCG64())
    random.bit_generator.state = {
        "bit_generator": "PCG64",
        "state": {"state": state, "inc": increment},
        "has_uint32": int(spare is not None),
        "uinteger": spare or 0,
    }
    return random


@pytest.mark.slow
def test_uncertain_velocity_does_not_change_identities(monkeypatch: pytest.MonkeyPatch) -> None:
    """A passing bar leaves two of ten markers visible; the others were predicted to within seven spacings only.

    A marker that returned kept its predicted velocity, which led it to its neighbour's dot in the next frame.
    """
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    from following import SyntheticVideo, linking_errors
    from motions import random_beam

    random = restore_generator(
        235228168387426991334409271039037267375, 27802739756728029119454616062701249777, 1185565442
    )
    beam = random_beam(random, 100, 0.435827680261298)
    random.normal(size=2)
    across = beam.centres[:, :, 0]
    bar = np.linspace(across.min() - 60.0, across.max() + 60.0, 100)[:, None]
    occluded = np.abs(across - bar) < 1.2 * beam.spacing
    occluded[0] = False
    assert (~occluded).sum(axis=1).min() == 2
    errors = linking_errors(SyntheticVideo(beam, random.uniform(2, 6), 10, occluded))
    assert (errors.wrong, errors.unmeasured_at_end) == (0, 0)
    assert errors.unmeasured < 0.4


def test_markers_lost_in_the_second_frame_do_not_shift_the_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    """A third of a bent beam is occluded from the second frame on, in which the beam has moved by 0.7 spacings.

    The other markers also matched the dots of the next column, one spacing away; the wrong match lasted to the end.
    """
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    from following import SyntheticVideo, linking_errors
    from motions import random_beam

    random = restore_generator(262288636991024201778451253006828596562, 33661119506509663402852927284673042037)
    beam = random_beam(random, 120, 0.7156839287503266)
    random.normal(size=2)
    across = beam.centres[:, :, 0]
    occluded = across > np.quantile(across, 0.7)
    occluded[0] = False
    assert occluded[1].sum() == 6
    errors = linking_errors(SyntheticVideo(beam, random.uniform(2, 6), 2, occluded))
    assert (errors.wrong, errors.unmeasured_at_end) == (0, 0)

"""Recordings of the bench in which a marker once went by another's name."""

from pathlib import Path

import numpy as np
import pytest


def generator(state: int, increment: int, left: int | None = None) -> np.random.Generator:
    """A generator of random numbers that goes on from a state of numpy's, and half a number that may be left."""
    random = np.random.Generator(np.random.PCG64())
    random.bit_generator.state = {
        "bit_generator": "PCG64",
        "state": {"state": state, "inc": increment},
        "has_uint32": int(left is not None),
        "uinteger": left or 0,
    }
    return random


def test_who_was_lost_is_not_told_by_how_it_seems_to_move(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bar passes that leaves two of ten markers in sight; where the others are was guessed to seven spacings.

    One of them that came back was taken to move on as guessed, which led it to its neighbour's dot in the next picture.
    """
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    from following import Drawn, judge
    from motions import random_beam

    random = generator(235228168387426991334409271039037267375, 27802739756728029119454616062701249777, 1185565442)
    beam = random_beam(random, 100, 0.435827680261298)
    random.normal(size=2)
    across = beam.centres[:, :, 0]
    bar = np.linspace(across.min() - 60.0, across.max() + 60.0, 100)[:, None]
    hidden = np.abs(across - bar) < 1.2 * beam.spacing
    hidden[0] = False
    assert (~hidden).sum(axis=1).min() == 2
    judged = judge(Drawn(beam, random.uniform(2, 6), 10, hidden))
    assert (judged.wrong, judged.late) == (0, 0)
    assert judged.lost < 0.1


def test_who_leaves_before_any_motion_is_known_shifts_no_column(monkeypatch: pytest.MonkeyPatch) -> None:
    """A third of a curled body is out of sight from the second picture on, in which it has moved by 0.7 spacings.

    The rest fitted as well, moved by a spacing, a column farther on; so it was taken from there to the end.
    """
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    from following import Drawn, judge
    from motions import random_beam

    random = generator(262288636991024201778451253006828596562, 33661119506509663402852927284673042037)
    beam = random_beam(random, 120, 0.7156839287503266)
    random.normal(size=2)
    across = beam.centres[:, :, 0]
    hidden = across > np.quantile(across, 0.7)
    hidden[0] = False
    assert hidden[1].sum() == 6
    judged = judge(Drawn(beam, random.uniform(2, 6), 2, hidden))
    assert (judged.wrong, judged.late) == (0, 0)

"""Which markers dots are, where part of a body comes back into sight."""

import numpy as np
from rafl.tracking.linking.reidentification import recalled, unmistakable
from rafl.tracking.linking.shape_prior import Belief, Memory
from support import curled

SPACING = np.full(14, 30.0)
NOBODY = np.full(14, -1)
MEMORY = Memory(curled(0.0))
for known in np.linspace(-0.45, 0.45, 31):
    MEMORY.add(curled(known), np.ones(14, bool))


def test_a_body_seen_before_is_known_again(random: np.random.Generator) -> None:
    for turn in (-0.37, 0.07, 0.41):
        mixed = random.permutation(14)
        match, agreed = recalled(MEMORY, curled(turn)[mixed], NOBODY, SPACING)
        np.testing.assert_array_equal(mixed[match], np.arange(14))
        assert agreed.all()


def test_its_tip_is_told_by_the_shape_that_it_had(random: np.random.Generator) -> None:
    """Eight dots of fourteen, far from where they stand at rest, beside two that are no markers."""
    shown = random.permutation(np.arange(6, 14))
    dots = np.concatenate([curled(0.4)[shown], [[-50.0, 10.0], [20.0, 170.0]]])
    match, agreed = recalled(MEMORY, dots, NOBODY, SPACING)
    np.testing.assert_array_equal(np.flatnonzero(agreed), np.arange(6, 14))
    np.testing.assert_array_equal(shown[match[6:]], np.arange(6, 14))


def test_two_dots_alone_may_be_any_pair() -> None:
    for pair in range(7):
        match, agreed = recalled(MEMORY, curled(0.2)[2 * pair : 2 * pair + 2], NOBODY, SPACING)
        assert not agreed.any() or ((agreed & (match >= 0)).sum() == 2 and (np.flatnonzero(agreed) // 2 == pair).all())


def test_a_shape_never_seen_is_not_recalled() -> None:
    dots = curled(0.2)
    dots[:, 1] *= -1.6
    assert not recalled(MEMORY, dots, NOBODY, SPACING)[1].any()


def test_what_is_sure_stays_so() -> None:
    dots = curled(0.3)
    sure = np.where(np.arange(14) < 4, np.arange(14), -1)
    match, agreed = recalled(MEMORY, dots, sure, SPACING)
    np.testing.assert_array_equal(match, np.arange(14))
    assert agreed.all()


def clear(gap: float, sigma: float, asked: int = 8) -> bool:
    """Whether a dot that far from where a marker is believed is beyond doubt that marker's; the last six are out."""
    belief = Belief(curled(0.2), np.where(np.arange(14) < 8, 0.0, sigma))
    dots = belief.place.copy()
    dots[asked] += [gap, 0.0]
    return bool(unmistakable(belief, dots, np.array([asked]), np.arange(14) >= 8, SPACING)[0])


def test_a_dot_near_its_place_and_far_from_others_is_unmistakable() -> None:
    assert clear(0.0, 2.0)
    assert clear(5.0, 4.0)


def test_what_is_believed_too_vaguely_is_not() -> None:
    assert not clear(0.0, 15.0)


def test_what_is_as_near_to_another_is_not() -> None:
    assert not clear(14.0, 8.0)


def test_what_is_too_far_off_is_another_thing() -> None:
    assert not clear(14.0, 0.5)

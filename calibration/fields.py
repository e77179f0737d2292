"""Kinds of values in the files people write."""

from typing import Annotated

import numpy as np
from pydantic import AfterValidator


def _unit(value: tuple[float, float, float]) -> tuple[float, float, float]:
    length = float(np.linalg.norm(value))
    if not abs(length - 1.0) < 1e-3:
        raise ValueError("expected a direction of length 1")
    x, y, z = (part / length for part in value)
    return x, y, z


def _positive(value: tuple[float, float]) -> tuple[float, float]:
    if not min(value) > 0:
        raise ValueError("expected two positive numbers")
    return value


Direction = Annotated[tuple[float, float, float], AfterValidator(_unit)]  # made exactly one long
PositivePair = Annotated[tuple[float, float], AfterValidator(_positive)]

"""Validated field types of the YAML files that users write."""

from typing import Annotated

import numpy as np
from pydantic import AfterValidator


def _unit_vector(value: tuple[float, float, float]) -> tuple[float, float, float]:
    length = float(np.linalg.norm(value))
    if not abs(length - 1.0) < 1e-3:
        raise ValueError("expected a direction of length 1")
    x, y, z = (part / length for part in value)
    return x, y, z


def _check_positive(value: tuple[float, float]) -> tuple[float, float]:
    if not min(value) > 0:
        raise ValueError("expected two positive numbers")
    return value


Direction = Annotated[tuple[float, float, float], AfterValidator(_unit_vector)]  # normalised to length 1
PositivePair = Annotated[tuple[float, float], AfterValidator(_check_positive)]

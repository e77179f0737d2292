"""Units of length, as files and users name them."""

from enum import StrEnum

# Metres in a unit, by its name in lower case.
METRES = {
    "m": 1.0,
    "meter": 1.0,
    "meters": 1.0,
    "metres": 1.0,
    "cm": 1e-2,
    "centimeter": 1e-2,
    "centimeters": 1e-2,
    "mm": 1e-3,
    "millimeter": 1e-3,
    "millimeters": 1e-3,
    "in": 0.0254,
    "inch": 0.0254,
    "inches": 0.0254,
}


class Unit(StrEnum):
    """Units that an option offers."""

    mm = "mm"
    cm = "cm"
    m = "m"

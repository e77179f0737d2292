"""The marker layout: names and positions of the markers on the undeformed specimen."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from rafl.common.yaml_files import StrictModel, read_yaml

SPECIMEN_FORMAT = "rafl-specimen/1"
DEFAULT_SIGMA_MM = 0.5  # standard deviation of a dot that a hand places with a ruler or a stencil


class MarkerEntry(StrictModel):
    """One marker of a specimen."""

    name: str = Field(min_length=1)
    at_mm: tuple[float, float, float]
    at_sigma_mm: float = Field(default=DEFAULT_SIGMA_MM, ge=0)


def _check_unique_names(markers: list[MarkerEntry]) -> list[MarkerEntry]:
    names = [marker.name for marker in markers]
    repeated = {name for name in names if names.count(name) > 1}
    if repeated:
        raise ValueError(f"expected different names, {sorted(repeated)[0]} occurs more than once")
    return markers


MarkerList = Annotated[list[MarkerEntry], AfterValidator(_check_unique_names)]


class MarkerEntries(BaseModel):
    """The part of a specimen file that tracking reads. Other keys are ignored."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    format: str
    markers: Annotated[MarkerList, Field(min_length=1)]


@dataclass(frozen=True)
class MarkerLayout:
    """The markers of a specimen.

    Attributes:
        names: (M).
        positions: at rest, in the specimen frame, as described [m], (M, 3).
        sigma: standard deviations of the positions [m], (M), or one for all.
    """

    names: tuple[str, ...]
    positions: NDArray[np.float64]
    sigma: NDArray[np.float64] | float = 1e-3 * DEFAULT_SIGMA_MM

    @classmethod
    def of(cls, markers: list[MarkerEntry]) -> "MarkerLayout":
        """From a specimen file's entries."""
        positions = 1e-3 * np.array([marker.at_mm for marker in markers], dtype=float).reshape(-1, 3)
        sigma = 1e-3 * np.array([marker.at_sigma_mm for marker in markers], dtype=float)
        return cls(tuple(marker.name for marker in markers), positions, sigma)


def read_layout(path: Path) -> MarkerLayout:
    """Read the markers of a specimen file (specimen.yaml).

    Raises:
        InputError: the file is missing, damaged, or of a newer version.
    """
    content = read_yaml(path, MarkerEntries, "a specimen (specimen.yaml)", SPECIMEN_FORMAT)
    return MarkerLayout.of(content.markers)

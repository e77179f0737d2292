"""What system identification finds: parameters of the material, their bounds and their priors."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rafl.fem.learned.energy import UNITS as ENERGY_UNITS
from rafl.fem.learned.viscosity import UNITS as VISCOSITY_UNITS
from rafl.fem.maxwell import branch_shares, branch_times

FIXED_POISSONS_RATIO = 0.499  # nearly incompressible; where only E is identified, as in the paper
BOUND_MARGIN = 1e-3  # share of the range of a variable within which it is at its bound
# What to check where a value ends at a bound that a specimen does not reach.
CHECK_BODY = (
    "check the specimen's size and density, with their units, the clamped face, the loads in recordings.csv and the "
    "frame rate"
)
CHECK_DAMPING = "check that nothing rubs on the body, that it is clamped firmly, and the frame rate"


@dataclass(frozen=True)
class Quantity:
    """A parameter to identify, and the transformed variable in which the search is evenly scaled.

    Attributes:
        name: in `rafl.simulation.parameters.Parameters`, `tan_delta`, or one of a list: `branch_share_1` and so on.
        low, high: bounds.
        kind: the variable is, for a value p, `log`: log(p / scale); `log-gap`: log((1/2 - p) / scale), in which the
            stiffness of elements that lock near p = 1/2 is nearly linear; `linear`: p / scale.
        unit: for messages.
        scale: in the unit of the value.
        start: value to start from if the assumed material has none, or less.
        deviation: standard deviation of the variable's prior around the assumed material.
        learned: whether the quantity is a weight of the constitutive residual.
        symbol: for messages; the name if empty.
        at_low, at_high: what to check where the value ends at that bound; empty if specimens reach it.
    """

    name: str
    low: float
    high: float
    kind: str
    unit: str
    scale: float = 1.0
    start: float = 0.0
    deviation: float = 3.0
    learned: bool = False
    symbol: str = ""
    at_low: str = ""
    at_high: str = ""

    def variable(self, value: float) -> float:
        """The variable of a value."""
        scaled = (0.5 - value if self.kind == "log-gap" else value) / self.scale
        return scaled if self.kind == "linear" else float(np.log(scaled))

    def value(self, variable: Any) -> Any:
        """The value of a variable, a float or a tensor."""
        if self.kind != "linear":
            variable = (torch.exp if isinstance(variable, Tensor) else np.exp)(variable)
        return 0.5 - self.scale * variable if self.kind == "log-gap" else self.scale * variable

    @property
    def bounds(self) -> tuple[float, float]:
        """Lower and upper bound of the variable."""
        a, b = self.variable(self.low), self.variable(self.high)
        return min(a, b), max(a, b)

    @property
    def inside(self) -> tuple[float, float]:
        """The variable's range without what counts as its bounds."""
        low, high = self.bounds
        margin = BOUND_MARGIN * (high - low)
        return low + margin, high - margin

    def at_bound(self, value: float) -> bool:
        """Whether a value is at one of its bounds."""
        low, high = self.inside
        return not low < self.variable(value) < high

    def bound_sentence(self, value: float) -> str:
        """What a value tells that is at a bound which specimens do not reach; else empty."""
        upper = abs(value - self.high) < abs(value - self.low)
        check = self.at_high if upper else self.at_low
        if not (check and self.at_bound(value)):
            return ""
        bound, asked = ("upper", "more") if upper else ("lower", "less")
        shown = f"{1e-3 * value:g} kPa" if self.unit == "Pa" else f"{value:g} {self.unit}".strip()
        return f"{self.symbol or self.name} is at its {bound} bound, {shown}: the recordings ask for {asked}; {check}"


MODULUS = Quantity(
    "youngs_modulus", 2e4, 1e7, "log", "Pa", deviation=2.0, symbol="E", at_low=CHECK_BODY, at_high=CHECK_BODY
)
POISSON = Quantity("poissons_ratio", 0.3, 0.4995, "log-gap", "", scale=0.05, symbol="nu", at_low=CHECK_BODY)
VISCOSITY = Quantity("viscosity", 0.0, 1e4, "linear", "Pa s", scale=100.0, start=100.0, at_high=CHECK_DAMPING)
LOSS_FACTOR = Quantity("tan_delta", 0.0, 0.5, "linear", "", scale=0.1, start=0.1, at_high=CHECK_DAMPING)
# [Hz]; from the creep that a recording of a second or two shows (a relaxation time of 1 s) to half of 100 frames/s.
LOSS_FREQUENCIES = (0.16, 50.0)
BRANCH_TIMES = branch_times(*LOSS_FREQUENCIES)  # [s]
SHARES = tuple(
    Quantity(f"branch_share_{k + 1}", 0.0, 1.0, "linear", "", scale=0.1, start=0.05, at_high=CHECK_DAMPING)
    for k in range(len(BRANCH_TIMES))
)
# Weights that change the stress by as much as the law has, or the loss factor by some hundredths, are unusual.
ENERGY_WEIGHTS = tuple(
    Quantity(f"energy_weight_{k + 1}", 0.0, 1.0 if k % 2 == 0 else 20.0, "linear", "", deviation=1.0, learned=True)
    for k in range(ENERGY_UNITS)
)
DISSIPATION_WEIGHTS = tuple(
    Quantity(f"dissipation_weight_{k + 1}", 0.0, 1.0, "linear", "", scale=0.01, deviation=1.0, learned=True)
    for k in range(VISCOSITY_UNITS)
)
METHOD_QUANTITIES = {
    "sysid": (MODULUS, POISSON),
    "sysid-e": (MODULUS,),
    "sysid-damping": (MODULUS, POISSON, VISCOSITY),
    "sysid-loss": (MODULUS, POISSON, LOSS_FACTOR),
    "sysid-branches": (MODULUS, POISSON, *SHARES),
    "constitutive": (MODULUS, POISSON, *SHARES, *ENERGY_WEIGHTS, *DISSIPATION_WEIGHTS),
}
# Lists of `rafl.simulation.parameters.Parameters`, and the quantities that are their elements.
LISTS = {"branch_shares": SHARES, "energy_weights": ENERGY_WEIGHTS, "dissipation_weights": DISSIPATION_WEIGHTS}


def material_values(identified: dict[str, Any]) -> dict[str, Any]:
    """Values by their name in `rafl.simulation.parameters.Parameters` from those of quantities.

    Values of quantities are floats or tensors (..); lists of K are (.., K).
    """
    values = {"poissons_ratio": FIXED_POISSONS_RATIO, **identified}
    tan_delta = values.pop(LOSS_FACTOR.name, None)
    for name, quantities in LISTS.items():
        elements = [values.pop(quantity.name) for quantity in quantities if quantity.name in values]
        if elements:
            values[name] = torch.stack([torch.as_tensor(x, dtype=torch.float64) for x in elements], dim=-1)
    if tan_delta is not None:
        values["branch_shares"] = branch_shares(torch.as_tensor(tan_delta, dtype=torch.float64), *LOSS_FREQUENCIES)
    if "branch_shares" in values:
        values["branch_times"] = torch.tensor(BRANCH_TIMES, dtype=torch.float64)
        values.setdefault(VISCOSITY.name, 0.0)  # the fastest branch takes its place
    return values

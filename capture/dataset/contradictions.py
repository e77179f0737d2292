"""Quantities of a dataset that contradict each other: load, frame rate, density and the assumed material."""

from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from rafl.data.dataset import Dataset

# Two measurements of Young's modulus agree within this factor. Those of simulated recordings agree within 1.1. Rubber
# is up to about 1.3 times as stiff in a swing as under a load that hangs for long.
AGREEMENT = 1.6
ASSUMED_WITHIN = 3.0  # factor within which the assumed modulus is taken to be right
UNITS = {"kg": 1e3, "N": 102.0}  # what load_g has to be multiplied by if it was typed in another unit


@dataclass(frozen=True)
class _Found:
    """What one recording shows: moduli by the bend and by the swing [Pa], frequency [Hz] and load [g]."""

    name: str
    bend: float
    swing: float
    frequency: float
    load: float


def contradictions(dataset: Dataset) -> list[str]:
    """One message for each kind of contradiction and the recordings that show it alike."""
    assumed, groups = dataset.simulator.material.youngs_modulus, defaultdict(list)
    for name, item in dataset.trajectories.items():
        keys = ("bend_modulus", "swing_modulus", "swing_hz", "load_g")
        bend, swing, frequency, load = (float(str(item.attributes.get(key, "nan"))) for key in keys)
        found = _Found(name, bend, swing, frequency, load)
        kind, ratio = _kind(found, assumed)
        if kind:
            groups[kind, round(np.log10(ratio))].append(found)
    texts = {"both": _both, "swing": _swing, "bend": _bend, "assumed": _assumed}
    return [f"{_names(group)}: {texts[kind](group[0], dataset)}" for (kind, _), group in groups.items()]


def _kind(found: _Found, assumed: float) -> tuple[str, float]:
    """Kind of a recording's contradiction, empty if there is none, and the factor between what should be equal."""
    ratio, mean = found.swing / found.bend, np.sqrt(found.swing * found.bend)
    if np.isfinite(ratio):
        if not _within(ratio, AGREEMENT):
            return "both", ratio
        return ("", 1.0) if _within(mean / assumed, AGREEMENT) else ("assumed", mean / assumed)
    for kind, value in (("swing", found.swing), ("bend", found.bend)):
        if np.isfinite(value) and not _within(value / assumed, ASSUMED_WITHIN):
            return kind, value / assumed
    return "", 1.0


def _within(ratio: float, factor: float) -> bool:
    return 1.0 / factor <= ratio <= factor


def _names(group: list[_Found]) -> str:
    return f"recording{'s' if len(group) > 1 else ''} {', '.join(found.name for found in group)}"


def _both(found: _Found, dataset: Dataset) -> str:
    assumed, ratio = dataset.simulator.material.youngs_modulus, found.swing / found.bend
    density = dataset.simulator.material.density
    bend, swing = _within(found.bend / assumed, ASSUMED_WITHIN), _within(found.swing / assumed, ASSUMED_WITHIN)
    causes = [_wrong_load(found, ratio)] if swing or not bend else []
    causes += [_wrong_rate(dataset, 1.0 / ratio)] if bend or not swing else []
    if len(causes) > 1:
        causes.append(f"the density is {_rounded(density / ratio, 2)} kg/m3, not {density:g}")
    return (
        f"expected one Young's modulus, found {_kpa(found.bend)} by the bend under the load and {_kpa(found.swing)} by "
        f"the swing at {found.frequency:.3g} Hz; {', or '.join(causes)}"
    )


def _swing(found: _Found, dataset: Dataset) -> str:
    assumed = dataset.simulator.material.youngs_modulus
    hanging = dataset.trajectories[found.name].added_mass.any()
    load = f" with {found.load:g} g hanging on it; correct load_g, " if hanging else "; correct "
    return (
        f"expected a Young's modulus of about {_kpa(assumed)} as in the specimen's description, found "
        f"{_kpa(found.swing)} by the swing at {found.frequency:.3g} Hz{load}youngs_modulus, or "
        f"{_wrong_rate(dataset, assumed / found.swing)}"
    )


def _bend(found: _Found, dataset: Dataset) -> str:
    assumed = dataset.simulator.material.youngs_modulus
    return (
        f"expected a Young's modulus of about {_kpa(assumed)} as in the specimen's description, found "
        f"{_kpa(found.bend)} by the bend under the load; correct youngs_modulus, or "
        f"{_wrong_load(found, assumed / found.bend)}"
    )


def _assumed(found: _Found, dataset: Dataset) -> str:
    material, mean = dataset.simulator.material, float(np.sqrt(found.bend * found.swing))
    return (
        f"bend and swing agree on a Young's modulus of about {_kpa(mean)} with a Poisson's ratio of "
        f"{material.poissons_ratio:g}; the specimen's description has {_kpa(material.youngs_modulus)}: correct it, or "
        "let rafl-fit find the material"
    )


def _wrong_load(found: _Found, factor: float) -> str:
    unit = next((f", typed in {unit}?" for unit, size in UNITS.items() if _within(factor / size, AGREEMENT)), "")
    return (
        f"the load is about {_rounded(found.load * factor, 2)} g, not {found.load:g} g{unit} (load_g in recordings.csv)"
    )


def _wrong_rate(dataset: Dataset, squared: float) -> str:
    rate = 1.0 / dataset.simulator.time_step
    return f"the film has about {_rounded(rate * np.sqrt(squared), 2)} frames/s, not {rate:.4g} (--fps)"


def _kpa(modulus: float) -> str:
    return f"{_rounded(1e-3 * modulus, 3)} kPa"


def _rounded(value: float, digits: int) -> str:
    """The number with some significant digits, without an exponent up to six digits before the point."""
    return f"{float(f'{value:.{digits}g}'):g}"

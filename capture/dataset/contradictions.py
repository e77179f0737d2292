"""Quantities of a dataset that contradict each other: load, frame rate, density and the assumed material."""

from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from rafl.data.dataset import Dataset

# Two measurements of Young's modulus agree within this factor. Those of simulated recordings agree within 1.1. Rubber
# is up to about 1.3 times as stiff in a swing as under a load that hangs for long, and never softer.
AGREEMENT, LEAST_SWING = 1.6, 1.0 / 1.15
ASSUMED_WITHIN = 3.0  # factor within which the assumed modulus is taken to be right
MIN_MEASUREMENTS = 3  # of which the median outvotes one that is wrong
UNITS = {"kg": 1e3, "N": 102.0}  # what load_g has to be multiplied by if it was typed in another unit


@dataclass(frozen=True)
class _Found:
    """What one recording shows: moduli by the bend and by the swing [Pa], frequency [Hz] and load [g]."""

    name: str
    bend: float
    swing: float
    frequency: float
    load: float


@dataclass(frozen=True)
class _Reference:
    """A modulus [Pa] that others should equal within a factor, and where it comes from."""

    modulus: float
    within: float
    source: str


def contradictions(dataset: Dataset) -> list[str]:
    """One message for each kind of contradiction and the recordings that show it alike."""
    keys, found = ("bend_modulus", "swing_modulus", "swing_hz", "load_g"), []
    for name, item in dataset.trajectories.items():
        bend, swing, frequency, load = (float(str(item.attributes.get(key, "nan"))) for key in keys)
        found.append(_Found(name, bend, swing, frequency, load))
    material = dataset.simulator.material
    references = [_Reference(material.youngs_modulus, ASSUMED_WITHIN, "the specimen's description")]
    measured = [value for one in found for value in (one.bend, one.swing) if np.isfinite(value)]
    if len(measured) >= MIN_MEASUREMENTS and material.integration == "enhanced":  # others lock, some modes more
        references.append(_Reference(float(np.median(measured)), AGREEMENT, "the other recordings"))
    groups: dict[tuple[str, int], list[tuple[str, str]]] = defaultdict(list)
    for one in found:
        contradiction = _two_measurements(one, dataset) or _one_measurement(one, dataset, references)
        if contradiction is not None:
            kind, ratio, text = contradiction
            groups[kind, round(np.log10(ratio))].append((one.name, text))
    return [f"{_names([name for name, _ in group])}: {group[0][1]}" for group in groups.values()]


def _two_measurements(found: _Found, dataset: Dataset) -> tuple[str, float, str] | None:
    """Kind, factor and text if the recording's two moduli contradict each other or the assumed one."""
    ratio, mean = found.swing / found.bend, np.sqrt(found.swing * found.bend)
    material = dataset.simulator.material
    factor = mean / material.youngs_modulus
    if not np.isfinite(ratio):
        return None
    # Elements that lock are too stiff, in some modes more than in others.
    least = LEAST_SWING if material.integration == "enhanced" else 1.0 / AGREEMENT
    if not least <= ratio <= AGREEMENT:
        return "both", ratio, _both(found, dataset)
    expected = AGREEMENT if material.integration == "enhanced" else ASSUMED_WITHIN
    return None if _within(factor, expected) else ("assumed", factor, _assumed(found, dataset))


def _one_measurement(found: _Found, dataset: Dataset, references: list[_Reference]) -> tuple[str, float, str] | None:
    """Kind, factor and text if the recording's only modulus contradicts the assumed one or those of the others."""
    for kind, value, other, text in (
        ("swing", found.swing, found.bend, _swing),
        ("bend", found.bend, found.swing, _bend),
    ):
        for reference in references:
            ratio = value / reference.modulus
            if np.isfinite(ratio) and np.isnan(other) and not _within(ratio, reference.within):
                return f"{kind} {reference.source}", ratio, text(found, dataset, reference)
    return None


def _within(ratio: float, factor: float) -> bool:
    return 1.0 / factor <= ratio <= factor


def _names(group: list[str]) -> str:
    return f"recording{'s' if len(group) > 1 else ''} {', '.join(group)}"


def _both(found: _Found, dataset: Dataset) -> str:
    assumed, ratio = dataset.simulator.material.youngs_modulus, found.swing / found.bend
    density = dataset.simulator.material.density
    bend, swing = _within(found.bend / assumed, ASSUMED_WITHIN), _within(found.swing / assumed, ASSUMED_WITHIN)
    causes = [_wrong_load(found, ratio)] if swing or not bend else []
    causes += [_wrong_rate(dataset, 1.0 / ratio)] if bend or not swing else []
    if len(causes) > 1:
        causes.append(f"the density is {_rounded(density / ratio, 2)} kg/m3, not {density:g}")
    if _within(ratio, AGREEMENT):
        causes.append("the size of the body is not that in the specimen's description")
    return (
        f"expected one Young's modulus, found {_kpa(found.bend)} by the bend under the load and {_kpa(found.swing)} by "
        f"the swing at {found.frequency:.3g} Hz; {', or '.join(causes)}"
    )


def _swing(found: _Found, dataset: Dataset, reference: _Reference) -> str:
    hanging = dataset.trajectories[found.name].added_mass.any()
    load = f" with {found.load:g} g hanging on it; correct load_g, " if hanging else "; correct "
    return (
        f"expected a Young's modulus of about {_kpa(reference.modulus)} as in {reference.source}, found "
        f"{_kpa(found.swing)} by the swing at {found.frequency:.3g} Hz{load}youngs_modulus, or "
        f"{_wrong_rate(dataset, reference.modulus / found.swing)}"
    )


def _bend(found: _Found, dataset: Dataset, reference: _Reference) -> str:
    return (
        f"expected a Young's modulus of about {_kpa(reference.modulus)} as in {reference.source}, found "
        f"{_kpa(found.bend)} by the bend under the load; correct youngs_modulus, or "
        f"{_wrong_load(found, reference.modulus / found.bend)}"
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

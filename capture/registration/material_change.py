"""A specimen's material where it is not the assumed one: what the shape of a loaded body tells of it.

Three numbers change the material: log E; log(1/2 - nu); and a weight that moves its law at large strains to either side
of the assumed one, towards more stress in tension or more in compression. A law with the same E and nu bends a body to
another shape by some per cent of the deflection, which virtual forces would take for a sideways pull.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.fem.learned.energy import KINDS, MIN_LAW_SHARE, SCALES, UNITS
from rafl.fem.material import Material
from rafl.fitting.quantities import POISSON
from rafl.simulation.simulator import Simulator

Array = NDArray[Any]

MODULUS_SIGMA = 0.5  # prior standard deviation of log E around the assumed material
# Of the weight of the law. Of 0.25, 0.5 and 1, the larger two find neo-Hookean and Mooney-Rivlin beams alike: with
# 60 g, the depth of one camera is 0.12 to 0.26 mm off, with 0.25 it is 0.32 to 0.47 mm. Where the law is the assumed
# one, it is at most 0.10, 0.19 and 0.34 mm off (tests/bench/unlike_material.py).
LAW_SIGMA = 0.5
# Of all three, less those of the assumed material; nu as in system identification.
MATERIAL_SIGMA = np.array([MODULUS_SIGMA, POISSON.deviation, LAW_SIGMA])
UNCHANGED = np.zeros(len(MATERIAL_SIGMA))
# Softening units of the learned energy at its largest scale, of either invariant: there they are nearly linear.
TENSION_UNIT = KINDS * (len(SCALES) - 1)
COMPRESSION_UNIT = TENSION_UNIT + UNITS // 2
DIFFERENCE = 1e-3  # of a variable, for derivatives by it


def with_changed_material(assumed: Simulator, change: Array) -> Simulator:
    """The simulator of a changed material (3); nu and the weight stay within their bounds."""
    if not change.any():
        return assumed
    modulus, ratio, weights = _changed_values(assumed.material, change)
    learned = tuple(weights.tolist()) if weights.any() else ()
    changed = replace(
        assumed.material, youngs_modulus=float(modulus), poissons_ratio=float(ratio), energy_weights=learned
    )
    return assumed.with_material(changed)


def _changed_values(assumed: Material, change: Array) -> tuple[Array, Array, Array]:
    """Young's moduli [Pa], (..), Poisson's ratios, (..), and weights, (.., UNITS), of changes (.., 3) of a material."""
    modulus = assumed.youngs_modulus * np.exp(change[..., 0])
    gap = POISSON.variable(assumed.poissons_ratio)
    low, high = POISSON.bounds
    ratio = POISSON.value(np.clip(gap + change[..., 1], min(gap, low), max(gap, high)))
    weights = np.zeros((*change.shape[:-1], UNITS))
    if assumed.energy_weights:
        weights += assumed.energy_weights
    largest = 1.0 - MIN_LAW_SHARE
    weights[..., TENSION_UNIT] += np.clip(change[..., 2], 0.0, largest)
    weights[..., COMPRESSION_UNIT] += np.clip(-change[..., 2], 0.0, largest)
    return modulus, ratio, weights


def material_loads(assumed: Simulator, change: Array, q: Array) -> Array:
    """Nodal forces that act as further changes of the material do, at node positions q (N, 3) [N], (N, 3, 3).

    By central differences of the internal forces.
    """
    steps = DIFFERENCE * np.eye(len(change))
    modulus, ratio, weights = _changed_values(assumed.material, change + np.concatenate([-steps, steps]))
    tried = assumed.parameters(youngs_modulus=modulus, poissons_ratio=ratio, energy_weights=weights)
    gradient = assumed.elastic_gradient(np.repeat(q[None], 2 * len(change), axis=0), tried)
    before, later = np.split(gradient, 2)
    loads: Array = np.moveaxis(before - later, 0, -1) / (2.0 * DIFFERENCE)
    return loads

"""A specimen's material where it is not the assumed one: what the shape of a loaded body tells of it.

Three numbers change the material: log E; log(1/2 - nu); and a weight that moves its law at large strains to either side
of the assumed one, towards more stress in tension or more in compression. A law with the same E and nu bends a body to
another shape by some per cent of the deflection, which virtual forces would take for a sideways pull.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rafl.capture.registration.first_frame import FirstFrame
from rafl.fem.learned.energy import KINDS, MIN_LAW_SHARE, SCALES, UNITS
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
    material = assumed.material
    modulus = material.youngs_modulus * float(np.exp(change[0]))
    gap = POISSON.variable(material.poissons_ratio)
    low, high = POISSON.bounds
    ratio = float(POISSON.value(np.clip(gap + change[1], min(gap, low), max(gap, high))))
    weights = np.zeros(UNITS) if not material.energy_weights else np.array(material.energy_weights)
    weight = float(np.clip(change[2], MIN_LAW_SHARE - 1.0, 1.0 - MIN_LAW_SHARE))
    weights[TENSION_UNIT if weight > 0.0 else COMPRESSION_UNIT] += abs(weight)
    learned = tuple(weights.tolist()) if weights.any() else ()
    changed = replace(material, youngs_modulus=modulus, poissons_ratio=ratio, energy_weights=learned)
    return assumed.with_material(changed)


def material_loads(assumed: Simulator, change: Array, q: Array) -> Array:
    """Nodal forces that act as further changes of the material do, at node positions q (N, 3) [N], (N, 3, 3).

    By central differences of the internal forces.
    """
    columns = []
    for step in DIFFERENCE * np.eye(len(change)):
        later, before = (
            with_changed_material(assumed, x).elastic_gradient(q[None])[0] for x in (change + step, change - step)
        )
        columns.append((before - later) / (2.0 * DIFFERENCE))
    return np.stack(columns, axis=-1)


def material_slopes(frame: FirstFrame, change: Array, q: Array) -> Array:
    """Derivatives of the measured markers by the change of the material [m], (M', 3, 3).

    Args:
        frame: observation, with the assumed material.
        change: of the material.
        q: equilibrium with the changed material [m], (N, 3).
    """
    simulator = with_changed_material(frame.simulator, change)
    by_change = simulator.solve_tangent(q[None], material_loads(frame.simulator, change, q)[None])[0]
    corners = frame.markers.corner_jacobian(torch.from_numpy(q)).numpy()
    slopes: Array = np.einsum("micj,mcjk->mik", corners, by_change[frame.markers.quad])[frame.measured]
    return slopes

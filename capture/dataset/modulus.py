"""Young's modulus by two independent measurements: the bend under the load, and the frequency of the swing."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import eigh

from rafl.common.errors import SimulationError
from rafl.data.dataset import Trajectory
from rafl.data.markers import Markers
from rafl.data.synthetic import load_force
from rafl.evaluation.oscillation import REST_SHARE, fit_oscillation, most_active_coordinate
from rafl.simulation.simulator import Simulator

Array = NDArray[Any]

LEAST_INDEPENDENT = 1e-10  # share of a function's inertia that is its own
INVERSE_ITERATIONS = 3  # for the first modes; the frequency of a beam then changes by less than 1e-4


@dataclass(frozen=True)
class ModulusEstimates:
    """Young's modulus of one recording; NaN where it cannot be measured.

    Attributes:
        bend: by the bend under the load that was released [Pa]. It is proportional to the load.
        swing: by the frequency of the motion [Pa]. It is proportional to the density and the frame rate squared.
        frequency: of the motion [Hz].
    """

    bend: float
    swing: float
    frequency: float


@dataclass(frozen=True)
class _Swing:
    """A damped oscillation of all markers about where they settle.

    Attributes:
        frequency: with its damping, and without it [Hz].
        settled: positions [m], (M, 3).
        shape: the parts of the motion in phase and out of phase [m], (2, M, 3).
    """

    frequency: float
    undamped_frequency: float
    settled: Array
    shape: Array

    @classmethod
    def of(cls, time: Array, position: Array) -> "_Swing":
        """The oscillation of markers (T, M, 3); its frequencies are NaN where there is none."""
        marker, axis = most_active_coordinate(position)
        found = fit_oscillation(time, position[:, marker, axis])
        frequency = found.frequency if found.frequency * (time[-1] - time[0]) >= 1.0 else np.nan
        last = max(int(REST_SHARE * len(time)), 1)
        if not np.isfinite(frequency):
            return cls(np.nan, np.nan, _mean(position[-last:]), np.zeros((2, *position.shape[1:])))
        undamped = frequency / np.sqrt(1.0 - found.damping**2)
        decay = np.exp(-2.0 * np.pi * found.damping * undamped * time)
        phase = 2.0 * np.pi * frequency * time
        basis = np.column_stack([np.ones_like(time), decay * np.cos(phase), decay * np.sin(phase)])
        parts = np.full((3, *position.shape[1:]), np.nan)
        for m in range(position.shape[1]):
            seen = np.isfinite(position[:, m, 0])
            if seen.sum() > len(parts):
                parts[:, m] = np.linalg.lstsq(basis[seen], position[seen, m], rcond=None)[0]
        return cls(frequency, float(undamped), parts[0], parts[1:])


def estimate_modulus(
    simulator: Simulator, markers: Markers, item: Trajectory, loaded: NDArray[np.int64], load: float
) -> ModulusEstimates:
    """Estimate Young's modulus from one recording, twice. Poisson's ratio is that of the assumed material.

    Deflections are proportional to 1 / E and squared frequencies to E, so one solution with the assumed material gives
    both. Deflections are compared with those of the tangent stiffness, in the mean of the bent and the settled shape;
    frequencies with the mode that moves the markers alike.

    Args:
        simulator: with the assumed material.
        markers: embedded in its mesh.
        item: the recording.
        loaded: nodes on which the load hung, (L).
        load: released from the specimen at rest [kg]; 0 if there was none.
    """
    seen = item.valid.any(axis=0)
    swing = _Swing.of(item.time, item.markers[:, seen])
    tracked = markers.select(np.flatnonzero(seen))
    assumed = simulator.material.youngs_modulus
    settled = _settled_shape(simulator, item)
    modulus = {"bend": np.nan, "swing": np.nan}
    if load > 0.0:
        force = load_force(simulator, loaded, load)
        shapes = [simulator.solve_tangent(q[None], force[None])[0] for q in (item.q, settled)]
        expected = _marker_motion(tracked, settled, np.mean(shapes, axis=0)[..., None])[..., 0]
        measured = tracked.positions(torch.from_numpy(item.q)).numpy() - swing.settled
        known = np.isfinite(measured)
        share = float((expected[known] * measured[known]).sum() / (expected[known] ** 2).sum())
        modulus["bend"] = assumed / share if share > 0.0 else np.nan
    if np.isfinite(swing.frequency):
        squared, modes = _first_modes(simulator, settled, simulator.node_mass + item.added_mass)
        by_mode = _marker_motion(tracked, settled, modes)
        known = np.isfinite(swing.shape).all(axis=(0, 2))
        moved, found = by_mode[known], swing.shape[:, known]
        likeness = (np.einsum("pmi,mik->pk", found, moved) ** 2).sum(axis=0) / (moved**2).sum(axis=(0, 1))
        own = float(squared[int(np.argmax(likeness))])
        modulus["swing"] = assumed * (2.0 * np.pi * swing.undamped_frequency) ** 2 / own
    return ModulusEstimates(modulus["bend"], modulus["swing"], swing.frequency)


def _settled_shape(simulator: Simulator, item: Trajectory) -> Array:
    """Equilibrium [m], (N, 3), under the weight and the hanging load; undeformed if they are too large for one."""
    try:
        shape: Array = simulator.equilibrium((simulator.weight + item.load)[None], label="settled shape")[0]
    except SimulationError:
        shape = simulator.mesh.vertices
    return shape


def _first_modes(simulator: Simulator, q: Array, mass: Array) -> tuple[Array, Array]:
    """Squared angular frequencies [1/s^2], (K), and shapes (N, 3, K) of the first modes about q (N, 3).

    Inverse iteration starts with body forces that are constant or linear in the position, and so with the first
    bending, torsion and stretching modes; Rayleigh's and Ritz's method separates them.
    """
    centred = q - q.mean(axis=0)
    functions = np.column_stack([np.ones(len(q)), centred / np.abs(centred).max()])
    shapes = np.einsum("nf,ij->nifj", functions, np.eye(3)).reshape(len(q), 3, -1)
    weight = mass[:, None, None]
    for _ in range(INVERSE_ITERATIONS):
        force = weight * shapes
        solved = simulator.solve_tangent(q[None], force[None])[0]
        columns = solved.reshape(-1, solved.shape[-1])
        stiffness, inertia = (
            columns.T @ force.reshape(columns.shape),
            columns.T @ (weight * solved).reshape(columns.shape),
        )
        # Of a mesh of few nodes some functions are alike, or nearly so.
        size, directions = eigh(inertia / np.sqrt(np.outer(inertia.diagonal(), inertia.diagonal())))
        independent = directions[:, size > LEAST_INDEPENDENT] / np.sqrt(size[size > LEAST_INDEPENDENT])
        independent /= np.sqrt(inertia.diagonal())[:, None]
        squared, mixture = eigh(independent.T @ (0.5 * (stiffness + stiffness.T)) @ independent)
        shapes = (columns @ independent @ mixture).reshape(*solved.shape[:2], -1)
    return squared, shapes


def _marker_motion(markers: Markers, q: Array, motion: Array) -> Array:
    """Displacements of the markers, (M, 3, K), by displacements of the nodes (N, 3, K) from q (N, 3)."""
    by_corner = markers.corner_jacobian(torch.from_numpy(q)).numpy()
    moved: Array = np.einsum("micj,mcjk->mik", by_corner, motion[markers.quad])
    return moved


def _mean(position: Array) -> Array:
    """Mean over the frames in which a marker is seen, (M, 3); NaN if it is in none."""
    count = np.isfinite(position).sum(axis=0)
    return np.where(count > 0, np.nansum(position, axis=0) / np.maximum(count, 1), np.nan)

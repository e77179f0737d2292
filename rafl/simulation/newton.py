"""Newton's method for one implicit step or one static equilibrium of a batch of bodies."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.common.errors import SimulationError
from rafl.fem.constitutive_state import ConstitutiveState
from rafl.simulation.engine import Engine
from rafl.simulation.line_search import accept_trials, evaluate_start, trial_positions
from rafl.solvers.linear import Factors

Array = NDArray[Any]

MAX_STEP_EDGE_CHANGE = 0.3  # rest edge lengths per step; a longer step may snap through to another equilibrium
MAX_EDGE_CHANGE = 30.0  # rest edge lengths; a solution that exceeds it is rejected
RESIDUAL_TOLERANCE = 1e-10  # largest residual component at convergence [N]
POSITION_ROUNDING = 8.0 * np.finfo(float).eps  # relative rounding error allowed for in positions
MAX_ITERATIONS = 200
MAX_LINE_SEARCH_TRIALS = 40
PROJECTION_SHARES = (0.02, 0.1, 0.4, 1.0)  # shares of the projected tangent to try if the exact one is indefinite


def minimise(
    engine: Engine,
    start: Array,
    inertia: Array,
    target: Array,
    force: Array,
    state: ConstitutiveState,
    label: str = "step",
    factors: Factors | None = None,
    max_iterations: int = MAX_ITERATIONS,
) -> Array:
    """Positions minimising sum inertia/2 |q - target|^2 - force . q + energy of the body.

    Each trajectory of the batch converges on its own: to a residual of 1e-10 N, or to the residual that rounding of
    the positions causes, if larger. A factor is reused as long as it contracts the residual fast enough. A new factor
    is that of the exact tangent at the current positions. If that tangent is indefinite, the smallest sufficient share
    of its positive semi-definite projection replaces it. The step is then shortened until the energy falls.

    Args:
        engine: energy, derivatives and linear solves.
        start: first guess, with the fixed nodes at their final positions [m], (B, N, 3).
        inertia: [kg/s^2], (B, N); zero for a static equilibrium.
        target: [m], (B, N, 3).
        force: nodal forces [N], (B, N, 3).
        state: moduli and damping history of each trajectory.
        label: name of the solve in error messages.
        factors: those of the previous step; reused and replaced.
        max_iterations: of a search; a second one without a limit on the step follows the first.

    Returns:
        Positions [m], (B, N, 3).

    Raises:
        SimulationError: no convergence; names trajectory, residual and remedies.
    """
    factors = factors or engine.allocate(len(start))
    problem = (engine, start, inertia, target, force, state, label, factors, max_iterations)
    try:
        found = _minimise(*problem, MAX_STEP_EDGE_CHANGE)
    except SimulationError:
        found = _minimise(*problem, np.inf)  # from a strongly compressed start only a long step leads out
    displacement = found - engine.mesh.vertices
    if (engine.mesh.max_edge_change_bound(np.abs(displacement).max(axis=(1, 2))) < MAX_EDGE_CHANGE).all():
        return found
    change = engine.mesh.max_edge_change(displacement)
    if not (change < MAX_EDGE_CHANGE).all():
        raise SimulationError(
            f"{label}: trajectory {int(np.argmax(change))} is torn apart (an edge changed by {change.max():.3g} times "
            "its rest length); check that the forces belong to this body"
        )
    return found


def _minimise(
    engine: Engine,
    start: Array,
    inertia: Array,
    target: Array,
    force: Array,
    state: ConstitutiveState,
    label: str,
    factors: Factors,
    max_iterations: int,
    max_change: float,
) -> Array:
    """`minimise` with steps that change no edge by more than `max_change` times its rest length."""
    batch, shape = len(start), start.shape[1:]
    free = engine.free_index
    diagonal = np.take(np.repeat(inertia, 3, axis=1), free, axis=1)
    loads = (free, diagonal, *(np.take(x.reshape(batch, -1), free, axis=1) for x in (target, force)))
    q = start.reshape(batch, -1).copy()
    max_stiffness = engine.quadrature.max_rest_stiffness(state.moduli)
    position_error = POSITION_ROUNDING * np.abs(q).max(axis=1)  # [m]
    tolerance = np.maximum(RESIDUAL_TOLERANCE, max_stiffness * position_error)
    placed = engine.place(state)
    energy, largest, residual = np.empty(batch), np.empty(batch), np.empty_like(diagonal)

    def elastic(rows: Array, at: Array) -> tuple[Array, Array]:
        """Elastic energy (P) and its derivative (P, N, 3) at positions (P, 3 N)."""
        own = placed if len(rows) == batch else placed.select(rows)
        return engine.evaluate(at.reshape(-1, *shape), own, tangent=False)[:2]

    evaluate_start(q, *elastic(np.arange(batch), q), *loads, energy, residual, largest)
    for _ in range(max_iterations):
        running = np.flatnonzero(~(largest <= tolerance))
        if not len(running):
            return q.reshape(start.shape)
        if not np.isfinite(largest[running]).all():
            break
        reused = factors.ready[running]
        new = running[~reused]
        if len(new):
            at = q[new].reshape(-1, *shape)
            own = placed if len(new) == batch else placed.select(new)
            _factor(engine, at, own, max_stiffness[new], factors, new, diagonal[new], label, largest[new])
        right = residual[running]
        step = -engine.solve(factors, running, right[:, None])[:, 0]
        slope = np.einsum("ij,ij->i", step, right)
        length = np.ones(len(running))
        far = np.flatnonzero(engine.mesh.max_edge_change_bound(np.abs(step).max(axis=1)) > max_change)
        if len(far):
            change = engine.mesh.max_edge_change(_nodal(step[far], free, q.shape[1]))
            length[far] = np.minimum(1.0, max_change / np.maximum(change, 1e-300))
        for _ in range(MAX_LINE_SEARCH_TRIALS):
            trial = trial_positions(q, running, free, step, length)
            again = accept_trials(
                trial,
                *elastic(running, trial),
                running,
                reused,
                length,
                slope,
                *loads,
                max_stiffness,
                position_error,
                tolerance,
                engine.factorisation_cost,
                q,
                energy,
                residual,
                largest,
                factors.ready,
            )
            if not again.any():
                break
            running, reused, step, slope, length = (x[again] for x in (running, reused, step, slope, 0.5 * length))
        else:
            break
    failed = np.flatnonzero(~(largest <= tolerance))
    if not len(failed):
        return q.reshape(start.shape)
    worst = failed[np.argmax(np.where(np.isfinite(largest[failed]), largest[failed], np.inf))]
    raise SimulationError(
        f"{label}: trajectory {worst} did not converge (residual {largest[worst]:.3g} N, "
        f"limit {tolerance[worst]:.0e} N); try a smaller time step, more substeps or a smaller load"
    )


def _nodal(step: Array, free: Array, unknowns: int) -> Array:
    """Nodal displacements (R, N, 3) of steps of the unknowns (R, n)."""
    full = np.zeros((len(step), unknowns))
    full[:, free] = step
    return full.reshape(len(step), -1, 3)


def _factor(
    engine: Engine,
    q: Array,
    state: ConstitutiveState,
    max_stiffness: Array,
    factors: Factors,
    rows: Array,
    diagonal: Array,
    label: str,
    largest: Array,
) -> None:
    """Factor the tangents at q into `rows` of the storage, made positive definite where needed."""
    _, _, tangents = engine.evaluate(q, state, tangent=True)
    left = np.flatnonzero(~engine.factor(factors, rows, tangents, diagonal))
    if not len(left):
        return
    # Use the smallest sufficient share: the projected tangent is far too stiff in the direction of buckling.
    exact = tangents[left]
    _, _, projected = engine.evaluate(q[left], state.select(left), tangent=True, project=True)
    shift = 1e-9 * max_stiffness[left, None]
    for share in PROJECTION_SHARES:
        mixed = exact + share * (projected - exact)
        failed = ~engine.factor(factors, rows[left], mixed, diagonal[left] + shift)
        if not failed.any():
            return
        exact, projected, shift, left = exact[failed], projected[failed], shift[failed], left[failed]
    worst = left[0]
    raise SimulationError(
        f"{label}: trajectory {rows[worst]}: the tangent cannot be factored (residual "
        f"{largest[worst]:.3g} N); fix more nodes or check the material"
    )

"""Newton's method for one implicit step or one static equilibrium of a batch of bodies."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.common.errors import SimulationError
from rafl.fem.constitutive_state import Resistance
from rafl.simulation.engine import Engine
from rafl.simulation.line_search import begin, judge, moved
from rafl.solvers.linear import Factors

Array = NDArray[Any]

LONGEST = 0.3  # of an edge: what one step may change it by, lest the body snap through to another equilibrium
TORN = 30.0  # of an edge: what nobody need try to follow
TOLERANCE = 1e-10  # largest nodal residual accepted [N]
ROUNDING = 8.0 * np.finfo(float).eps  # relative error allowed for in positions
MAX_ITERATIONS = 200
PROJECTED = (0.02, 0.1, 0.4, 1.0)  # shares of the projection tried where the exact tangent is indefinite


def minimise(
    engine: Engine,
    start: Array,
    inertia: Array,
    target: Array,
    force: Array,
    resistance: Resistance,
    what: str = "step",
    factors: Factors | None = None,
) -> Array:
    """Positions minimising sum inertia/2 |q - target|^2 - force . q + the body's energy.

    Each trajectory of the batch goes its own way to a residual of 1e-10 N, or to what rounding of the
    positions alone makes where that is more. A factor is used again while it contracts well enough to be
    worth it. A new one is made of the exact tangent where the iterate then is, with as much of its positive
    semi-definite projection as makes it definite, and its step is shortened until the energy falls.

    Args:
        engine: the arithmetic.
        start: first guess, held nodes where they shall be [m], (B, N, 3).
        inertia: [kg/s^2], (B, N); zero for a static equilibrium.
        target: [m], (B, N, 3).
        force: nodal forces [N], (B, N, 3).
        resistance: of each trajectory.
        what: named in the error.
        factors: those of the step before; used and replaced.

    Returns:
        Positions [m], (B, N, 3).

    Raises:
        SimulationError: no convergence; names trajectory, residual and what to try.
    """
    problem = (engine, start, inertia, target, force, resistance, what, factors or engine.allocate(len(start)))
    try:
        found = _descend(*problem, LONGEST)
    except SimulationError:
        found = _descend(*problem, np.inf)  # from a start so squeezed that only a leap leads out
    moved = found - engine.mesh.vertices
    if (engine.mesh.stretching_at_most(np.abs(moved).max(axis=(1, 2))) < TORN).all():
        return found
    torn = engine.mesh.stretching(moved)
    if not (torn < TORN).all():
        raise SimulationError(
            f"{what}: trajectory {int(np.argmax(torn))} is torn apart (an edge changed by {torn.max():.3g} times its "
            "length); the forces are not those of this body"
        )
    return found


def _descend(
    engine: Engine,
    start: Array,
    inertia: Array,
    target: Array,
    force: Array,
    resistance: Resistance,
    what: str,
    factors: Factors,
    longest: float,
) -> Array:
    """`minimise` with steps that change no edge by more than `longest` times its length."""
    batch, shape = len(start), start.shape[1:]
    free = engine.free_index
    diagonal = np.take(np.repeat(inertia, 3, axis=1), free, axis=1)
    pulls = (free, diagonal, *(np.take(x.reshape(batch, -1), free, axis=1) for x in (target, force)))
    q = start.reshape(batch, -1).copy()
    stiffest = engine.integration.stiffest(resistance.moduli)
    reach = ROUNDING * np.abs(q).max(axis=1)  # what rounding does to positions [m]
    enough = np.maximum(TOLERANCE, stiffest * reach)
    energy, largest, residual = np.empty(batch), np.empty(batch), np.empty_like(diagonal)

    def elastic(rows: Array, at: Array) -> tuple[Array, Array]:
        """Elastic energy (P) and its derivative (P, N, 3) of positions (P, 3 N)."""
        resisting = resistance if len(rows) == batch else resistance.rows(rows)
        return engine.terms(at.reshape(-1, *shape), resisting, tangent=False)[:2]

    begin(q, *elastic(np.arange(batch), q), *pulls, energy, residual, largest)
    for _ in range(MAX_ITERATIONS):
        running = np.flatnonzero(~(largest <= enough))
        if not len(running):
            return q.reshape(start.shape)
        if not np.isfinite(largest[running]).all():
            break
        old = factors.ready[running]
        new = running[~old]
        if len(new):
            at = q[new].reshape(-1, *shape)
            _factor(engine, at, resistance.rows(new), factors, new, diagonal[new], what, largest[new])
        down = residual[running]
        step = -engine.solve(factors, running, down[:, None])[:, 0]
        slope = np.einsum("ij,ij->i", step, down)
        length = np.ones(len(running))
        far = np.flatnonzero(engine.mesh.stretching_at_most(np.abs(step).max(axis=1)) > longest)
        if len(far):
            change = engine.mesh.stretching(_scattered(step[far], free, q.shape[1]))
            length[far] = np.minimum(1.0, longest / np.maximum(change, 1e-300))
        for _ in range(40):
            trial = moved(q, running, free, step, length)
            again = judge(
                trial,
                *elastic(running, trial),
                running,
                old,
                length,
                slope,
                *pulls,
                stiffest,
                reach,
                enough,
                engine.patience,
                q,
                energy,
                residual,
                largest,
                factors.ready,
            )
            if not again.any():
                break
            running, old, step, slope, length = (x[again] for x in (running, old, step, slope, 0.5 * length))
        else:
            break
    open_ = np.flatnonzero(~(largest <= enough))
    if not len(open_):
        return q.reshape(start.shape)
    worst = open_[np.argmax(np.where(np.isfinite(largest[open_]), largest[open_], np.inf))]
    raise SimulationError(
        f"{what}: trajectory {worst} did not converge (residual {largest[worst]:.3g} N, "
        f"wanted {enough[worst]:.0e} N); try a smaller time step, more substeps or a smaller load"
    )


def _scattered(step: Array, free: Array, unknowns: int) -> Array:
    """Displacements (R, N, 3) of steps (R, n)."""
    full = np.zeros((len(step), unknowns))
    full[:, free] = step
    return full.reshape(len(step), -1, 3)


def _factor(
    engine: Engine,
    q: Array,
    resistance: Resistance,
    factors: Factors,
    rows: Array,
    diagonal: Array,
    what: str,
    largest: Array,
) -> None:
    _, _, tangents = engine.terms(q, resistance, tangent=True)
    left = np.flatnonzero(~engine.factor(factors, rows, tangents, diagonal))
    if not len(left):
        return
    # As little of the projection as will do: it is far too stiff in the direction the body buckles.
    exact = tangents[left]
    _, _, projected = engine.terms(q[left], resistance.rows(left), tangent=True, project=True)
    shift = 1e-9 * engine.integration.stiffest(resistance.moduli[left])[:, None]
    for share in PROJECTED:
        mixed = exact + share * (projected - exact)
        failed = ~engine.factor(factors, rows[left], mixed, diagonal[left] + shift)
        if not failed.any():
            return
        exact, projected, shift, left = exact[failed], projected[failed], shift[failed], left[failed]
    worst = left[0]
    raise SimulationError(
        f"{what}: trajectory {rows[worst]}: the tangent cannot be factored (residual "
        f"{largest[worst]:.3g} N); hold more nodes or check the material"
    )

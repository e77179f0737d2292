"""Newton's method for one implicit step or one static equilibrium of a batch of bodies."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rafl.engine import Engine
from rafl.errors import SimulationError
from rafl.linear import Factors
from rafl.resistance import Resistance

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
    engine: Engine, start: Array, inertia: Array, target: Array, force: Array, resistance: Resistance, what: str,
    factors: Factors, longest: float,
) -> Array:  # fmt: skip
    """`minimise` with steps that change no edge by more than `longest` times its length."""
    batch, shape = len(start), start.shape[1:]
    free = engine.free_index
    diagonal = np.repeat(inertia, 3, axis=1)[:, free]
    wanted, load = target.reshape(batch, -1)[:, free], force.reshape(batch, -1)[:, free]
    q = start.reshape(batch, -1).copy()

    def objective(rows: Array, at: Array) -> tuple[Array, Array, Array]:
        """Energy, the size of its parts, and the residual (R, n) of positions (R, 3 N)."""
        whole = len(rows) == batch
        some = slice(None) if whole else rows
        resisting = resistance if whole else resistance.rows(rows)
        elastic, gradient, _ = engine.terms(at.reshape(-1, *shape), resisting, tangent=False)
        x, pushed = at[:, free], load[some]
        gap = x - wanted[some]
        pull = diagonal[some] * gap
        inertial, work = 0.5 * _dot(pull, gap), _dot(pushed, x)
        residual = gradient.reshape(len(rows), -1)[:, free] + pull - pushed
        return elastic + inertial - work, np.abs(elastic) + inertial + np.abs(work), residual

    stiffest = engine.integration.stiffest(resistance.moduli)
    reach = ROUNDING * np.abs(q).max(axis=1)  # what rounding does to positions [m]
    energy, _, residual = objective(np.arange(batch), q)
    largest = np.abs(residual).max(axis=1)
    enough = np.maximum(TOLERANCE, stiffest * reach)
    for _ in range(MAX_ITERATIONS):
        running = np.flatnonzero(~(largest <= enough))
        if not len(running):
            return q.reshape(start.shape)
        if not np.isfinite(largest[running]).all():
            break
        stale = factors.ready[running]
        new = running[~stale]
        if len(new):
            at = q[new].reshape(-1, *shape)
            _factor(engine, at, resistance.rows(new), factors, new, diagonal[new], what, largest[new])
        step = -engine.solve(factors, running, residual[running][:, None])[:, 0]
        slope = _dot(step, residual[running])
        length = np.ones(len(running))
        far = np.flatnonzero(engine.mesh.stretching_at_most(np.abs(step).max(axis=1)) > longest)
        if len(far):
            change = engine.mesh.stretching(_scattered(step[far], free, q.shape[1]))
            length[far] = np.minimum(1.0, longest / np.maximum(change, 1e-300))
        pending = np.arange(len(running))
        for _ in range(40):
            rows = running[pending]
            trial = q[rows]
            trial[:, free] += length[pending, None] * step[pending]
            e, parts, r = objective(rows, trial)
            size = np.abs(r).max(axis=1)
            # Close to the minimum energies differ by rounding only: the residual decides there.
            slack = 1e-13 * parts + 10.0 * reach[rows] * np.sqrt(stiffest[rows] * parts)
            level = e <= energy[rows] + slack
            old = stale[pending]
            accepted = np.where(
                old,
                level & (size <= 0.5 * largest[rows]),
                (e <= energy[rows] + 1e-4 * length[pending] * slope[pending]) | (level & (size < largest[rows])),
            )
            good = rows[accepted]
            factors.ready[good] = _worth_keeping(size[accepted] / largest[good], size[accepted] / enough[good], engine)
            q[good], energy[good] = trial[accepted], e[accepted]
            residual[good], largest[good] = r[accepted], size[accepted]
            factors.ready[rows[old & ~accepted]] = False
            pending = pending[~accepted & ~old]
            if not len(pending):
                break
            length[pending] *= 0.5
        if len(pending):
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


def _dot(a: Array, b: Array) -> Array:
    """Row by row, (R)."""
    return np.einsum("ij,ij->i", a, b)


def _worth_keeping(shrinking: Array, left: Array, engine: Engine) -> NDArray[np.bool_]:
    """Whether at this pace the rest takes fewer steps than a new factor costs.

    shrinking: of the residual in the last step, (R); left: residual over what is wanted, (R).
    """
    return np.log(np.maximum(left, 1.0)) <= -engine.patience * np.log(shrinking.clip(1e-300, 1.0))


def _factor(
    engine: Engine, q: Array, resistance: Resistance, factors: Factors, rows: Array, diagonal: Array, what: str,
    largest: Array,
) -> None:  # fmt: skip
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

"""The first frame: static equilibrium under virtual forces that puts the markers where they were seen."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rafl.capture.registration.rigid import IDENTITY, Rigid

from rafl.common.errors import SimulationError
from rafl.data.markers import Markers
from rafl.simulation.simulator import Simulator

Array = NDArray[Any]

# Prior standard deviations of a nodal force [N]: of the part that varies linearly over the loaded
# nodes (a pull and a moment), and of the rest, which would dent the mesh to please single markers:
# first none of it, then little, then more where that halves what is left.
LINEAR_SIGMA, LOCAL_SIGMAS = 1.0, (1e-5, 5e-3, 5e-2)
SURFACE_SIGMA = 0.3  # of every force, where forces act all over the surface
FIRST_DAMPING, LAST_DAMPING = 1e4, 1e16  # of a step, as a multiple of the prior
MOST_STEPS = 100
QUICK = 60.0  # 1/s: forces change as in an oscillation of about 10 Hz
CONVERGED, ENOUGH = 1e-4, 1e-3  # the search ends where a step promises or brings less, of the objective and at all
UNOBSERVED = 10.0  # times the median sigma: an axis that no camera saw


@dataclass(frozen=True)
class FirstFrame:
    """What was seen of the first frame.

    Attributes:
        simulator: of the specimen.
        markers: tied to its mesh.
        nodes: that virtual forces act on, (L).
        target: markers [m], (M, 3), NaN where not seen.
        sigma: their standard deviation [m], (M, 3); where the pose is sought, alike along all axes.
        what: recording, for messages.
        everywhere: whether the nodes are the whole surface, on each of which a force of its own may act.
    """

    simulator: Simulator
    markers: Markers
    nodes: NDArray[np.int64]
    target: Array
    sigma: Array
    what: str
    everywhere: bool = False

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Which markers were, (M)."""
        return np.isfinite(self.target[:, 0])

    @property
    def observed(self) -> NDArray[np.bool_]:
        """Which coordinates of the seen markers some camera saw, (M', 3)."""
        sigma = self.sigma[self.seen]
        return sigma < UNOBSERVED * np.median(sigma)


@dataclass(frozen=True)
class InitialState:
    """Where the mesh was in the first frame.

    Attributes:
        q: [m], (N, 3).
        force: virtual nodal forces, gravity excepted [N], (N, 3).
        residual: root mean square marker distance over the observed axes [m].
        pose: from the frame of the target to the specimen frame; the identity where it was not sought.
    """

    q: Array
    force: Array
    residual: float
    pose: Rigid


def fit_first_frame(frame: FirstFrame, pose: Rigid | None = None) -> InitialState:
    """Virtual forces on some nodes such that the equilibrium's markers match the first frame.

    Levenberg-Marquardt on sum |x(q(f)) - target|^2 / sigma^2 + f . C^-1 f with C the prior of the forces;
    the Jacobian through the equilibrium is the implicit-function theorem's, dx/df = dx/dq K^-1.

    A mesh is not the specimen. At the free end first only forces that vary linearly over the nodes are sought; what
    they leave beyond sigma is added to sigma, lest the mesh be dented to please markers that it cannot meet.

    Args:
        frame: what was seen.
        pose: where the specimen frame is sought too, a first guess of it.

    Raises:
        SimulationError: an equilibrium could not be found.
    """
    posed, force = pose is not None, np.zeros_like(frame.simulator.mesh.vertices)
    if frame.everywhere:
        last = _Search(frame, posed, SURFACE_SIGMA, 0.0).descend(force, pose or IDENTITY, None)
    else:
        none, little, more = LOCAL_SIGMAS
        first = _Search(frame, posed, none, 0.0).descend(force, pose or IDENTITY, None)
        own = frame.sigma[frame.seen][frame.observed]
        beyond = np.sqrt(max(_size(frame, first.gap) ** 2 - float((own**2).mean()), 0.0))
        last = _Search(frame, posed, little, beyond).descend(first.force, first.pose, first.q)
        trial = _Search(frame, posed, more, beyond).descend(last.force, last.pose, last.q)
        last = trial if _size(frame, trial.gap) < 0.5 * _size(frame, last.gap) else last
    return InitialState(last.q, last.force, np.sqrt(3.0) * _size(frame, last.gap), last.pose)


def _size(frame: FirstFrame, gap: Array) -> float:
    """Root mean square of the gaps (3 M') along observed axes [m]."""
    return float(np.sqrt((gap.reshape(-1, 3)[frame.observed] ** 2).mean()))


@dataclass(frozen=True)
class _State:
    force: Array
    pose: Rigid
    q: Array
    gap: Array  # (3 M'): of the mesh's markers from the seen ones [m]
    objective: float


class _Search:
    """One descent: with or without the pose, one prior, one size of what the mesh cannot meet."""

    def __init__(self, frame: FirstFrame, posed: bool, local: float, beyond: float) -> None:
        self.frame, self.posed = frame, posed
        precision = force_precision(frame.simulator.mesh.vertices[frame.nodes], local)
        self.prior = np.kron(precision, np.eye(3))
        self.weight = 1.0 / np.sqrt(frame.sigma[frame.seen].ravel() ** 2 + beyond**2)

    def state(self, force: Array, pose: Rigid, start: Array | None) -> _State:
        frame, simulator = self.frame, self.frame.simulator
        total, what = (simulator.weight + force)[None], f"{frame.what}: first frame"
        if start is None:
            q = simulator.equilibrium(total, what=what)[0]
        else:  # a step too far is to fail at once, not to be led there in small ones
            none = np.zeros(total.shape[:2])
            q = simulator.minimise(start[None], none, start[None], total, simulator.resistance(1), what)[0]
        own = frame.markers.positions(torch.from_numpy(q)).numpy()[frame.seen]
        gap = (own - pose.apply(frame.target[frame.seen])).ravel()
        at = force[frame.nodes].ravel()
        return _State(force, pose, q, gap, float(((self.weight * gap) ** 2).sum() + at @ self.prior @ at))

    def descend(self, force: Array, pose: Rigid, start: Array | None) -> _State:
        """From some forces and pose to the best."""
        now = self.state(force, pose, start)
        damping, growth = FIRST_DAMPING, 2.0  # after H. B. Nielsen
        for _ in range(MOST_STEPS):
            right, normal = self._normal_equations(now)
            if right @ np.linalg.solve(normal, right) < CONVERGED * now.objective + ENOUGH:
                break
            held, fall = self._held(normal), -np.inf
            while fall <= 0.0 and damping <= LAST_DAMPING:
                step = np.linalg.solve(normal + damping * held, -right)
                try:
                    new = self._moved(now, step)
                except SimulationError:  # too far at once: damped more, the next trial is nearer
                    fall = -np.inf
                else:
                    fall = now.objective - new.objective
                if fall > 0.0:
                    hoped = -float(step @ (2.0 * right + normal @ step))
                    damping, growth = damping * max(1.0 / 3.0, 1.0 - (2.0 * fall / hoped - 1.0) ** 3), 2.0
                else:
                    damping, growth = damping * growth, 2.0 * growth
            if fall <= 0.0:
                break
            now = new
            if fall < CONVERGED * now.objective + ENOUGH:
                break
        return now

    def _normal_equations(self, now: _State) -> tuple[Array, Array]:
        """Half the objective's gradient by forces (3 L) and pose (6, where it is sought), and half its curvature."""
        slopes = marker_slopes(self.frame, now.q)
        if self.posed:
            posed = now.pose.apply(self.frame.target[self.frame.seen])
            slopes = np.concatenate([slopes, -_pose_slopes(posed)], axis=1)
        slopes *= self.weight[:, None]
        right, normal = slopes.T @ (self.weight * now.gap), slopes.T @ slopes
        count = len(self.prior)
        right[:count] += self.prior @ now.force[self.frame.nodes].ravel()
        normal[:count, :count] += self.prior
        return right, normal

    def _held(self, normal: Array) -> Array:
        """What damping multiplies: the prior; of the pose, which has none, a little of its curvature."""
        held, count = np.diag(1e-6 * np.diag(normal)), len(self.prior)
        held[:count, :count] = self.prior
        return held

    def _moved(self, now: _State, step: Array) -> _State:
        force, count = now.force.copy(), len(self.prior)
        force[self.frame.nodes] += step[:count].reshape(-1, 3)
        return self.state(force, now.pose.moved(step[count:]) if self.posed else now.pose, now.q)


def fit_velocity(frame: FirstFrame, q: Array, velocity: Array, sigma: Array) -> Array:
    """Velocities of the mesh [m/s], (N, 3), that give the markers theirs, as changing virtual forces would.

    Args:
        frame: what was seen, and the nodes that forces act on.
        q: the mesh in the first frame [m], (N, 3).
        velocity, sigma: of the markers and their standard deviations [m/s], (M, 3); NaN and infinite where not known.
    """
    slopes = marker_slopes(frame, q)
    known = np.isfinite(velocity[frame.seen]).ravel() & np.isfinite(sigma[frame.seen]).ravel()
    weight = 1.0 / sigma[frame.seen].ravel()[known]
    own = weight[:, None] * slopes[known]
    local = SURFACE_SIGMA if frame.everywhere else LOCAL_SIGMAS[1]
    prior = np.kron(force_precision(frame.simulator.mesh.vertices[frame.nodes], local), np.eye(3)) / QUICK**2
    right = own.T @ (weight * velocity[frame.seen].ravel()[known])
    change = np.zeros_like(q)
    change[frame.nodes] = np.linalg.solve(own.T @ own + prior, right).reshape(-1, 3)
    return frame.simulator.solve_tangent(q[None], change[None])[0]


def force_precision(places: Array, local: float) -> Array:
    """Inverse prior covariance of one component of the forces on nodes at `places` (L, 3), (L, L)."""
    modes = np.column_stack([np.ones(len(places)), (places - places.mean(0)) / np.ptp(places, axis=0).max()])
    u, s, _ = np.linalg.svd(modes, full_matrices=False)
    u = u[:, s > 1e-9 * s[0]]
    linear = u @ u.T
    return linear / LINEAR_SIGMA**2 + (np.eye(len(places)) - linear) / local**2


def marker_slopes(frame: FirstFrame, q: Array) -> Array:
    """Derivatives of the seen markers (3 M') by the forces on the nodes (3 L) at equilibrium q [m/N]."""
    seen = np.flatnonzero(frame.seen)
    by_corner = frame.markers.slopes(torch.from_numpy(q)).numpy()[seen]  # (M', 3, 4, 3)
    rows = np.zeros((len(seen), 3, *q.shape))
    for corner in range(4):
        rows[np.arange(len(seen)), :, frame.markers.quad[seen, corner]] += by_corner[:, :, corner]
    solved = frame.simulator.solve_tangent(q[None], np.moveaxis(rows.reshape(-1, *q.shape), 0, -1)[None])[0]
    return np.moveaxis(solved[frame.nodes], -1, 0).reshape(3 * len(seen), -1)


def _pose_slopes(points: Array) -> Array:
    """Derivatives of posed points (3 M') by a turn (3) and a shift (3) that follow the pose."""
    turn = np.cross(np.eye(3)[None], points[:, None]).swapaxes(1, 2)  # (M', 3, axis)
    return np.concatenate([turn, np.broadcast_to(np.eye(3), turn.shape)], axis=2).reshape(-1, 6)

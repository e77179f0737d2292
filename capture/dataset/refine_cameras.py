"""Where the cameras are and how late their clocks are, found from the recordings by the simulated motion.

A camera that was touched after its calibration sees the body turned against its clamp and against gravity. A clock
that is late shows all its frames late. The simulated motion, the markers' places and the material are found with them.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rafl.capture.dataset.registered import Registered
from rafl.capture.registration.camera_change import CLOCK, CameraChange
from rafl.capture.registration.first_frame import FirstFrame
from rafl.capture.registration.material_change import MODULUS_SIGMA
from rafl.capture.specimen.specimen import Specimen
from rafl.common.errors import InputError, SimulationError
from rafl.data.camera_terms import CameraTerm
from rafl.data.dataset import Dataset, Trajectory
from rafl.data.objective import Recordings
from rafl.data.views import at_lags
from rafl.fitting.gauss_newton import bounded_step
from rafl.fitting.material_search import spread_by_size
from rafl.fitting.quantities import METHOD_QUANTITIES, MODULUS, material_values
from rafl.simulation.rollout import rollout

Array = NDArray[Any]

# Prior standard deviations. A tripod that is touched turns by some tenths of a degree; a calibration's own errors are
# smaller. The release is known to the nearest frame.
TURN_SIGMA, SHIFT_SIGMA = np.radians(0.5), 1e-3  # [rad], [m]
CLOCK_SIGMA, RELEASE_SIGMA = 0.5, 0.3  # [frames]
SCALE_SIGMA = 1e-3  # of an image's scale: of a lens whose focus was touched, or of temperature
REFERENCE_SIGMA = 1e-6  # of the first camera's clock, which the others' are told against [frames]
LEAST_PLACE_SIGMA = 1e-7  # of a place that is exactly known [m]
# With one loss factor, a rubber that creeps otherwise settles several pixels away, as if the camera had turned.
QUANTITIES = METHOD_QUANTITIES["sysid-branches"]
RECORDINGS = 2  # of the largest and the least motion; more hardly tell more
FRAME_SHARES = 0.4, 1.0  # a search over many oscillations starts near its end
LINEARISATIONS, STEPS, HALVINGS = 10, 4, 5  # at most; steps of one linearisation, and halvings of one step
SETTLED = 1e-4  # the search ends with a step that promises a smaller decrease of the objective, relative to it
MATERIAL_STEP = 1e-4  # of a variable, for differences
FIRST_FRAME_STEP = 1e-6  # root mean square motion of the nodes, for differences [m]
TIME_STEP = 1e-2  # [frames]
FARTHEST = 100.0  # prior standard deviations that a variable may deviate by
# The squared differences count as if there were fewer of them by this factor, because a dot's error lasts while it
# looks the same. In a rendered film, turns were wrong by 3 to 4 standard deviations of independent errors; with the
# factor, those of two other films by 0.99 (root mean square of 12).
LASTING = 10.0
MAX_LIKENESS = 0.98  # correlation between frames; a larger one is that of few frames


@dataclass(frozen=True)
class Refinement:
    """Changes of the cameras.

    Attributes:
        changes: by camera.
        unexplained: root mean square difference of a coordinate of the pixels that remains, by camera [px].
    """

    changes: dict[str, CameraChange]
    unexplained: dict[str, float]


def require_following_elements(specimen: Specimen) -> None:
    """Raise InputError if the elements lock: their errors would be taken for turned cameras."""
    if specimen.material.integration != "enhanced":
        raise InputError(
            "--refine-cameras: expected elements that follow a bent body, found integration: "
            f"{specimen.material.integration}, whose errors would be taken for turned cameras; use preset: physical in "
            "the specimen file, or leave the option out"
        )


def refine_cameras(
    dataset: Dataset,
    specimen: Specimen,
    registered: list[Registered],
    whole_surface: bool,
) -> Refinement:
    """Find the cameras' changes from the training recordings that start at rest.

    Gauss-Newton minimises the squared differences of the simulated and the measured pixels, robust by Huber's loss, and
    the squared deviations from the priors. Its variables are E, nu and Maxwell branches, the poses and clocks of the
    cameras, the first frame and the time of release of every recording, the places of the markers, and the scales of
    the images, without which a small difference in scale would be taken for a large tilt. The squared differences are
    relative to their mean, times (1 + r) / (1 - r) with their correlation r between frames, and times `LASTING`: errors
    last, and tell less than their number.

    Args:
        dataset: built with the cameras as calibrated.
        specimen: its description.
        registered: recordings of the dataset, with their cameras as calibrated.
        whole_surface: whether virtual forces act on the whole surface.

    Raises:
        InputError: no training recording in a known frame has pixels and starts at rest, or the clamp moves.
        SimulationError: a simulation failed.
    """
    if any(view.rotation is not None for item in registered for view in item.views.values()):
        raise InputError("--refine-cameras: expected a clamp at rest, found one that moves; leave the option out")
    usable = [item for item in registered if item.row.split == "train" and item.views and not item.start.moving]
    usable = [item for item in usable if not item.registration.pose_from_model]
    if not usable:
        raise InputError(
            "--refine-cameras: expected a training recording that starts at rest in the specimen's frame, with the "
            "pixels of its cameras, found none; leave the option out"
        )
    motion = Recordings.of(dataset, [item.row.recording for item in usable]).square_motion
    chosen = [usable[k] for k in spread_by_size(motion, RECORDINGS)]
    search = _Search(dataset, specimen, chosen, whole_surface)
    x = search.begin
    for share in FRAME_SHARES:
        x, covariance = search.minimise(x, share)
    return search.refinement(x, covariance)


class _Search:
    """The search for all variables, in units of the standard deviations of their priors.

    They are those of the material, of every camera (7 and the scale of its image), of every recording (its release and
    D of its first frame), and of the places (3 M).
    """

    def __init__(
        self,
        dataset: Dataset,
        specimen: Specimen,
        chosen: list[Registered],
        whole_surface: bool,
    ) -> None:
        self.dataset, markers = dataset, dataset.markers
        self.recordings = Recordings.of(dataset, [item.row.recording for item in chosen], objective="image")
        still = {name: _at_rest(term, name, chosen) for name, term in self.recordings.terms.items()}
        self.recordings = replace(self.recordings, terms=still)
        self.cameras = list(still)
        self.calibrated = [
            [(item.views.get(name) or next(iter(item.views.values()))).camera for item in chosen]
            for name in self.cameras
        ]
        self.centre = markers.rest.mean(axis=0)
        self.step = dataset.simulator.time_step
        frames = [item.first_frame(dataset, specimen, whole_surface) for item in chosen]
        self.start = np.stack([_start_directions(frame, dataset.trajectories[frame.recording]) for frame in frames])
        moved = np.sqrt((self.start**2).sum(-1).mean(axis=(0, 2)))  # [m] per unit of a direction, (D)
        self.first_steps = FIRST_FRAME_STEP / moved
        first_sigma = np.concatenate([frames[0].resultant_modes()[1], [MODULUS_SIGMA]])
        count, cameras, recordings = len(markers.names), len(self.cameras), len(chosen)
        sizes = [len(QUANTITIES), *[7] * cameras, cameras, recordings, *[len(first_sigma)] * recordings, 3 * count]
        ends = np.cumsum(sizes)
        parts = [slice(end - size, end) for end, size in zip(ends, sizes, strict=True)]
        self.material, self.poses, self.scales, self.releases = (
            parts[0],
            parts[1 : 1 + cameras],
            *parts[-3 - recordings : -1 - recordings],
        )
        self.first_frames, self.places = parts[-1 - recordings : -1], parts[-1]
        one = np.array([TURN_SIGMA] * 3 + [SHIFT_SIGMA] * 3 + [CLOCK_SIGMA * self.step])
        poses = np.tile(one, (cameras, 1))
        poses[0, CLOCK] = REFERENCE_SIGMA * self.step
        places = np.maximum(np.broadcast_to(specimen.layout.sigma, count), LEAST_PLACE_SIGMA)
        self.scale = np.concatenate(
            [
                [quantity.deviation for quantity in QUANTITIES],
                poses.ravel(),
                np.full(cameras, SCALE_SIGMA),
                np.full(recordings, RELEASE_SIGMA * self.step),
                np.tile(first_sigma, recordings),
                np.repeat(places, 3),
            ]
        )
        start, mean = np.zeros((2, ends[-1]))
        start[self.material] = mean[self.material] = self._assumed(chosen)
        mean[self.places] = 0.0 if markers.moved is None else -markers.moved.ravel()
        self.begin, self.mean = start / self.scale, mean / self.scale
        self.low, self.high = np.full((2, len(start)), [[-FARTHEST], [FARTHEST]])
        for k, quantity in enumerate(QUANTITIES):
            self.low[k], self.high[k] = np.array(quantity.bounds) / quantity.deviation

    def _assumed(self, chosen: list[Registered]) -> Array:
        """Variables of the material: E as the swings show it, the others as assumed."""
        assumed = self.dataset.simulator.material
        recordings = [self.dataset.trajectories[item.row.recording] for item in chosen]
        swings = np.array([float(str(item.attributes["swing_modulus"])) for item in recordings])
        values = [max(float(getattr(assumed, q.name, 0.0)), q.low, q.start) for q in QUANTITIES]
        if np.isfinite(swings).any():
            values[QUANTITIES.index(MODULUS)] = float(np.nanmedian(swings))
        return np.array([np.clip(q.variable(v), *q.bounds) for q, v in zip(QUANTITIES, values, strict=True)])

    def minimise(self, x: Array, share: float) -> tuple[Array, Array]:
        """Variables that minimise the objective over a share of the frames, from x (n), and their covariance (n, n).

        The derivatives are kept for several steps: they change slowly, and cost many simulations.
        """
        recordings = self.recordings.first_frames(max(round(share * len(self.recordings.markers)), 2))
        for _ in range(LINEARISATIONS):
            begin, (found, jacobian) = x, self._linearised(recordings, x)
            for _ in range(STEPS):
                variance = found.variance(len(x))
                normal = jacobian.T @ jacobian / variance + np.eye(len(x))
                gradient = jacobian.T @ found.weighted.ravel() / variance + x - self.mean
                step = bounded_step(normal, gradient, self.low - x, self.high - x)
                least = found.objective / variance + float(((x - self.mean) ** 2).sum())
                if -(2.0 * gradient + normal @ step) @ step < SETTLED * least:
                    break
                for _ in range(HALVINGS):
                    trial = self._differences(recordings, x + step)
                    own = trial.objective / variance + float(((x + step - self.mean) ** 2).sum())
                    if own < least:
                        break
                    step *= 0.5
                else:
                    break
                x, found = x + step, trial
            if x is begin:
                break
        return x, np.linalg.inv(normal)

    def refinement(self, x: Array, covariance: Array) -> Refinement:
        """The changes of the cameras at variables x."""
        changes = {}
        for name, own in zip(self.cameras, self.poses, strict=True):
            scale = self.scale[own]
            changes[name] = CameraChange(x[own] * scale, self.centre, scale[:, None] * covariance[own, own] * scale)
        markers, q = self._simulated(self.recordings, x[None])
        placed, unexplained = self._placed(markers[:, 0], self._place_gain(q), x), {}
        terms = self._terms(self.recordings, x)
        for name, term, image_scale in zip(self.cameras, terms, self._scales(x), strict=True):
            gaps = term.gap(self._scaled(placed, image_scale))[term.seen > 0]
            unexplained[name] = float(gaps.square().mean().sqrt())
        return Refinement(changes, unexplained)

    def _simulated(self, recordings: Recordings, sets: Array) -> tuple[Tensor, Tensor]:
        """Markers (T, S, R, M, 3) [m] of sets of variables (S, n) at their places as built, and node positions."""
        values, few = sets * self.scale, len(recordings.names)
        amplitudes = np.stack([values[:, own] for own in self.first_frames], axis=1)  # (S, R, D)
        start = self.dataset.start(recordings.names * len(sets))
        moved = torch.from_numpy(np.einsum("srd,rdni->srni", amplitudes, self.start).reshape(start.q.shape))
        variables = torch.from_numpy(np.repeat(values[:, self.material], few, axis=0))
        material = material_values({q.name: q.value(variables[:, k]) for k, q in enumerate(QUANTITIES)})
        simulator, frames = self.dataset.simulator, len(recordings.markers)
        with torch.no_grad():
            start = replace(start, q=start.q + moved)
            positions, _ = rollout(simulator, start, frames - 1, parameters=simulator.parameters(**material))
            markers = self.dataset.markers.positions(positions)
        return markers.reshape(frames, len(sets), few, *markers.shape[2:]), positions[:, :few]

    def _changes(self, x: Array) -> list[CameraChange]:
        """Changes of the cameras at x."""
        return [CameraChange((x * self.scale)[own], self.centre) for own in self.poses]

    def _terms(self, recordings: Recordings, x: Array) -> list[CameraTerm]:
        """What the cameras measured, as seen with their changes at x and the times of release."""
        late, result = torch.from_numpy((x * self.scale)[self.releases]), []
        for name, change, cameras in zip(self.cameras, self._changes(x), self.calibrated, strict=True):
            term = recordings.terms[name]
            lag = term.lag - (change.value[CLOCK] + late) / self.step
            lag[0] = 0.0  # at rest
            result.append(replace(term, cameras=[change.moved(camera) for camera in cameras], lag=lag))
        return result

    def _place_gain(self, q: Tensor) -> Tensor:
        """Derivatives of the markers by their places at rest, (T, R, M, 3, 3)."""
        return self.dataset.markers.place_slope(q, torch.from_numpy(self.dataset.simulator.mesh.vertices))

    def _placed(self, markers: Tensor, gain: Tensor, x: Array) -> Tensor:
        """Markers (T, R, M, 3) [m] at their changed places."""
        moved = torch.from_numpy((x * self.scale)[self.places].reshape(-1, 3, 1))
        return markers + (gain @ moved)[..., 0]

    def _differences(self, recordings: Recordings, x: Array) -> "_Differences":
        """Simulated minus measured pixels at x; infinite if a simulation fails."""
        try:
            markers, q = self._simulated(recordings, x[None])
        except SimulationError:
            return _Differences(np.inf, np.zeros((len(recordings.markers), 1)))
        placed = self._placed(markers[:, 0], self._place_gain(q), x)
        return self._compared(recordings, x, placed)

    def _scales(self, x: Array) -> list[float]:
        """Scales of the cameras' images over those calibrated."""
        return [float(value) for value in 1.0 + (x * self.scale)[self.scales]]

    def _scaled(self, placed: Tensor, scale: float) -> Tensor:
        """Markers (T, R, M, 3) [m] as a camera shows them whose image has another scale."""
        centre = torch.from_numpy(self.centre)
        return centre + scale * (placed - centre)

    def _compared(self, recordings: Recordings, x: Array, placed: Tensor) -> "_Differences":
        """Differences of the pixels of markers (T, R, M, 3) [m]."""
        terms = self._terms(recordings, x)
        limit, objective, weighted = recordings.limit[None, :, None], 0.0, []
        for term, scale in zip(terms, self._scales(x), strict=True):
            gap = (term.root @ term.gap(self._scaled(placed, scale))[..., None])[..., 0]
            square = gap.square().sum(-1)
            objective += float(torch.where(square > limit, 2.0 * (limit * square).sqrt() - limit, square).sum())
            weighted.append(gap * _huber_root(square, limit)[..., None])
        return _Differences(objective, torch.cat(weighted, dim=2).numpy())

    def _linearised(self, recordings: Recordings, x: Array) -> tuple["_Differences", Array]:
        """Differences of the pixels at x, and their derivatives (K, n)."""
        material, first = len(QUANTITIES), self.start.shape[1]
        columns = np.stack([np.arange(own.start, own.stop) for own in self.first_frames])  # (R, D)
        sets = np.tile(x, (1 + material + first, 1))
        sets[1 : 1 + material, :material] += np.diag(MATERIAL_STEP / self.scale[self.material])
        for own in columns:
            sets[1 + material + np.arange(first), own] += self.first_steps / self.scale[own]
        simulated, q = self._simulated(recordings, sets)
        steps = torch.from_numpy(np.concatenate([np.full(material, MATERIAL_STEP), self.first_steps]))
        change = (simulated[:, 1:] - simulated[:, :1]) / steps[:, None, None, None]
        gain, limit, jacobians = self._place_gain(q), recordings.limit[None, :, None], []
        placed, terms = self._placed(simulated[:, 0], gain, x), self._terms(recordings, x)
        cameras = zip(terms, self._changes(x), self.poses, self._scales(x), strict=True)
        for number, (term, camera_change, own_pose, scale) in enumerate(cameras):
            scaled = self._scaled(placed, scale)
            points = at_lags(scaled, term.lag)
            square = (term.root @ term.gap(scaled)[..., None])[..., 0].square().sum(-1)
            root = _huber_root(square, limit)[..., None, None] * term.root
            slope = root @ term.slope(points)  # (T, R, M, 2, 3)
            jacobian = torch.zeros((*slope.shape[:-1], len(x)), dtype=torch.float64)
            for k in range(material + first):
                by_start = (slope @ at_lags(change[:, k], term.lag)[..., None])[..., 0]
                if k < material:
                    jacobian[..., k] = by_start
                for r, own in enumerate(columns if k >= material else ()):
                    jacobian[:, r, :, :, own[k - material]] = by_start[:, r]
            by_pose = [camera_change.pose_slope(c, points[:, b].numpy()) for b, c in enumerate(term.cameras)]
            jacobian[..., own_pose.start : own_pose.start + CLOCK] = root @ torch.from_numpy(np.stack(by_pose, axis=1))
            jacobian[..., self.scales.start + number] = (slope @ (points - torch.from_numpy(self.centre))[..., None])[
                ..., 0
            ]
            later, earlier = (at_lags(scaled, term.lag + step) for step in (TIME_STEP, -TIME_STEP))
            velocity = (later - earlier) / (2.0 * TIME_STEP * self.step)
            by_time = -(slope @ velocity[..., None])[..., 0]
            by_time[0] = 0.0  # at rest
            jacobian[..., own_pose.start + CLOCK] = by_time
            for r in range(len(recordings.names)):
                jacobian[:, r, :, :, self.releases.start + r] = by_time[:, r]
            by_place = slope @ gain
            for m in range(slope.shape[2]):
                place = self.places.start + 3 * m
                jacobian[:, :, m, :, place : place + 3] = by_place[:, :, m]
            jacobians.append(jacobian * torch.from_numpy(self.scale))
        derivatives = torch.cat(jacobians, dim=2).numpy().reshape(-1, len(x))
        return self._compared(recordings, x, placed), derivatives


def _huber_root(square: Tensor, limit: Tensor) -> Tensor:
    """Square roots of the weights of differences by Huber's loss, (T, R, M)."""
    return (limit / square.clamp_min(1e-300)).clamp_max(1.0).sqrt().sqrt()


@dataclass(frozen=True)
class _Differences:
    """Differences of the pixels at some variables.

    Attributes:
        objective: sum of Huber's loss [m^2].
        weighted: by the roots of its weights [m], (T, ..), zero where not seen.
    """

    objective: float
    weighted: Array

    def variance(self, variables: int) -> float:
        """Variance of a difference [m^2]; larger where those of successive frames are alike."""
        r = self.weighted
        both = (r[1:] != 0.0) & (r[:-1] != 0.0)
        square, product = float((r[:-1] ** 2 * both).sum()), float((r[1:] * r[:-1]).sum())
        likeness = float(np.clip(product / square, 0.0, MAX_LIKENESS)) if square > 0.0 else 0.0
        freedom = max(int(np.count_nonzero(r)) - variables, 1)
        return LASTING * float((r**2).sum()) / freedom * (1.0 + likeness) / (1.0 - likeness)


def _at_rest(term: CameraTerm, name: str, chosen: list[Registered]) -> CameraTerm:
    """A camera's measurements of R recordings, of which the first row is the mean over the frames at rest."""
    pixel, root = term.pixel.clone(), term.root.clone()
    for r, item in enumerate(chosen):
        if name not in item.views:
            continue
        own = item.views[name].pixel[item.start.rest_frames]
        count = np.isfinite(own).all(-1).sum(0)  # (M)
        both = torch.from_numpy(count) * term.seen[0, r] > 0  # (M)
        mean = np.nansum(own, axis=0) / np.maximum(count, 1)[:, None]
        pixel[0, r] = torch.where(both[:, None], torch.from_numpy(mean), pixel[0, r])
        root[0, r] *= torch.from_numpy(np.sqrt(np.maximum(count, 1.0)))[:, None, None]
    return replace(term, pixel=pixel, root=root)


def _start_directions(frame: FirstFrame, item: Trajectory) -> Array:
    """Derivatives of a first frame's node positions, (D, N, 3): by a force and a moment, and by log E."""
    modes, _ = frame.resultant_modes()
    loads = np.zeros((*item.q.shape, modes.shape[1] + 1))
    loads[frame.nodes, :, :-1] = modes.reshape(len(frame.nodes), 3, -1)
    loads[..., -1] = -(frame.simulator.weight + item.virtual_force)
    return np.moveaxis(frame.simulator.solve_tangent(item.q[None], loads[None])[0], -1, 0)

"""How a recording comes into the specimen frame."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rafl.capture.dataset.sources import Recorded
from rafl.capture.registration.rigid import FEWEST_MARKERS, IDENTITY, Rigid, RigidFit, fit_pose, follow_clamp, kabsch
from rafl.capture.specimen.specimen import Specimen

from rafl.common.errors import InputError

Array = NDArray[Any]

UNKNOWN_SIGMA = 1.0  # [m], of a coordinate that was not observed
STRAY = 0.3  # of a marker's distance from the clamp, in units of the farthest one's: how far it may be bent away


@dataclass(frozen=True)
class RestPose:
    """Where the specimen is undeformed: frames `first` to `last`, included, of a recording; all where both are None."""

    recording: str
    first: int | None = None
    last: int | None = None


@dataclass(frozen=True)
class Registration:
    """How a recording comes into the specimen frame.

    Attributes:
        way: in words.
        pose: one, or one for every frame.
        residual: distance of the markers that show it from their places [m], by name.
        wrong: markers that are set aside.
        covariance: of the pose, (6, 6); NaN where nothing says.
        guessed: whether the model has to find the pose, from here on.
    """

    way: str
    pose: Rigid
    residual: dict[str, float]
    wrong: tuple[str, ...] = ()
    covariance: Array = field(default_factory=lambda: np.full((6, 6), np.nan))
    guessed: bool = False


def every_place(specimen: Specimen) -> tuple[tuple[str, ...], Array]:
    """Names and layout positions of the skin's markers, then the clamp's."""
    names = (*specimen.layout.names, *specimen.clamp_layout.names)
    return names, np.concatenate([specimen.layout.positions, specimen.clamp_layout.positions])


@dataclass(frozen=True)
class Rest:
    """The undeformed specimen as recorded: its fit, and the clamp's markers as they really stand [m], (C, 3)."""

    fit: RigidFit
    clamp: Array


def fit_rest(item: Recorded, named: RestPose, specimen: Specimen, tolerance: float) -> Rest:
    """The fit of a rest pose, averaged over its frames.

    Raises:
        InputError: no such frames, too few markers, or markers too far from the layout.
    """
    count = len(item.time)
    first, last = named.first or 0, count - 1 if named.last is None else named.last
    if not first <= last < count:
        raise InputError(
            f"--rest {named.recording}: expected frames within 0 to {count - 1}, found {first} to {last}; correct them"
        )
    pose, sigma = mean_position(item.position[first : last + 1], item.sigma[first : last + 1])
    fit = _checked(pose, sigma, specimen, tolerance, f"--rest {named.recording}")
    return Rest(fit, fit.rigid.apply(pose)[len(specimen.layout.names) :])


def mean_position(position: Array, sigma: Array) -> tuple[Array, Array]:
    """Mean over frames of markers (T, M, 3), NaN where never seen, and its standard deviation, (M, 3).

    Only what scatters from frame to frame is averaged out; the rest of sigma stays.
    """
    sigma = np.where(np.isfinite(sigma), sigma, UNKNOWN_SIGMA)
    seen = np.isfinite(position[..., :1])
    weight = np.where(seen, 1.0 / np.where(seen, sigma, 1.0) ** 2, 0.0)
    total, count = weight.sum(axis=0), seen.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = (weight * np.where(seen, position, 0.0)).sum(axis=0) / total
        variance = count / total  # of one frame
        scatter = np.where(seen, (position - mean) ** 2, 0.0).sum(axis=0) / np.maximum(count - 1, 1)
        white = np.minimum(scatter, variance)
        return mean, np.where(total > 0, np.sqrt(variance - white + white / count), np.inf)


def _checked(pose: Array, sigma: Array, specimen: Specimen, tolerance: float, what: str) -> RigidFit:
    names, layout = every_place(specimen)
    seen = int(np.isfinite(pose[:, 0]).sum())
    if seen < FEWEST_MARKERS:
        raise InputError(
            f"{what}: expected at least {FEWEST_MARKERS} markers in sight to register, found {seen}; choose other "
            "frames"
        )
    fit = fit_pose(pose, layout, sigma)
    if fit.size > tolerance:
        worst = names[int(np.nanargmax(fit.residual))]
        raise InputError(
            f"{what}: expected the markers where the specimen's layout has them, found them {1e3 * fit.size:.2f} mm "
            f"off (root mean square; at most {1e3 * tolerance:g} mm; {worst} most); check at_mm, the unit and the "
            "order, or allow it with --fit-tolerance-mm"
        )
    return fit


def register(
    item: Recorded, specimen: Specimen, rest: Rest | None, tolerance: float, moving_clamp: bool, name: str
) -> Registration:
    """By the clamp's markers, where there are some; else by a rest pose; else by the calibration; else by the model.

    Args:
        item: a recording, its markers in the specimen's order, the skin's first.
        specimen: as described.
        rest: the undeformed specimen, if it was recorded.
        tolerance: how far markers may be from their places [m].
        moving_clamp: whether the clamp's markers give every frame its own pose, or the mean of their places one.
        name: of the recording, for messages.

    Raises:
        InputError: markers too far from their places.
    """
    skin, names = len(specimen.layout.names), every_place(specimen)[0]
    clamp = specimen.clamp_layout.positions if rest is None else rest.clamp
    known = np.isfinite(clamp[:, 0]) & np.isfinite(item.position[:, skin:, 0]).any(axis=0)
    on_clamp, sigma = item.position[:, skin:][:, known], item.sigma[:, skin:][:, known]
    if (np.isfinite(on_clamp[..., 0]).sum(axis=1) >= FEWEST_MARKERS).any():
        if not moving_clamp:
            on_clamp, sigma = (part[None] for part in mean_position(on_clamp, sigma))
        pose, away = follow_clamp(on_clamp, clamp[known], sigma)
        by_marker = np.sqrt(np.nanmean(away**2, axis=0))
        worst = float(by_marker.max())
        if worst > tolerance:
            raise InputError(
                f"recording {name}: expected the clamp markers where the specimen has them, found them "
                f"{1e3 * worst:.2f} mm off; check the clamp's at_mm, or allow it with --fit-tolerance-mm"
            )
        pose = pose if moving_clamp else Rigid(pose.rotation[0], pose.translation[0])
        shown = np.array(names[skin:])[known]
        return Registration("clamp markers", pose, dict(zip(shown, by_marker.tolist(), strict=True)))
    fit = rest.fit if rest is not None else None
    way = "rest pose" if rest is not None else "the file's own rest pose"
    if fit is None and item.rest is not None:
        sigma = np.full_like(item.rest, float(np.nanmedian(item.sigma)))
        fit = _checked(item.rest, sigma, specimen, tolerance, f"recording {name}, rest pose")
    if fit is not None:
        residual = {names[k]: float(fit.residual[k]) for k in np.flatnonzero(np.isfinite(fit.residual))}
        wrong = tuple(names[k] for k in np.flatnonzero(fit.wrong))
        return Registration(way, fit.rigid, residual, wrong, fit.covariance)
    if item.in_specimen_frame:
        return Registration("calibration", IDENTITY, {})
    return Registration("through the model, from the markers near the clamp", IDENTITY, {}, guessed=True)


def guess_pose(specimen: Specimen, target: Array) -> Rigid:
    """A first guess of the pose from markers (M, 3): they count the less the farther from the clamp, where they may be
    bent away."""
    held = specimen.mesh.vertices[specimen.fixed]
    places = specimen.layout.positions
    away = np.linalg.norm(places[:, None] - held[None], axis=2).min(axis=1)
    stray = 1e-4 + STRAY * away**2 / away.max()
    return kabsch(target, places, np.where(np.isfinite(target[:, 0]), 1.0 / stray**2, 0.0))

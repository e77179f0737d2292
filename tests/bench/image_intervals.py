"""Do the 95 % intervals of E, nu and the loss factor from pixels contain the truth in 95 % of recordings?

    python tests/bench/image_intervals.py [--recordings 200] [--seed 0]

A beam of 24 elements is released from two loads and filmed by one camera, or by two at right angles, with errors of
0.05 px. Initial states and cameras are exact: the intervals are about the errors of the pixels. A fit takes the errors
to be as large as its residuals, so a wrong sigma common to all pixels does not show; one that differs between markers
does, and half of them have errors twice as large as the others. In the last two rows the clamp moves, and its pose is
found in each frame from four markers with errors of 0.02 px, as are those of the body.
"""

import argparse
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from scipy.spatial.transform import Rotation

from rafl.calibration.camera import OrthographicCamera
from rafl.capture.description.specimen_text import body_of_box
from rafl.capture.registration.averaging import measured_directions
from rafl.capture.registration.pose_fit import Measured, fit_poses
from rafl.capture.registration.recording import Recording
from rafl.capture.specimen.specimen import build_specimen
from rafl.common.command_line import create_table
from rafl.data.dataset import Dataset, Trajectory
from rafl.data.markers import embed
from rafl.data.objective import Recordings, loss_curvature, training_loss
from rafl.data.synthetic import loaded_equilibria, simulate_release
from rafl.data.views import View
from rafl.fem.material import Material
from rafl.fem.maxwell import branch_shares
from rafl.fitting.material_search import NORMAL_QUANTILE_95
from rafl.fitting.quantities import BRANCH_TIMES, LOSS_FREQUENCIES, METHOD_QUANTITIES, material_values
from rafl.simulation.rollout import rollout
from rafl.tracking.linking.layout import MarkerLayout

FRAMES, LOADS = 40, (0.03, 0.06)
SIGMA_PX, PIXELS_PER_METRE = 0.05, 9000.0
CLAMP = 1e-3 * np.array([(-10.0, 0.0, 0.0), (-10.0, 0.0, 20.0), (-30.0, 0.0, 5.0), (-30.0, 15.0, 20.0)])
CLAMP_SIGMA_PX = 0.02
QUANTITIES = METHOD_QUANTITIES["sysid-loss"]
STEP = 1e-4  # of the variables, for differences
TRUE = {"youngs_modulus": 190e3, "poissons_ratio": 0.45, "tan_delta": 0.1}


def camera(angle: float) -> OrthographicCamera:
    """A camera that looks along y, turned about x by an angle [rad]."""
    axes = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    rotation = axes @ Rotation.from_rotvec([-angle, 0.0, 0.0]).as_matrix()
    vector = tuple(Rotation.from_matrix(rotation).as_rotvec().tolist())
    return OrthographicCamera(image_size=(1280, 720), rotation_vector=vector, scale=(PIXELS_PER_METRE,) * 2)


RIGS = {"one camera": [camera(0.0)], "two cameras": [camera(-np.pi / 4), camera(np.pi / 4)]}


def exact_dataset() -> Dataset:
    """Recordings without any error, at the true material."""
    specimen = build_specimen(body_of_box("beam", (60.0, 20.0, 20.0), 10.0), MarkerLayout.of([]), Path(), "")
    shares = tuple(branch_shares(torch.tensor(TRUE["tan_delta"], dtype=torch.float64), *LOSS_FREQUENCIES).tolist())
    material = Material(
        TRUE["youngs_modulus"],
        TRUE["poissons_ratio"],
        mass="lumped",
        law="corotated",
        integration="enhanced",
        branch_shares=shares,
        branch_times=BRANCH_TIMES,
    )
    simulator = replace(specimen.simulator(0.01, material), integrator="generalised-alpha")
    starts = loaded_equilibria(simulator, specimen.loaded, np.array(LOADS))
    motion = simulate_release(simulator, starts, FRAMES, ("a", "b"))
    places = 1e-3 * np.array([(x, 0.0, z) for z in (6.0, 14.0) for x in (12.0, 24.0, 36.0, 48.0)])
    markers = embed(specimen.mesh, tuple(f"m{k}" for k in range(len(places))), places)
    positions = markers.positions(torch.from_numpy(motion)).numpy()
    zero, shape = np.zeros_like(specimen.mesh.vertices), positions.shape[:1] + positions.shape[2:3]
    trajectories = {
        name: Trajectory(
            0.01 * np.arange(FRAMES),
            positions[:, b],
            np.ones(shape, bool),
            np.full((*shape, 3), 1e-5),
            starts[b],
            zero,
            zero,
            zero,
            zero[:, 0],
            "train",
        )
        for b, name in enumerate(("a", "b"))
    }
    return Dataset("beam", simulator, markers, trajectories)


def filmed(dataset: Dataset, cameras: list[OrthographicCamera], random: np.random.Generator, equal: bool) -> Dataset:
    """The dataset with pixels; `equal`: their stated covariances are equal though the errors are not."""
    sigma = SIGMA_PX * np.where(np.arange(len(dataset.markers.names)) % 2, 2.0, 1.0)[:, None]

    def view(own: OrthographicCamera, item: Trajectory) -> View:
        pixel = own.project(item.markers)
        pixel = pixel + sigma * random.normal(size=pixel.shape)
        stated = np.full_like(sigma, SIGMA_PX) if equal else sigma
        covariance = np.broadcast_to(stated[..., None] ** 2 * np.eye(2), (*pixel.shape, 2))
        return View(own, pixel, covariance, np.zeros(len(pixel)))

    trajectories = {
        name: replace(item, views={f"c{k}": view(own, item) for k, own in enumerate(cameras)})
        for name, item in dataset.trajectories.items()
    }
    return replace(dataset, trajectories=trajectories)


def filmed_with_clamp(dataset: Dataset, cameras: list[OrthographicCamera], random: np.random.Generator) -> Dataset:
    """The dataset with pixels in the frame of a clamp whose pose in each frame follows from its own markers."""
    count, trajectories = len(dataset.markers.names), {}
    for name, item in dataset.trajectories.items():
        clamp = np.broadcast_to(CLAMP, (FRAMES, *CLAMP.shape))
        points = np.concatenate([item.markers, clamp], axis=1)
        views = {}
        for k, own in enumerate(cameras):
            pixel = own.project(points) + CLAMP_SIGMA_PX * random.normal(size=(*points.shape[:2], 2))
            covariance = np.broadcast_to(CLAMP_SIGMA_PX**2 * np.eye(2), (*pixel.shape, 2))
            views[f"c{k}"] = View(own, pixel, covariance, np.zeros(FRAMES))
        sigma = np.full(points.shape, 1e-4)
        recording = Recording(None, item.time, points, sigma, None, True, "", views=views)
        position, axes, sigma = measured_directions(recording, slice(count, None))
        pose, pose_covariance, _ = fit_poses(Measured.of(position, sigma, axes), CLAMP)
        moving = {"rotation": pose.rotation, "translation": pose.translation, "pose_covariance": pose_covariance}
        own_views = {key: replace(view.select_markers(np.arange(count)), **moving) for key, view in views.items()}
        trajectories[name] = replace(item, views=own_views)
    return replace(dataset, trajectories=trajectories)


def simulated(dataset: Dataset, variables: torch.Tensor) -> torch.Tensor:
    """Markers [m], (T, n, B, M, 3), of n sets of variables (q, n) of the quantities."""
    recordings, count = Recordings.of(dataset, list(dataset.trajectories)), variables.shape[1]
    batch = len(recordings.names)
    own = variables.repeat_interleave(batch, dim=1)
    values = material_values({quantity.name: quantity.value(own[k]) for k, quantity in enumerate(QUANTITIES)})
    start = dataset.start(recordings.names * count)
    with torch.no_grad():
        vertices, _ = rollout(dataset.simulator, start, FRAMES - 1, parameters=dataset.simulator.parameters(**values))
        markers = dataset.markers.positions(vertices)
    return markers.reshape(FRAMES, count, batch, *markers.shape[2:])


def share_inside(exact: Dataset, film: Callable[[np.random.Generator], Dataset], seeds: range) -> np.ndarray:
    """Shares of the recordings whose intervals contain the true values, by quantity [%].

    film: the exact dataset with pixels.

    The errors are so small that the loss is quadratic: one Gauss-Newton step from the truth ends at its minimum.
    """
    true = torch.tensor([quantity.variable(TRUE[quantity.name]) for quantity in QUANTITIES], dtype=torch.float64)
    count = len(QUANTITIES)
    sets = true[:, None] + STEP * torch.cat([torch.zeros(count, 1), torch.eye(count)], dim=1)
    markers = simulated(exact, sets)
    slope, inside = (markers[:, 1:] - markers[:, :1]) / STEP, []
    for seed in seeds:
        dataset = film(np.random.default_rng(seed))
        recordings = Recordings.of(dataset, list(dataset.trajectories))
        found = markers[:, 0].clone().requires_grad_()
        loss = training_loss(recordings, found, torch.empty(0))
        (gradient,) = torch.autograd.grad(loss, found)
        by_variable = torch.einsum("tbmi,tkbmi->k", gradient, slope)
        curvature = loss_curvature(recordings, markers[:, 0], slope)
        step = -torch.linalg.solve(curvature, by_variable)
        least = float(loss.detach() + 0.5 * by_variable @ step)
        freedom = float(recordings.compared_coordinates.sum()) - count
        sigma = (2.0 * least / freedom * torch.linalg.inv(curvature)).diagonal().sqrt()
        inside.append((step.abs() <= NORMAL_QUANTILE_95 * sigma).numpy())
    result: np.ndarray = 100.0 * np.mean(inside, axis=0)
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=int, default=200, help="pairs of recordings for each rig [200]")
    parser.add_argument("--seed", type=int, default=0, help="of the first one [0]")
    options = parser.parse_args()
    torch.set_num_threads(1)
    exact, seeds = exact_dataset(), range(options.seed, options.seed + options.recordings)
    names = [f"{quantity.name} [%]" for quantity in QUANTITIES]
    table = create_table("cameras", "stated sigmas", *names, "all [%]")
    rows: list[tuple[str, str, Callable[[np.random.Generator], Dataset]]] = []
    for rig, cameras in RIGS.items():
        for equal in (False, True):
            rows.append((rig, "equal, wrong" if equal else "true", partial(filmed, exact, cameras, equal=equal)))
    rows += [(rig, "of a moving clamp", partial(filmed_with_clamp, exact, own)) for rig, own in RIGS.items()]
    for rig, stated, film in rows:
        share = share_inside(exact, film, seeds)
        table.add_row(rig, stated, *(f"{value:.1f}" for value in (*share, share.mean())))
    Console(width=120).print(table)


if __name__ == "__main__":
    main()

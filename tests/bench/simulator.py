"""Simulator benchmark: time of forward and backward steps, and its growth with batch, threads and mesh.

    python tests/bench/simulator.py [FOLDER]

Times are medians of one run. FOLDER may contain `fishtail_fine_cells.npy`, a mesh of 1,938 cells.
"""

import argparse
import itertools
import json
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numba
import numpy as np
import torch
from scipy.linalg import cholesky_banded
from threadpoolctl import threadpool_limits
from torch import Tensor

from rafl.capture.specimen.specimen import CLAMP_SPLIT
from rafl.fem.material import Material
from rafl.fem.mesh import HexMesh
from rafl.simulation.rollout import Start, rollout
from rafl.simulation.simulator import Simulator

ORIGINAL_MATERIAL, TARGET_MATERIAL = Material(215856.0, 0.45), Material(263824.0, 0.499)
# Forward and backward step of the paper's own simulator on such a machine with 2 threads [ms].
AUTHORS_TIMES = {
    "canonical, original": (32.7, 8.0),
    "canonical, target": (262.0, 33.5),
    "thicker, original": (47.3, 12.6),
    "crude fish-tail": (43.6, 8.8),
    "finer fish-tail": (3250.0, 525.0),
}


def canonical_mesh(refinement: int = 1) -> HexMesh:
    """The canonical beam with each cell divided into `refinement` cells along each edge."""
    return HexMesh.box(refinement * np.array([10, 3, 3]), (0.1, 0.03, 0.03))


def crude_fishtail_mesh() -> HexMesh:
    """Ten slices of 1 cm cells, centred in a section of 8 x 3 cells."""
    cells = np.zeros((10, 8, 3), dtype=bool)
    for i, (width, height) in enumerate([(4, 3), *[(4, 1)] * 6, (6, 1), (6, 1), (8, 1)]):
        y, z = (8 - width) // 2, (3 - height) // 2
        cells[i, y : y + width, z : z + height] = True
    return HexMesh.from_grid(cells, 0.01)


@dataclass(frozen=True)
class Case:
    """A simulator, and a batch of initial states for it."""

    simulator: Simulator
    start: Start

    @classmethod
    def released(cls, mesh: HexMesh, material: Material, batch: int = 1) -> "Case":
        """Released from equilibria of the target material under loads of 0.12 kg and less at the tip."""
        fixed = mesh.face_nodes("x-min")
        tip = mesh.face_nodes("x-max")
        target = Simulator(mesh, TARGET_MATERIAL, fixed)
        forces = np.repeat(target.weight[None], batch, axis=0)
        for t in range(batch):
            forces[t, tip, 2] -= (0.12 - 0.004 * t) * 9.80709 / len(tip)
        q = torch.from_numpy(target.equilibrium(forces))
        zero = torch.zeros_like(q)
        return cls(Simulator(mesh, material, fixed), Start(q, zero, zero, zero[..., 0], ("beam",) * batch))

    @classmethod
    def undeformed(cls, mesh: HexMesh, material: Material) -> "Case":
        """Released from the undeformed shape, which gravity begins to bend."""
        q = torch.from_numpy(mesh.vertices[None])
        zero = torch.zeros_like(q)
        return cls(Simulator(mesh, material, mesh.face_nodes("x-min")), Start(q, zero, zero, zero[..., 0], ("beam",)))

    def step_times(self, steps: int, repeats: int) -> tuple[float, float]:
        """Forward and backward time per step and trajectory [ms].

        They are the median over all forward steps, and over the backward passes of the rollouts.
        """
        batch = len(self.start.q)
        forward, backward = [], []
        no_force = torch.zeros_like(self.start.q)
        times: list[float] = []

        def record_time(q: Tensor, v: Tensor, external: Tensor) -> Tensor:
            times.append(time.perf_counter())
            return no_force

        for repeat in range(repeats + 1):  # the first compiles the kernels
            q0 = self.start.q.clone().requires_grad_()
            start = Start(q0, self.start.v, self.start.force, self.start.added_mass, self.start.names)
            times.clear()
            q, _ = rollout(self.simulator, start, steps, record_time)
            times.append(time.perf_counter())
            backward_start = time.perf_counter()
            (q**2).sum().backward()
            if repeat > 0:
                forward += np.diff(times).tolist()
                backward.append((time.perf_counter() - backward_start) / steps)
        return 1e3 * float(np.median(forward)) / batch, 1e3 * float(np.median(backward)) / batch


def cholesky_time() -> float:
    """Time of SciPy's banded Cholesky of a 480 x 480 matrix of bandwidth 65 in one thread [ms]."""
    random = np.random.default_rng(0)
    band = random.normal(size=(66, 480))
    band[0] = 300.0
    seconds = []
    with threadpool_limits(1, user_api="blas"):
        for _ in range(200):
            start = time.perf_counter()
            cholesky_banded(band, lower=True)
            seconds.append(time.perf_counter() - start)
    return 1e3 * float(np.median(seconds))


def print_speed(folder: Path | None) -> None:
    cases = {
        "canonical, original": (canonical_mesh(), ORIGINAL_MATERIAL, 40),
        "canonical, target": (canonical_mesh(), TARGET_MATERIAL, 40),
        "thicker, original": (HexMesh.box((10, 4, 4), (0.1, 0.04, 0.04)), ORIGINAL_MATERIAL, 40),
        "crude fish-tail": (crude_fishtail_mesh(), ORIGINAL_MATERIAL, 40),
    }
    fine = folder / "fishtail_fine_cells.npy" if folder else None
    if fine is not None and fine.exists():
        cases["finer fish-tail"] = (HexMesh.from_grid(np.load(fine), 0.003), ORIGINAL_MATERIAL, 30)
    else:
        print("finer fish-tail skipped: give the folder that contains fishtail_fine_cells.npy")
    print("\ntime per step and trajectory; authors: the paper's own simulator")
    print(
        f"{'mesh, material':20s} {'batch':>5s} | {'forward':>9s} {'authors':>8s} {'speedup':>7s} {'/ Cholesky':>10s} | "
        f"{'backward':>9s} {'authors':>8s} {'speedup':>7s}"
    )
    for name, (mesh, material, steps) in cases.items():
        for batch in (1, 9) if len(mesh.hexes) < 1000 else (1,):
            unit = cholesky_time()
            repeats = 7 if len(mesh.hexes) < 1000 else 3
            forward, backward = Case.released(mesh, material, batch).step_times(steps, repeats)
            unit = 0.5 * (unit + cholesky_time())
            authors = AUTHORS_TIMES[name]
            print(
                f"{name:20s} {batch:5d} | {forward:6.2f} ms {authors[0]:5.0f} ms {authors[0] / forward:6.0f}x "
                f"{forward / unit:10.1f} | {backward:6.2f} ms {authors[1]:5.0f} ms {authors[1] / backward:6.1f}x",
                flush=True,
            )


def physical_variants(mesh: HexMesh, nu: float) -> dict[str, Case]:
    """A specimen of preset physical with every integration scheme, and with viscosity and branches."""
    own = {"law": "corotated", "mass": "lumped"}
    cut = mesh.split_layer(mesh.face_nodes("x-min"), CLAMP_SPLIT)
    branches = {"branch_shares": (0.06, 0.06, 0.06), "branch_times": (0.01, 0.1, 1.0)}
    variants = {
        "full": (mesh, Material(130e3, nu, **own)),
        "selective": (mesh, Material(130e3, nu, integration="selective", **own)),
        "enhanced": (mesh, Material(130e3, nu, integration="enhanced", **own)),
        "enhanced, cut": (cut, Material(130e3, nu, integration="enhanced", **own)),
        "viscosity": (cut, Material(130e3, nu, integration="enhanced", viscosity=50.0, **own)),
        "three branches": (cut, Material(130e3, nu, integration="enhanced", **branches, **own)),
    }
    cases = {}
    for name, (each, material) in variants.items():
        simulator = Simulator(each, material, each.face_nodes("x-min"), integrator="generalised-alpha")
        force = simulator.weight[None].copy()
        tip = each.face_nodes("x-max")
        force[:, tip, 2] -= 0.02 * 9.80709 / len(tip)
        cases[name] = Case(simulator, Start.at_rest(torch.from_numpy(simulator.equilibrium(force))))
    return cases


def print_integration() -> None:
    """Times of the schemes relative to `full`, and of three branches relative to viscosity, interleaved."""
    print("\nphysical specimens under generalised-alpha: time per step; ratios to `full`, of branches to viscosity")
    print(f"{'mesh':>16s} {'nu':>6s} {'material':>15s} {'forward':>10s} {'ratio':>6s} {'backward':>10s} {'ratio':>6s}")
    meshes = {
        "canonical": canonical_mesh(),
        "thicker": HexMesh.box((10, 4, 4), (0.1, 0.04, 0.04)),
        "crude fish-tail": crude_fishtail_mesh(),
    }
    for (name, mesh), nu in itertools.product(meshes.items(), (0.45, 0.499)):
        cases = physical_variants(mesh, nu)
        rounds = [{key: case.step_times(40, 1) for key, case in cases.items()} for _ in range(5)]
        times = {key: np.median([each[key] for each in rounds], axis=0) for key in cases}
        for key, (forward, backward) in times.items():
            base = times["viscosity" if key == "three branches" else "full"]
            print(
                f"{name:>16s} {nu:6.3f} {key:>15s} {forward:7.2f} ms {forward / base[0]:6.2f} {backward:7.2f} ms "
                f"{backward / base[1]:6.2f}",
                flush=True,
            )


def peak_memory() -> float:
    """Largest resident memory of this process since `reset_peak_memory` [MB]; Linux only."""
    status = Path("/proc/self/status").read_text()
    return float(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1]) / 1024


def reset_peak_memory() -> float:
    """Reset the peak; returns the resident memory now [MB]."""
    Path("/proc/self/clear_refs").write_text("5")
    return peak_memory()


def run_in_subprocess(*arguments: object) -> dict[str, float]:
    """The JSON result of this script with the given arguments."""
    command = [sys.executable, __file__, *map(str, arguments)]
    result = subprocess.run(command, check=True, capture_output=True, text=True)
    return json.loads(result.stdout.splitlines()[-1])


def print_growth() -> None:
    print("\ngrowth with the mesh: the canonical beam, refined; time per step")
    print(f"{'cells':>7s} {'unknowns':>9s} {'solver':>10s} {'forward':>12s} {'backward':>12s} {'peak memory':>12s}")
    for refinement in (1, 2, 4, 8):
        row = run_in_subprocess("--grow", refinement)
        print(
            f"{row['cells']:7d} {row['unknowns']:9d} {row['solver']:>10s} {row['forward']:9.2f} ms "
            f"{row['backward']:9.2f} ms {row['peak_mb']:9.0f} MB",
            flush=True,
        )


def growth_row(refinement: int) -> dict[str, float]:
    mesh = canonical_mesh(refinement)
    case = Case.undeformed(mesh, ORIGINAL_MATERIAL)
    before = reset_peak_memory()
    forward, backward = case.step_times(20 if refinement < 4 else 4, 3 if refinement < 4 else 1)
    solver = case.simulator.engine.linear_solver
    return {
        "cells": len(mesh.hexes),
        "unknowns": len(solver.free_index),
        "solver": type(solver).__name__,
        "forward": forward,
        "backward": backward,
        "peak_mb": peak_memory() - before,
    }


def print_batches() -> None:
    print("\ncanonical beam, original material: time per step and trajectory")
    print(f"{'batch':>7s} {'threads':>8s} {'forward':>12s} {'backward':>12s}")
    for threads in range(1, numba.config.NUMBA_NUM_THREADS + 1):
        numba.set_num_threads(threads)
        for batch in (1, 2, 4, 9, 16):
            forward, backward = Case.released(canonical_mesh(), ORIGINAL_MATERIAL, batch).step_times(40, 5)
            print(f"{batch:7d} {threads:8d} {forward:9.2f} ms {backward:9.2f} ms", flush=True)


def rollout_memory(remembering: bool) -> dict[str, float]:
    """Peak memory of a rollout and its backward pass, of a specimen of preset physical with three branches or paper."""
    case = Case.released(canonical_mesh(), ORIGINAL_MATERIAL, 9)
    if remembering:
        own = physical_variants(canonical_mesh(), 0.499)["three branches"]
        q = own.start.q.expand(9, -1, -1).contiguous()
        case = Case(own.simulator, Start.at_rest(q))
    case.step_times(2, 1)
    before = reset_peak_memory()
    case.step_times(150, 1)
    return {"rollout_mb": peak_memory() - before}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help="folder with fishtail_fine_cells.npy")
    parser.add_argument("--grow", type=int, help="print one row of the growth table, for this refinement, as JSON")
    parser.add_argument("--memory", choices=["paper", "branches"], help="print the peak memory of a rollout as JSON")
    parser.add_argument("--integration", action="store_true", help="only compare integration schemes and branches")
    options = parser.parse_args()
    torch.set_num_threads(1)
    numba.set_num_threads(min(2, numba.config.NUMBA_NUM_THREADS))
    if options.grow:
        print(json.dumps(growth_row(options.grow)))
        return
    if options.memory:
        print(json.dumps(rollout_memory(options.memory == "branches")))
        return
    if options.integration:
        print_integration()
        return
    print(f"unit of time (banded Cholesky, 480 x 480, bandwidth 65, one thread): {cholesky_time():.3f} ms")
    print_speed(options.folder)
    print_batches()
    for kind in ("paper", "branches"):
        memory = run_in_subprocess("--memory", kind)
        print(
            f"\npeak memory of 150 steps of a batch of 9 and their backward pass, {kind}: {memory['rollout_mb']:.0f} MB"
        )
    print_integration()
    print_growth()


if __name__ == "__main__":
    main()

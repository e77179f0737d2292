"""Speed of the simulator's forward and backward steps, and how they grow.

    python tests/bench/simulator.py [FOLDER] [--only table]

Medians, in one run; FOLDER may hold `fishtail_fine_cells.npy`, a mesh of 1,938 cells.
"""

import argparse
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

from rafl.fem.material import Material
from rafl.fem.mesh import HexMesh
from rafl.simulation.rollout import Start, rollout
from rafl.simulation.simulator import Simulator

ORIGINAL, TARGET = Material(215856.0, 0.45), Material(263824.0, 0.499)
# The paper's own simulator on this kind of machine, 2 threads: forward and backward step [ms].
AUTHORS = {
    "canonical, original": (32.7, 8.0),
    "canonical, target": (262.0, 33.5),
    "thicker, original": (47.3, 12.6),
    "crude fish-tail": (43.6, 8.8),
    "finer fish-tail": (3250.0, 525.0),
}


def canonical(times: int = 1) -> HexMesh:
    """The canonical beam, its cells cut `times` times along each edge."""
    return HexMesh.box(times * np.array([10, 3, 3]), (0.1, 0.03, 0.03))


def crude_fishtail() -> HexMesh:
    """Ten slices of 1 cm cells, centred in a section of 8 x 3."""
    cells = np.zeros((10, 8, 3), dtype=bool)
    for i, (width, height) in enumerate([(4, 3), *[(4, 1)] * 6, (6, 1), (6, 1), (8, 1)]):
        y, z = (8 - width) // 2, (3 - height) // 2
        cells[i, y : y + width, z : z + height] = True
    return HexMesh.from_grid(cells, 0.01)


@dataclass(frozen=True)
class Case:
    """Beams let go from the target material's rest under 0.12 kg at the tip."""

    simulator: Simulator
    start: Start

    @classmethod
    def of(cls, mesh: HexMesh, material: Material, batch: int = 1) -> "Case":
        fixed = mesh.face_nodes("x-min")
        tip = mesh.face_nodes("x-max")
        loaded = Simulator(mesh, TARGET, fixed)
        forces = np.repeat(loaded.weight[None], batch, axis=0)
        for t in range(batch):
            forces[t, tip, 2] -= (0.12 - 0.004 * t) * 9.80709 / len(tip)
        q = torch.from_numpy(loaded.equilibrium(forces))
        still = torch.zeros_like(q)
        return cls(Simulator(mesh, material, fixed), Start(q, still, still, still[..., 0], ("beam",) * batch))

    @classmethod
    def dropped(cls, mesh: HexMesh, material: Material) -> "Case":
        """A straight beam that gravity begins to bend."""
        q = torch.from_numpy(mesh.vertices[None])
        still = torch.zeros_like(q)
        return cls(
            Simulator(mesh, material, mesh.face_nodes("x-min")), Start(q, still, still, still[..., 0], ("beam",))
        )

    def milliseconds(self, steps: int, repeats: int) -> tuple[float, float]:
        """Forward and backward, a step and trajectory: medians over the steps, and over the rollouts."""
        batch = len(self.start.q)
        forward, backward = [], []
        none = torch.zeros_like(self.start.q)
        moments: list[float] = []

        def clock(q: Tensor, v: Tensor, external: Tensor) -> Tensor:
            moments.append(time.perf_counter())
            return none

        for repeat in range(repeats + 1):
            q0 = self.start.q.clone().requires_grad_()
            start = Start(q0, self.start.v, self.start.force, self.start.added_mass, self.start.names)
            moments.clear()
            q, _ = rollout(self.simulator, start, steps, clock)
            moments.append(time.perf_counter())
            began = time.perf_counter()
            (q**2).sum().backward()
            if repeat > 0:
                forward += np.diff(moments).tolist()
                backward.append((time.perf_counter() - began) / steps)
        return 1e3 * float(np.median(forward)) / batch, 1e3 * float(np.median(backward)) / batch


def yardstick() -> float:
    """SciPy's banded Cholesky of a 480 x 480 matrix of bandwidth 65, one thread [ms]."""
    random = np.random.default_rng(0)
    band = random.normal(size=(66, 480))
    band[0] = 300.0
    seconds = []
    with threadpool_limits(1, user_api="blas"):
        for _ in range(200):
            began = time.perf_counter()
            cholesky_banded(band, lower=True)
            seconds.append(time.perf_counter() - began)
    return 1e3 * float(np.median(seconds))


def speed(folder: Path | None) -> None:
    meshes = {
        "canonical, original": (canonical(), ORIGINAL, 40),
        "canonical, target": (canonical(), TARGET, 40),
        "thicker, original": (HexMesh.box((10, 4, 4), (0.1, 0.04, 0.04)), ORIGINAL, 40),
        "crude fish-tail": (crude_fishtail(), ORIGINAL, 40),
    }
    fine = folder / "fishtail_fine_cells.npy" if folder else None
    if fine is not None and fine.exists():
        meshes["finer fish-tail"] = (HexMesh.from_grid(np.load(fine), 0.003), ORIGINAL, 30)
    else:
        print("finer fish-tail skipped: no folder with fishtail_fine_cells.npy was given")
    print(
        f"{'':20s} {'batch':>5s} | {'forward':>9s} {'authors':>8s} {'faster':>7s} {'yardsticks':>10s} | "
        f"{'backward':>9s} {'authors':>8s} {'faster':>7s}"
    )
    for name, (mesh, material, steps) in meshes.items():
        for batch in (1, 9) if len(mesh.hexes) < 1000 else (1,):
            unit = yardstick()
            forward, backward = Case.of(mesh, material, batch).milliseconds(steps, 7 if len(mesh.hexes) < 1000 else 3)
            unit = 0.5 * (unit + yardstick())
            theirs = AUTHORS[name]
            print(
                f"{name:20s} {batch:5d} | {forward:6.2f} ms {theirs[0]:5.0f} ms {theirs[0] / forward:6.0f}x "
                f"{forward / unit:10.1f} | {backward:6.2f} ms {theirs[1]:5.0f} ms {theirs[1] / backward:6.1f}x",
                flush=True,
            )


def peak_mb() -> float:
    """The most memory this process has held since `forget_peak` [MB]; Linux."""
    status = Path("/proc/self/status").read_text()
    return float(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1]) / 1024


def forget_peak() -> float:
    """Start counting anew; what is held now [MB]."""
    Path("/proc/self/clear_refs").write_text("5")
    return peak_mb()


def apart(*arguments: object) -> dict[str, float]:
    """The same, in a process of its own."""
    command = [sys.executable, __file__, *map(str, arguments)]
    result = subprocess.run(command, check=True, capture_output=True, text=True)
    return json.loads(result.stdout.splitlines()[-1])


def growth() -> None:
    print(f"\n{'cells':>7s} {'unknowns':>9s} {'solver':>10s} {'forward':>12s} {'backward':>12s} {'peak memory':>12s}")
    for times in (1, 2, 4, 8):
        found = apart("--grow", times)
        print(
            f"{found['cells']:7d} {found['unknowns']:9d} {found['solver']:>10s} {found['forward']:9.2f} ms "
            f"{found['backward']:9.2f} ms {found['peak_mb']:9.0f} MB",
            flush=True,
        )


def grow(times: int) -> dict[str, float]:
    mesh = canonical(times)
    case = Case.dropped(mesh, ORIGINAL)
    held = forget_peak()
    forward, backward = case.milliseconds(20 if times < 4 else 4, 3 if times < 4 else 1)
    solver = case.simulator.engine.linear
    return {
        "cells": len(mesh.hexes),
        "unknowns": len(solver.free_index),
        "solver": type(solver).__name__,
        "forward": forward,
        "backward": backward,
        "peak_mb": peak_mb() - held,
    }


def batches() -> None:
    print(f"\n{'batch':>7s} {'threads':>8s} {'forward':>12s} {'backward':>12s}   a step and trajectory")
    for threads in range(1, numba.config.NUMBA_NUM_THREADS + 1):
        numba.set_num_threads(threads)
        for batch in (1, 2, 4, 9, 16):
            forward, backward = Case.of(canonical(), ORIGINAL, batch).milliseconds(40, 5)
            print(f"{batch:7d} {threads:8d} {forward:9.2f} ms {backward:9.2f} ms", flush=True)


def memory() -> dict[str, float]:
    case = Case.of(canonical(), ORIGINAL, 9)
    case.milliseconds(2, 1)
    held = forget_peak()
    case.milliseconds(150, 1)
    return {"rollout_mb": peak_mb() - held}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--grow", type=int, help="one row of the growth table, as JSON")
    parser.add_argument("--memory", action="store_true", help="a long rollout's memory, as JSON")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    numba.set_num_threads(min(2, numba.config.NUMBA_NUM_THREADS))
    if arguments.grow:
        print(json.dumps(grow(arguments.grow)))
        return
    if arguments.memory:
        print(json.dumps(memory()))
        return
    print(f"yardstick (banded Cholesky, 480 x 480, bandwidth 65, one thread): {yardstick():.3f} ms")
    speed(arguments.folder)
    batches()
    found = apart("--memory")
    print(f"\n150 steps of a batch of 9 with their backward pass: {found['rollout_mb']:.0f} MB")
    growth()


if __name__ == "__main__":
    main()

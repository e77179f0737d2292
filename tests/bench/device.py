"""Steps per second of the compiled kernels and of tensors, for growing batches and meshes of the canonical beam.

    python tests/bench/device.py [--device cuda]

Without --device the tensors run on a graphics card if torch finds one, else on the processor. The beam is of preset
physical under generalised-alpha, one step per frame; each trajectory starts with another velocity. Every case is a
process of its own, which is ended after --limit seconds with what it has measured by then. The kernels take all
processors; tensors on a processor take one thread, as in the commands.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from rafl.common.errors import InputError
from rafl.fem.material import Material
from rafl.fem.mesh import HexMesh
from rafl.simulation.device import CPU, require_device
from rafl.simulation.rollout import Start, rollout, simulate_steps
from rafl.simulation.simulator import Simulator

MATERIAL = Material(215856.0, 0.45, law="corotated", mass="lumped", integration="enhanced")
CASES = ((1, 1), (1, 9), (1, 64), (1, 256), (4, 1), (8, 1))  # refinement of the beam and batch
LIMIT, COMPILATION = 24.0, 180.0  # of a case, and of one before that compiles the kernels [s]: eight minutes in all
FORWARD, BACKWARD = 8.0, 4.0  # [s] for which steps are timed
MOST_STEPS, COMPARED_STEP = 40, 3
SHOWN = 8  # trajectories of which tips are compared


@dataclass(frozen=True)
class Case:
    """One simulator and one batch: refinement of the beam, number of trajectories, arithmetic and device."""

    refinement: int
    batch: int
    arithmetic: str
    device: str

    @property
    def simulator(self) -> Simulator:
        mesh = HexMesh.box(self.refinement * np.array([10, 3, 3]), (0.1, 0.03, 0.03))
        return Simulator(
            mesh,
            MATERIAL,
            mesh.face_nodes("x-min"),
            integrator="generalised-alpha",
            arithmetic=self.arithmetic,
            device=self.device,
        )

    def measure(self) -> None:
        """Print what is known so far as a line of JSON, first after the steps, then after their derivatives."""
        simulator = self.simulator
        vertices = simulator.mesh.vertices
        q = torch.from_numpy(np.repeat(vertices[None], self.batch, axis=0))
        v = torch.zeros_like(q)
        v[..., 2] = -torch.linspace(0.3, 1.0, self.batch, dtype=torch.float64)[:, None] * (q[..., 0] / 0.1) ** 2
        start = Start(q, v, 0 * q, 0 * q[..., 0], ("beam",) * self.batch)
        tip = simulator.mesh.face_nodes("x-max")
        times, found = [time.perf_counter()], {}
        with torch.no_grad():
            for number, step in enumerate(simulate_steps(simulator, start, MOST_STEPS + 1), 1):
                times.append(time.perf_counter())
                if number == COMPARED_STEP:
                    found["tip"] = step.state.q[:SHOWN, tip].mean(1).tolist()
                if number > COMPARED_STEP and times[-1] - times[1] > FORWARD:
                    break
        # The first step also compiles kernels and chooses orders.
        found |= {"first": times[1] - times[0], "step": float(np.median(np.diff(times[1:]))), "memory": self.memory()}
        print(json.dumps(found), flush=True)
        steps = int(np.clip(BACKWARD / (3.0 * found["step"]), 1, 20))
        leaf = start.q.clone().requires_grad_()
        positions, _ = rollout(simulator, Start(leaf, v, start.force, start.added_mass, start.names), steps)
        begin = time.perf_counter()
        (positions[-1] ** 2).sum().backward()
        found |= {"backward": (time.perf_counter() - begin) / steps, "memory": self.memory()}
        print(json.dumps(found), flush=True)

    def memory(self) -> float:
        """Peak memory [MB]: on the card, or of the process."""
        if self.device != CPU:
            return torch.cuda.max_memory_allocated(self.device) / 2**20
        status = Path("/proc/self/status").read_text()
        return float(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1]) / 1024

    def run(self, limit: float) -> dict[str, object]:
        """What a process of its own has measured, with `error` if it failed; empty if it was ended before any step."""
        own = {"OMP_NUM_THREADS": "1"} if self.arithmetic == "torch" else {}
        line = [sys.executable, __file__, "--case", self.refinement, self.batch, self.arithmetic, self.device]
        try:
            words, environment = [str(word) for word in line], {**os.environ, **own}
            done = subprocess.run(words, capture_output=True, timeout=limit, check=False, env=environment)
            out, error = done.stdout, done.stderr if done.returncode else b""
        except subprocess.TimeoutExpired as stopped:
            out, error = stopped.stdout or b"", b""
        rows = [row for row in out.decode().splitlines() if row.endswith("}")]
        found = json.loads(rows[-1]) if rows else {}
        return found | ({"error": error.decode().strip().splitlines()[-1]} if error else {})


def print_table(device: str, limit: float) -> None:
    card = f" ({torch.cuda.get_device_name(device)})" if device != CPU else ""
    print(f"tensors on {device}{card}; steps/s: of all trajectories together; tip: largest difference after 3 steps")
    print(f"{'cells':>6s} {'batch':>5s} {'arithmetic':>10s} {'first step':>11s} {'step':>12s} {'steps/s':>9s} ", end="")
    print(f"{'backward':>12s} {'peak memory':>11s} {'tip':>10s}")
    Case(1, 1, "compiled", CPU).run(COMPILATION)
    for refinement, batch in CASES:
        kernels: dict[str, object] = {}
        for case in (Case(refinement, batch, "compiled", CPU), Case(refinement, batch, "torch", device)):
            found = case.run(limit)
            name = f"{90 * refinement**3:6d} {batch:5d} {case.arithmetic:>10s}"
            if "step" not in found:
                print(f"{name} {found.get('error', f'no step within {limit:.0f} s')}", flush=True)
                continue
            backward = f"{1e3 * found['backward']:9.1f} ms" if "backward" in found else f"{'-':>12s}"
            gap = ""
            if "tip" in kernels and "tip" in found:
                gap = f"{np.abs(np.subtract(found['tip'], kernels['tip'])).max():8.1e} m"
            kernels = kernels or found
            print(
                f"{name} {found['first']:9.2f} s {1e3 * found['step']:9.1f} ms {batch / found['step']:9.1f} {backward} "
                f"{found['memory']:8.0f} MB {gap:>10s} {found.get('error', '')}",
                flush=True,
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else CPU, help="of the tensors")
    parser.add_argument("--limit", type=float, default=LIMIT, help=f"of each case [s]; {LIMIT:g} unless given")
    parser.add_argument("--case", nargs=4, help="measure one case in this process and print JSON")
    options = parser.parse_args()
    if options.case:
        refinement, batch, arithmetic, device = options.case
        Case(int(refinement), int(batch), arithmetic, device).measure()
        return
    try:
        require_device(options.device, "--device")
    except InputError as error:
        parser.error(str(error))
    print_table(options.device, options.limit)


if __name__ == "__main__":
    main()

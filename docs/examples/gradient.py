"""Gradient of a tip deflection with respect to Young's modulus."""

import torch

import rafl

dataset = rafl.read_dataset("beam.h5")
simulator = dataset.simulator
start = dataset.start(["load080g"])

modulus = torch.tensor(simulator.material.youngs_modulus, dtype=torch.float64, requires_grad=True)
positions, _ = rafl.rollout(simulator, start, 10, parameters=simulator.parameters(youngs_modulus=modulus))
tip = dataset.markers.positions(positions)[-1, 0, -1, 2]  # z of the last marker in the last frame [m]
tip.backward()
print(f"dz/dE = {modulus.grad:.3g} m/Pa")

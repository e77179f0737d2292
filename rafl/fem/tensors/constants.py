"""Small constant tensors, kept on each device, for a copy from the host takes as long as a calculation."""

from functools import cache

import torch
from torch import Tensor


@cache
def numbers(values: tuple[float, ...], device: torch.device) -> Tensor:
    """Numbers (n) in double precision."""
    return torch.tensor(values, dtype=torch.float64, device=device)


@cache
def indices(values: tuple[int, ...], device: torch.device) -> Tensor:
    """Indices (n)."""
    return torch.tensor(values, dtype=torch.int64, device=device)

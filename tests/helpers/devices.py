"""The devices that tests of tensors run on: the processor, and a graphics card where there is one."""

import pytest
import torch

CARD = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no CUDA device")
ON_DEVICES = pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=CARD)])

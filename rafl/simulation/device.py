"""The device that a simulation runs on, by its name."""

import re

from rafl.common.errors import InputError

CPU = "cpu"
NAMES = re.compile(r"cpu|cuda(:\d+)?")


def check_device_name(name: str, label: str = "device") -> None:
    """Check that a name is that of a processor or of a graphics card.

    Raises:
        InputError: it is neither.
    """
    if not NAMES.fullmatch(name):
        raise InputError(f"{label}: expected cpu, cuda or, for one of several graphics cards, cuda:0, found {name!r}")


def require_device(name: str, label: str = "device") -> None:
    """Check that there is a device of this name.

    Raises:
        InputError: there is none, or torch cannot use it.
    """
    check_device_name(name, label)
    if name == CPU:
        return
    import torch  # takes seconds, and the name alone can be checked without it

    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if int(name.partition(":")[2] or 0) >= count:
        found = f"{count}, cuda:0 to cuda:{count - 1}" if count else "none"
        raise InputError(
            f"{label} {name}: expected a CUDA device, found {found}; install NVIDIA's driver and a build of torch with "
            "CUDA, or leave the option out to use the processor"
        )

"""The module of a law's derivatives, written once and kept beside numba's compiled kernels."""

import hashlib
import re
import sys
from pathlib import Path
from types import ModuleType

import sympy
from numba import config
from numba.misc.appdirs import AppDirs

from rafl.common.files import write_text
from rafl.fem.laws.derivation.derivatives import derive
from rafl.fem.laws.derivation.energy import symbolic_energy
from rafl.fem.laws.derivation.source import module_source
from rafl.fem.laws.law import Energy

ORIGIN = "The energy was given to `rafl.register_law`."


def derivatives_module(name: str, energy: Energy) -> ModuleType:
    """The module of derivatives of an energy. It is computed and compiled once on a computer.

    Raises:
        ValueError: the energy is not admissible.
    """
    psi = symbolic_energy(energy)
    key = hashlib.sha256("\n".join([name, sympy.srepr(psi), sympy.__version__, _generator()]).encode()).hexdigest()
    path = cache_folder() / f"{re.sub(r'[^a-z0-9]+', '_', name.lower())}_{key[:16]}.py"
    try:
        if not path.exists():
            write_text(path, module_source(name, derive(psi), ORIGIN))
        return _module(path, path.read_text(encoding="utf-8"))
    except OSError:  # no folder to write to: each process computes and compiles the law anew
        return _module(path, module_source(name, derive(psi), ORIGIN))


def cache_folder() -> Path:
    """Folder of the modules: in numba's cache folder if one is set, else in the user's."""
    folder: str = config.CACHE_DIR  # type: ignore[attr-defined]  # set as numba is imported
    return Path(folder or AppDirs("numba", appauthor=False).user_cache_dir) / "rafl-laws"


def _generator() -> str:
    """Text of the files that make a module's source."""
    return "".join(path.read_text(encoding="utf-8") for path in sorted(Path(__file__).parent.glob("*.py")))


def _module(path: Path, source: str) -> ModuleType:
    """The module with this text, whose functions say that they are from the file at `path`."""
    module = ModuleType(f"rafl_law_{path.stem}")
    sys.modules[module.__name__] = module  # where numba looks for the globals of functions in its cache
    exec(compile(source, str(path), "exec"), module.__dict__)
    return module

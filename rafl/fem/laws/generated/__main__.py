"""Write the derivatives of the laws that come with the package: python -m rafl.fem.laws.generated (`make laws`)."""

from pathlib import Path

from rafl.fem.laws import ENERGIES
from rafl.fem.laws.derivation.derivatives import derive
from rafl.fem.laws.derivation.energy import symbolic_energy
from rafl.fem.laws.derivation.source import module_source


def sources() -> dict[str, str]:
    """Text of each module, by its name."""
    found = {}
    for law, module in ENERGIES.items():
        stem = module.__name__.rpartition(".")[2]
        origin = f"The energy is in `{module.__name__}`."
        found[stem] = module_source(law, derive(symbolic_energy(module.energy)), origin)
    return found


if __name__ == "__main__":
    for stem, text in sources().items():
        Path(__file__).with_name(f"{stem}.py").write_text(text, encoding="utf-8")

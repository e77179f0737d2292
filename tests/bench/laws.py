"""Elastic laws compared with tensile tests of silicone rubbers.

    python tests/bench/laws.py ../shared/real/rubber_tensile

Fits E, and the shape constants of a law that has some, to the engineering stress (force over first cross-section) of
strips up to 30 % and 100 % strain, by linear least squares. The strips keep their volume, and their sides are free.
Prints the RMS error relative to the RMS stress.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from rafl.fem.laws.mooney_rivlin import SHARE
from rafl.fem.laws.yeoh import C2

Array = NDArray[np.float64]

RUBBERS = {
    "Dragon Skin 10": "Dragon_Skin_10_MEDIUM.csv",
    "Dragon Skin FX-Pro with Slacker": "Dragon_Skin_FX_Pro_Slacker.csv",
}
LARGEST_STRAINS = (0.3, 1.0)


def neo_hookean(x: Array) -> Array:
    """Engineering stress at stretch x, relative to E = 3 mu: the energy is mu/2 (x^2 + 2/x - 3)."""
    return (x - x**-2) / 3


def invariant(x: Array) -> Array:
    """I = x^2 + 2/x - 3."""
    return x**2 + 2 / x - 3


# Stress relative to E is a sum of these functions of the stretch. The coefficient of the first is 1, those of the
# others are shape constants.
Terms = list[Callable[[Array], Array]]
LINEAR: Terms = [lambda x: x - 1]
YEOH: Terms = [
    neo_hookean,
    lambda x: 2 * invariant(x) * neo_hookean(x),
    lambda x: 3 * invariant(x) ** 2 * neo_hookean(x),
]
MOONEY_RIVLIN: Terms = [neo_hookean, lambda x: (1 / x - 1) * neo_hookean(x)]
# Terms, and shape constants, or None to fit them; `bounded` to those with which the energy of every strain is positive.
ROWS: dict[str, tuple[Terms, list[float] | None, bool]] = {
    "corotated": (LINEAR, None, False),
    "neo-hookean": (YEOH[:1], None, False),
    f"yeoh (C2 = {C2:g})": (YEOH[:2], [C2], False),
    "Yeoh, C2 fitted": (YEOH[:2], None, False),
    "Yeoh, C2 and C3 fitted": (YEOH, None, False),
    "Yeoh, C2 and C3 fitted, not negative": (YEOH, None, True),
    f"mooney-rivlin (m = {SHARE:g})": (MOONEY_RIVLIN, [SHARE], False),
    "Mooney-Rivlin, m fitted": (MOONEY_RIVLIN, None, False),
}


def read_test(path: Path) -> tuple[Array, Array]:
    """Engineering strain, and engineering stress [Pa]."""
    lines = path.read_text(encoding="utf-8").splitlines()
    start = next(number for number, line in enumerate(lines) if line.startswith("Time (s)"))
    names = lines[start].split(";")
    values = np.array([[float(cell) for cell in line.split(";")] for line in lines[start + 1 :]])
    strain, stress = (values[:, names.index(name)] for name in ("Engineering Strain", "Engineering Stress (MPa)"))
    return strain, 1e6 * stress


def fit(terms: Terms, shape: list[float] | None, bounded: bool, x: Array, stress: Array) -> tuple[float, Array, float]:
    """E [Pa], shape constants, and RMS error relative to the RMS stress."""
    columns = np.stack([term(x) for term in terms], axis=-1)
    if shape is not None:
        columns = columns @ np.array([[1.0], *([c] for c in shape)])
    found = nnls(columns, stress)[0] if bounded else np.linalg.lstsq(columns, stress, rcond=None)[0]
    error = columns @ found - stress
    constants = found[1:] / found[0] if shape is None else np.array(shape)
    return float(found[0]), constants, float(np.sqrt((error**2).mean() / (stress**2).mean()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder of the tensile tests")
    folder = parser.parse_args().folder
    for rubber, file in RUBBERS.items():
        strain, stress = read_test(folder / file)
        for largest in LARGEST_STRAINS:
            chosen = strain <= largest
            print(f"\n{rubber}, up to {largest:.0%} strain ({chosen.sum()} points)")
            print(f"{'law':38s} {'RMS error':>9s} {'E':>10s}  shape constants")
            for name, row in ROWS.items():
                modulus, shape, error = fit(*row, 1 + strain[chosen], stress[chosen])
                constants = ", ".join(f"{c:.4f}" for c in shape)
                print(f"{name:38s} {100 * error:7.2f} % {1e-3 * modulus:6.1f} kPa  {constants}")


if __name__ == "__main__":
    main()

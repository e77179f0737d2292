from pathlib import Path

import numpy as np
import pytest
import stereo

from rafl.calibration.foreign.read import read_any_calibration
from rafl.calibration.rig import Rig
from rafl.common.errors import InputError


def read(path: Path) -> Rig:
    return read_any_calibration(path, "mm", lambda _: dict.fromkeys(stereo.MATRICES, stereo.SIZE))


def dlt_pixels(coefficients: np.ndarray) -> np.ndarray:
    """u and v (N, 2) of the points by the formula of the DLT."""
    rows = np.append(coefficients, 1.0).reshape(3, 4)
    homogeneous = np.column_stack([stereo.POINTS_MM, np.ones(len(stereo.POINTS_MM))]) @ rows.T
    return np.asarray(homogeneous[:, :2] / homogeneous[:, 2:])


def test_coefficients_with_v_counted_upwards_from_1(tmp_path: Path) -> None:
    stereo.write_dlt(tmp_path / "dlt.csv")
    for name, camera in read(tmp_path / "dlt.csv").cameras.items():
        pixels = camera.project(1e-3 * stereo.POINTS_MM)
        np.testing.assert_allclose(pixels, stereo.opencv_pixels(name, distorted=False), atol=1e-9)
        formula = dlt_pixels(stereo.dlt_coefficients(name))
        np.testing.assert_allclose(
            pixels, np.column_stack([formula[:, 0] - 1, stereo.SIZE[1] - formula[:, 1]]), atol=1e-9
        )


def test_coefficients_with_v_counted_downwards_are_recognised(tmp_path: Path) -> None:
    columns = [(stereo.projection(name) / stereo.projection(name)[2, 3]).ravel()[:11] for name in stereo.MATRICES]
    np.savetxt(tmp_path / "dlt.csv", np.column_stack(columns), delimiter=";")
    for camera, column in zip(read(tmp_path / "dlt.csv").cameras.values(), columns, strict=True):
        pixels = camera.project(1e-3 * stereo.POINTS_MM)
        np.testing.assert_allclose(pixels, dlt_pixels(column) - 1.0, atol=1e-9)


def test_any_coefficients_give_their_formula(tmp_path: Path, random: np.random.Generator) -> None:
    """Eleven free coefficients need a skew, and the world's origin may be behind a camera."""
    coefficients = random.normal(size=(11, 2))
    coefficients[8:] *= 1e-3
    np.savetxt(tmp_path / "dlt.csv", coefficients, delimiter=",", fmt="%.18e")
    for k, camera in enumerate(read(tmp_path / "dlt.csv").cameras.values()):
        formula = dlt_pixels(coefficients[:, k])
        expected = np.column_stack([formula[:, 0] - 1.0, stereo.SIZE[1] - formula[:, 1]])
        np.testing.assert_allclose(camera.project(1e-3 * stereo.POINTS_MM), expected, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1,2\n" * 10, "11 rows of DLT coefficients .* found 10 rows of 2 to 2"),
        ("1,2\n" * 10 + "1\n", "found 11 rows of 1 to 2"),
        ("", "found 0 rows"),
        ("a,b\n" * 11, "expected 22 numbers"),
        ("1,nan\n" * 11, "not finite"),
        ("1,2\n" * 11, "camera 1: .* linearly dependent"),
        ("0,0\n" * 11, "linearly dependent"),
        ("\0\xff", "expected"),
    ],
)
def test_other_tables_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "dlt.csv").write_text(text, encoding="latin-1")
    with pytest.raises(InputError, match=message):
        read(tmp_path / "dlt.csv")

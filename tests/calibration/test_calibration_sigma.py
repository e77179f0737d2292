"""The pixels' uncertainty that follows from the covariance of a calibration."""

from dataclasses import replace

import numpy as np
import pytest

from rafl.calibration.camera import OrthographicCamera, PinholeCamera

CAMERA = OrthographicCamera(
    image_size=(1280, 720),
    rotation_vector=(1.5, 0.1, 0.2),
    scale=(9000.0, 9100.0),
    skew=20.0,
    offset=(300.0, 200.0),
    distortion=(0.01, -0.002),
)


def test_sigma_is_the_spread_of_the_pixels(random: np.random.Generator) -> None:
    sigmas = np.array([2e-3, 2e-3, 1e-3, 2e-4, 3e-4, 1e-4, 0.05, 0.04, 1e-4, 1e-4])
    mix = np.eye(10) + 0.3 * random.normal(size=(10, 10))
    root = np.diag(sigmas) @ mix
    camera = replace(CAMERA, covariance=tuple(map(tuple, root @ root.T)))
    points = random.uniform(0.0, 0.1, (8, 3))
    drawn = []
    for noise in random.normal(size=(4000, 10)) @ root.T:
        drawn.append(
            replace(
                CAMERA,
                scale=(9000.0 + 1e3 * noise[0], 9100.0 + 1e3 * noise[1]),
                skew=20.0 + 1e3 * noise[2],
                rotation_vector=tuple(np.array(CAMERA.rotation_vector) + noise[3:6]),
                offset=tuple(np.array(CAMERA.offset) + noise[6:8]),
                distortion=tuple(np.array(CAMERA.distortion) + noise[8:]),
            ).project(points)
        )
    spread = float(np.sqrt(np.var(drawn, axis=0).mean()))
    assert camera.calibration_sigma(points) == pytest.approx(spread, rel=0.05)


def test_camera_without_covariance_has_no_sigma() -> None:
    pinhole = PinholeCamera(
        image_size=(640, 480), rotation_vector=(0, 0, 0), focal=(900, 900), centre=(320, 240), translation=(0, 0, 1)
    )
    assert np.isnan(CAMERA.calibration_sigma(np.zeros((2, 3))))
    assert np.isnan(pinhole.calibration_sigma(np.zeros((2, 3))))

import numpy as np
import pytest
import stereo

from rafl.calibration.camera import OrthographicCamera, PinholeCamera
from rafl.calibration.foreign.camera import ForeignCamera
from rafl.calibration.foreign.placement import KnownPoints, place_rig
from rafl.calibration.rig import Rig
from rafl.common.errors import InputError


def stereo_rig() -> Rig:
    """The pair with the left camera's frame as world."""
    turn, shift = stereo.relative_pose()
    poses = {"left": (np.eye(3), np.zeros(3)), "right": (turn, shift)}
    cameras = {
        name: ForeignCamera(name, stereo.MATRICES[name], *pose, tuple(stereo.DISTORTIONS[name])).pinhole(
            1e-3, stereo.SIZE
        )
        for name, pose in poses.items()
    }
    return Rig(dict(cameras))


@pytest.mark.parametrize("flat", [False, True], ids=["points in space", "points on a face"])
def test_a_stereo_pair_is_placed_in_the_frame_of_known_points(flat: bool) -> None:
    points_mm = stereo.POINTS_MM * ([1.0, 0.0, 1.0] if flat else 1.0)
    views = {name: KnownPoints(1e-3 * points_mm, stereo.opencv_pixels(name, points_mm)) for name in stereo.MATRICES}
    placed = place_rig(stereo_rig(), views)
    for name, camera in placed.cameras.items():
        assert isinstance(camera, PinholeCamera)
        np.testing.assert_allclose(camera.rotation, stereo.rotation(name), atol=1e-7)
        np.testing.assert_allclose(camera.translation, 1e-3 * stereo.TRANSLATIONS_MM[name], atol=1e-7)
        assert camera.residual < 1e-5


def test_other_cameras_are_refused() -> None:
    rig = Rig({"left": OrthographicCamera(image_size=stereo.SIZE, rotation_vector=(0.0, 0.0, 0.0), scale=(1.0, 1.0))})
    with pytest.raises(InputError, match="expected a calibration of pinhole cameras, found another camera left"):
        place_rig(rig, {"left": KnownPoints(np.zeros((4, 3)), np.zeros((4, 2)))})

"""evaluation.h5: what is written is read again, and damaged files are refused."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from evaluated import make_evaluation

from rafl.common.errors import InputError
from rafl.evaluation.evaluation_file import read_evaluation, write_evaluation


def test_evaluation_is_read_as_written(tmp_path: Path) -> None:
    """Errors are exact, as errors.csv has them; positions have the precision of float32."""
    written = make_evaluation()
    write_evaluation(tmp_path / "evaluation.h5", written)
    found = read_evaluation(tmp_path / "evaluation.h5")
    assert found.models == written.models
    for one, other in zip(written.comparisons, found.comparisons, strict=True):
        assert (one.dataset, one.recording, one.split) == (other.dataset, other.recording, other.split)
        assert one.marker_names == other.marker_names
        np.testing.assert_array_equal(one.surface.faces, other.surface.faces)
        np.testing.assert_array_equal(np.isnan(one.recorded), np.isnan(other.recorded))
        np.testing.assert_allclose(one.recorded, other.recorded, atol=1e-8)
        assert list(one.motions) == list(other.motions)
        for method, motion in one.motions.items():
            np.testing.assert_allclose(one.distances[method], other.distances[method], rtol=1e-6)
            np.testing.assert_allclose(one.rest_distances[method], other.rest_distances[method], rtol=1e-6)
            np.testing.assert_array_equal(motion.vertices, other.motions[method].vertices)
            np.testing.assert_array_equal(motion.strain, other.motions[method].strain)
            assert (motion.force is None) == (other.motions[method].force is None)
            assert one.strains[method] == other.strains[method]


def test_bodies_beyond_a_size_are_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of the test recording stay. All markers and errors are written."""
    written = make_evaluation()
    arrays = [array for motion in written.comparisons[0].motions.values() for array in vars(motion).values()]
    size = sum(array.nbytes for array in arrays if array is not None)
    monkeypatch.setattr("rafl.evaluation.evaluation_file.MAX_MOTION_BYTES", 1.5 * size)
    write_evaluation(tmp_path / "evaluation.h5", written)
    found = read_evaluation(tmp_path / "evaluation.h5").comparisons
    assert [list(item.motions) for item in found] == [[], [], list(written.comparisons[2].motions)]
    assert [list(item.simulated) for item in found] == [list(item.errors) for item in written.comparisons]


def test_names_of_any_kind_are_kept(tmp_path: Path) -> None:
    name = "rafl (</script> a/b \N{GREEK SMALL LETTER MU})"
    evaluation = make_evaluation((*make_evaluation().comparisons[0].motions, name))
    write_evaluation(tmp_path / "evaluation.h5", evaluation)
    assert name in read_evaluation(tmp_path / "evaluation.h5").comparisons[0].motions


def _newer(file: h5py.File) -> None:
    file.attrs["format"] = "rafl-evaluation/2"


def _short(file: h5py.File) -> None:
    own = file["recordings/0/methods/1"]
    markers = own["markers"][:-1]
    del own["markers"]
    own["markers"] = markers


def _beyond(file: h5py.File) -> None:
    file["recordings/1/faces"][0, 0] = 10_000


def _endless(file: h5py.File) -> None:
    file["recordings/1/methods/0/vertices"][3, 2, 1] = np.inf


def _without_baseline(file: h5py.File) -> None:
    file["recordings/0/methods/0"].attrs["method"] = "other"


def _renamed(file: h5py.File) -> None:
    file["recordings/1/methods/1"].attrs["method"] = "other"


def _unsplit(file: h5py.File) -> None:
    file["recordings/2"].attrs["split"] = "all"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_newer, "newer than this program's rafl-evaluation/1"),
        (_short, "recordings/0/methods/1/markers: expected shape"),
        (_beyond, "recordings/1/faces: expected indices below"),
        (_endless, "recordings/1/methods/0/vertices: expected finite numbers"),
        (_without_baseline, "expected the method original"),
        (_renamed, "expected the methods of the dataset's other recordings"),
        (_unsplit, "expected split train, val, test, found 'all'"),
    ],
)
def test_damaged_evaluation_is_refused(change: Callable[[h5py.File], None], message: str, tmp_path: Path) -> None:
    path = tmp_path / "evaluation.h5"
    write_evaluation(path, make_evaluation())
    with h5py.File(path, "r+") as file:
        change(file)
    with pytest.raises(InputError, match=message):
        read_evaluation(path)


def test_evaluation_without_recordings_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="recordings"):
        write_evaluation(tmp_path / "evaluation.h5", replace(make_evaluation(), comparisons=[]))
    assert not list(tmp_path.iterdir())

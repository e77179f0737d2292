from dataclasses import replace
from pathlib import Path

import pytest

from rafl.common.errors import InputError
from rafl.data.dataset import Dataset
from rafl.data.dataset_file import read_datasets, write_dataset


def test_datasets_of_one_specimen_are_named_after_their_files(dataset: Dataset, tmp_path: Path) -> None:
    other = replace(dataset, recipe="another day")
    paths = [tmp_path / "monday.h5", tmp_path / "tuesday.h5"]
    for path, own in zip(paths, (dataset, other), strict=True):
        write_dataset(path, own)
    assert [own.name for own in read_datasets(paths)] == ["monday", "tuesday"]
    assert [own.name for own in read_datasets(paths[:1])] == [dataset.name]
    (tmp_path / "more").mkdir()
    write_dataset(tmp_path / "more" / "monday.h5", other)
    with pytest.raises(InputError, match="different names, found monday 2 times"):
        read_datasets([paths[0], tmp_path / "more" / "monday.h5"])

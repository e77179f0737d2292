"""Tables of a sweep: means over seeds, and the baseline simulator once for every dataset."""

from pathlib import Path

import pytest

from rafl.batch.unit import create_unit
from rafl.common.errors import InputError
from rafl.sweep.cells import Cell
from rafl.sweep.results import by_method, gather, summarise

HEAD = "dataset,recording,split,method,mean_mm,std_mm\n"


def cell(folder: Path, seed: int, error: float) -> Cell:
    own = folder / str(seed)
    own.mkdir()
    rows = [
        f"d,{name},test,{method},{value},0" for name in "ab" for method, value in (("original", 4), ("rafl", error))
    ]
    (own / "errors.csv").write_text(HEAD + "\n".join(rows) + "\n")
    return Cell(create_unit(str(seed), ["true"], []), own, "thick", "field", seed, "thin")


def test_means_over_seeds(tmp_path: Path) -> None:
    errors = gather([cell(tmp_path, 1, 1.0), cell(tmp_path, 2, 2.0)])
    assert errors["method"].tolist() == ["original", "field", "field"]
    assert errors["seed"].tolist() == ["", "1", "2"]
    assert errors["recordings"].tolist() == [2, 2, 2]
    summary = summarise(errors)
    assert summary["mean_mm"].tolist() == [4.0, 1.5]
    assert summary["seeds"].tolist() == [1, 2]
    assert summary["std_mm"].tolist()[1] == pytest.approx(0.5**0.5)
    assert by_method(summary)["mean_mm"].tolist() == [4.0, 1.5]
    assert summarise(gather([])).empty


@pytest.mark.parametrize("text", ["", "a,b\n1,2\n", HEAD + "d,a,test,rafl,much,0\n"])
def test_damaged_tables_are_refused(tmp_path: Path, text: str) -> None:
    broken = cell(tmp_path, 1, 1.0)
    (broken.folder / "errors.csv").write_text(text)
    with pytest.raises(InputError, match=r"errors\.csv.*run\s+the sweep again"):
        gather([broken])

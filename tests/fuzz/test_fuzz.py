"""A short form of `make fuzz`: some sixty trials that take a second or less each, in this process."""

from pathlib import Path

import pytest
from fuzz import prepare
from trials import FAULTS, Outcome, trial

SEEDS = range(2_000, 2_060)


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return prepare(tmp_path_factory.mktemp("fuzz"))


def test_changed_files_and_faults_end_in_one_line_and_harm_nothing(laboratory: Path, tmp_path: Path) -> None:
    outcomes = [trial(seed, laboratory, tmp_path / str(seed)) for seed in SEEDS]
    assert [item for item in outcomes if item.wrong] == []
    assert sum(item.code == 2 for item in outcomes) > len(outcomes) // 2
    assert len({item.target for item in outcomes}) > 10


def test_harm_is_found(laboratory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A command that leaves a file, or lets an error through, is found out."""

    def careless(line: tuple[str, ...]) -> tuple[int, str, BaseException | None]:
        Path("out/partial.h5").write_bytes(b"")
        return 2, "error: too bad\n", None

    monkeypatch.setattr("trials.run_line", careless)
    assert "files changed: ['a/b/out/partial.h5']" in outcome(laboratory, tmp_path).wrong
    monkeypatch.setattr("trials.run_line", lambda line: (1, "", ValueError("raw")))
    assert "ValueError: raw" in outcome(laboratory, tmp_path).wrong
    monkeypatch.setattr("trials.run_line", lambda line: (2, "error: a\nerror: b\n", None))
    assert "expected one line" in outcome(laboratory, tmp_path).wrong


def outcome(laboratory: Path, folder: Path) -> Outcome:
    """Of a trial without a fault."""
    found = trial(3, laboratory, folder / "trial")
    assert found.kind not in FAULTS
    return found

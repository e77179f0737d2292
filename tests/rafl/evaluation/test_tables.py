"""Tables of errors for LaTeX and spreadsheets: names in them are text."""

import pandas as pd
import pytest

from rafl.common.text_tables import cell_text, spreadsheet_text
from rafl.evaluation.metrics import latex_table


def test_names_in_latex_are_text() -> None:
    rows = [
        {
            "dataset": "clamped_beam",
            "split": "test",
            "recordings": 1,
            "method": "original",
            "mean_mm": 2.0,
            "std_mm": 0.1,
        }
    ]
    rows.append({**rows[0], "method": "rafl (a&b$^{~}\\input%#)", "mean_mm": 1.0})
    text = latex_table(pd.DataFrame(rows))
    assert r"clamped\_beam & $2.000 \pm 0.100$ & $\underline{\mathbf{1.000 \pm 0.100}}$ \\" in text
    assert r"rafl (a\&b\$\textasciicircum{}\{\textasciitilde{}\}\textbackslash{}input\%\#)" in text


@pytest.mark.parametrize("name", ["=cmd|'/c calc'!A1", "+1", "-x", "@sum", "L1", "'quoted'", "a=b", ""])
def test_no_cell_is_a_formula(name: str) -> None:
    cell = spreadsheet_text(name)
    assert not cell.startswith(("=", "+", "-", "@"))
    assert cell_text(cell) == name

"""The results page: its data, its tables, and the file that holds all of it."""

import base64
import hashlib
import json
import re
import zlib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from evaluated import LOST, make_comparison, make_evaluation

from rafl.evaluation import page_file
from rafl.evaluation.evaluation_file import Evaluation
from rafl.evaluation.metrics import BASELINE
from rafl.evaluation.page_data import PageData, pack_motion
from rafl.evaluation.tables import page_tables


def unpack(content: bytes) -> tuple[dict[str, Any], dict[tuple[str, str], np.ndarray]]:
    """Header and arrays (by key and method) of a packed motion, decoded as `pack_motion` describes."""
    length = int.from_bytes(content[:4], "little")
    header, at = json.loads(content[4 : 4 + length]), 4 + length
    arrays = {}
    for about in header["arrays"]:
        planes = np.frombuffer(zlib.decompress(content[at : at + about["bytes"]]), np.uint8).reshape(2, -1)
        at += about["bytes"]
        changes = (planes[0] + 256 * planes[1].astype(np.uint32)).reshape(about["shape"])
        codes = np.cumsum(changes, axis=0).astype(np.uint16).view(np.int16).astype(float)
        values = about["offset"] + about["scale"] * codes
        arrays[about["key"], about["method"]] = np.where(codes == -32768, np.nan, values)
    assert at == len(content)
    return header, arrays


def test_motion_is_packed_to_a_65000th_of_its_range() -> None:
    item = make_comparison()
    header, arrays = unpack(pack_motion(item))
    assert header["markers"] == list(item.marker_names)
    assert header["stride"] == 1
    expected = {("recorded", ""): item.recorded}
    for method, motion in item.motions.items():
        expected[("vertices", method)], expected[("strain", method)] = motion.vertices, motion.strain
        expected[("markers", method)] = item.simulated[method]
        expected[("error", method)] = np.linalg.norm(item.simulated[method] - item.recorded, axis=-1)
    expected[("force", "rafl")] = item.motions["rafl"].force
    assert set(arrays) == set(expected)
    for key, values in expected.items():
        assert values is not None
        allowed = 0.51 * (np.nanmax(values) - np.nanmin(values)) / 65534 + 1e-12
        assert np.array_equal(np.isnan(arrays[key]), np.isnan(values))
        assert np.nanmax(np.abs(arrays[key] - values)) <= allowed, key
    assert np.isnan(arrays["recorded", ""][LOST[1], LOST[0]]).all()


def test_long_motion_is_thinned_out_for_a_file() -> None:
    item = make_comparison(frames=100)
    header, arrays = unpack(pack_motion(item, 30))
    assert header["stride"] == 4
    assert len(header["time"]) == len(arrays["vertices", "rafl"]) == 25
    assert header["time"][1] == pytest.approx(item.time[4])


def test_constant_and_missing_values_are_packed() -> None:
    item = make_comparison()
    item.recorded[:, 1] = np.nan
    still = {BASELINE: replace(item.motions[BASELINE], strain=np.zeros_like(item.motions[BASELINE].strain))}
    _, arrays = unpack(pack_motion(replace(item, motions=still)))
    assert np.isnan(arrays["recorded", ""][:, 1]).all()
    assert (arrays["strain", BASELINE] == 0.0).all()


def test_tables_hold_what_was_evaluated() -> None:
    worse = make_comparison("load100g", dataset="plate")
    distances = {BASELINE: worse.distances[BASELINE], "rafl": 3.0 * worse.distances[BASELINE]}
    comparisons = [*make_evaluation(count=4).comparisons, replace(worse, distances=distances)]
    tables = {table["title"]: table for table in page_tables(comparisons)}
    assert list(tables) == [
        "Error of simulated markers",
        "Transfer",
        "Frequency, damping, rest position",
        "Error of each recording",
    ]
    splits = [[cell["text"] for cell in row["cells"]] for row in tables["Error of simulated markers"]["rows"]]
    assert [row[:3] for row in splits] == [
        ["beam", "train", "1"],
        ["beam", "val", "1"],
        ["beam", "test", "2"],
        ["plate", "test", "1"],
    ]
    item = comparisons[0]
    error, deviation = 1e3 * item.errors["rafl"].mean(), 1e3 * item.errors["rafl"].std()
    assert splits[0][4] == f"{error:.3f} \N{PLUS-MINUS SIGN} {deviation:.3f}"
    first = tables["Error of simulated markers"]["rows"][0]["cells"]
    assert [cell["style"] for cell in first[3:]] == ["", "better best"]
    transfer = tables["Transfer"]["rows"]
    assert [cell["style"] for cell in transfer[1]["cells"]] == ["", "", "worse", ""]
    assert transfer[1]["cells"][-1]["text"] == "1"
    motions = tables["Frequency, damping, rest position"]["rows"]
    assert [row["cells"][2]["text"] for row in motions[:3]] == ["recorded", BASELINE, "rafl"]
    assert float(motions[0]["cells"][3]["text"]) == pytest.approx(30.0 / (2.0 * np.pi), rel=0.02)
    assert [row["recording"] for row in tables["Error of each recording"]["rows"]] == list(range(5))


def page_parts(page: str) -> tuple[str, dict[str, str], str, str]:
    """Policy, data blocks by id, style and script of a page in one file."""
    (policy,) = re.findall(r'http-equiv="Content-Security-Policy" content="([^"]+)"', page)
    blocks = dict(re.findall(r'<script type="(?:application/json|text/plain)" id="([^"]+)">([^<]*)</script>', page))
    (style,) = re.findall(r"<style>(.*?)</style>", page, re.DOTALL)
    (script,) = re.findall(r'<script type="module">(.*?)</script>', page, re.DOTALL)
    return policy, blocks, style, script


def digest(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def test_file_holds_all_of_the_page_and_lets_nothing_else_run() -> None:
    data = PageData.of_evaluation(make_evaluation(), "Evaluation x")
    page = page_file.page_file(data)
    policy, blocks, style, script = page_parts(page)
    directives = dict(part.strip().split(" ", 1) for part in policy.split(";"))
    assert directives["default-src"] == "'none'"
    assert directives["script-src"] == digest(script)
    assert directives["style-src"] == digest(style)
    assert "connect-src" not in directives
    assert not re.search(r"""(src|href)=["']""", page.replace(script, ""))
    assert json.loads(blocks.pop("summary")) == json.loads(json.dumps(data.summary()))
    assert set(blocks) == {"motion-0", "motion-1", "motion-2"}
    assert base64.b64decode(blocks["motion-1"]) == pack_motion(data.recordings[1])


def test_hostile_names_stay_in_the_data() -> None:
    name = "</script><img src=x onerror=alert(1)><!--<script>"
    item = replace(make_comparison(name, methods=(BASELINE, name)), dataset=name)
    item = replace(item, marker_names=(name, *item.marker_names[1:]))
    page = page_file.page_file(PageData.of_evaluation(Evaluation([item], name), name))
    policy, blocks, _, script = page_parts(page)
    assert json.loads(blocks["summary"])["recordings"][0]["recording"] == name
    assert digest(script) in policy
    assert "<img" not in page
    assert page.count("<script") == page.count("</script>") == 3


def test_file_leaves_out_motions_beyond_its_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """Recordings of split test come first."""
    data = PageData.of_evaluation(make_evaluation(count=5), "x")
    size = len(base64.b64encode(pack_motion(data.recordings[0])))
    monkeypatch.setattr(page_file, "MAX_BYTES", int(3.5 * size))
    _, blocks, _, _ = page_parts(page_file.page_file(data))
    assert set(blocks) == {"summary", "motion-2", "motion-3", "motion-4"}


def test_module_of_an_unknown_form_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else the file would hold a script that does not run."""
    original = page_file.static_text
    odd = 'import { a } from "./elsewhere.js";\n'
    monkeypatch.setattr(page_file, "static_text", lambda name: odd if name == "results/tables.js" else original(name))
    with pytest.raises(ValueError, match=r"results/tables.js: expected imports"):
        page_file.page_file(PageData.of_evaluation(make_evaluation(), "x"))

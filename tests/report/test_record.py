"""The record says what happened, and can be read by anything."""

import json
import math
from dataclasses import replace

import pytest
import torch
from nested_settings import settings_of
from report_pairs import pictures_of

from torchdeform.report.record import describe, write_json


def test_record_is_plain_json(tmp_path, make_image, make_result):
    fixed, moving = pictures_of(make_image, 3)
    settings = settings_of(window=7)
    result = replace(make_result(fixed, moving, settings), similarity_after=torch.tensor([math.nan]))
    write_json(describe(result, fixed, moving), tmp_path / "result.json")
    text = (tmp_path / "result.json").read_text(encoding="utf-8")
    record = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert record["similarity_after"] is None
    assert record["similarity_before"] == pytest.approx(0.1)
    assert record["settings"]["similarity"]["window"] == 7
    assert record["fixed"]["size"] == [31, 26, 20]
    assert record["folds"] == 0
    assert record["verdict"]["kind"] == "good"
    assert record["evidence"]["information"] == 0.7
    assert 0 < record["determinant_min"] < 1 < record["determinant_max"]
    assert len(record["levels"]) == 2
    assert set(record["versions"]) == {"torchdeform", "torch", "python"}


def test_tissue_is_told_by_label(tmp_path, make_full):
    write_json(make_full(3)[1], tmp_path / "result.json")
    record = json.loads((tmp_path / "result.json").read_text(encoding="utf-8"))
    assert record["settings"]["tissues"] == {"1": "rigid", "2": "incompressible", "3": "stiff", "14": {"div": 50.0}}
    first, *_, last = record["tissue"]
    assert first == {
        "label": 1, "kind": "rigid", "sliding": False, "nodes": 1234,
        "before": {"residual": 0.3123, "off": 0.04, "volume": 1.01},
        "after": {"residual": 0.02, "off": 1e-4, "volume": 1.0},
    }  # fmt: skip
    assert (last["sliding"], last["nodes"], last["before"]["volume"]) == (True, 0, None)
    assert make_full(2, tissue=False)[1]["tissue"] == []


@pytest.mark.parametrize(("unit", "factor"), [("px", 1), ("mm", 1), ("µm", 1000)])
def test_distances_are_in_the_unit_of_the_fixed_image(make_full, unit, factor):
    _, record = make_full(2, unit=unit)
    stage = record["evaluation"]["after"]
    assert (record["unit"], record["moving"]["unit"]) == (unit, unit)
    assert stage["landmark_error_mean"] == pytest.approx(1.5 * factor)
    assert stage["hausdorff_95"]["1"] == pytest.approx(1.25 * factor)
    assert record["moving"]["spacing"] == pytest.approx([1.1 * factor] * 2)

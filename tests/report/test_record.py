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
    assert 0 < record["determinant_min"] < 1 < record["determinant_max"]
    assert len(record["levels"]) == 2
    assert set(record["versions"]) == {"torchdeform", "torch", "python"}

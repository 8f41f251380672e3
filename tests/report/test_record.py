"""The record and the overview: they say what happened, and can be read by anything."""

import json
import math
from dataclasses import replace

import pytest
import torch

from torchdeform.registration.settings import RegistrationSettings
from torchdeform.report.figures import write_overview
from torchdeform.report.record import describe, write_json
from torchdeform.report.report_data import make_report_data


def _pair(make_image, dim, channels=1):
    shape = (20, 26, 31)[-dim:]
    kind = "uint8" if channels > 1 else "float32"
    fixed = make_image(shape, (2.0, 1.0, 0.5)[-dim:], channels=channels, pixel_type=kind, tilted=dim == 3)
    moving = make_image(tuple(n - 3 for n in shape), (2.0, 1.1, 0.6)[-dim:], channels=channels, pixel_type=kind)
    return fixed, moving


def _pixels(path) -> torch.Tensor:
    from torchdeform.io import read_image

    return read_image(path).data[0, :3]


@pytest.mark.parametrize(("dim", "channels"), [(2, 1), (2, 3), (2, 4), (3, 1)])
def test_overview_is_drawn(tmp_path, make_image, make_result, dim, channels):
    fixed, moving = _pair(make_image, dim, channels)
    write_overview(tmp_path / "overview.png", make_report_data(fixed, moving, make_result(fixed, moving)))
    pixels = _pixels(tmp_path / "overview.png")
    assert min(pixels.shape[1:]) > 400
    assert pixels.std() > 20


@pytest.mark.parametrize("dim", [2, 3])
def test_overview_survives_odd_results(tmp_path, make_image, make_result, dim):
    """Folds, no levels and a long thin grid are drawn too."""
    fixed = make_image((64, 9, 8)[-dim:] if dim == 3 else (9, 200))
    result = make_result(fixed, fixed)
    folded = replace(result, displacement=result.displacement * 40, levels=())
    write_overview(tmp_path / "overview.png", make_report_data(fixed, fixed, folded, slices=1))
    assert _pixels(tmp_path / "overview.png").std() > 5


def test_overview_is_the_same_every_time(tmp_path, make_image, make_result):
    fixed, moving = _pair(make_image, 2)
    for name in ("a.png", "b.png"):
        write_overview(tmp_path / name, make_report_data(fixed, moving, make_result(fixed, moving)))
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_record_is_plain_json(tmp_path, make_image, make_result):
    fixed, moving = _pair(make_image, 3)
    settings = RegistrationSettings(window=7)
    result = replace(make_result(fixed, moving, settings), similarity_after=torch.tensor([math.nan]))
    write_json(describe(result, fixed, moving), tmp_path / "result.json")
    text = (tmp_path / "result.json").read_text(encoding="utf-8")
    record = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert record["similarity_after"] is None
    assert record["similarity_before"] == pytest.approx(0.1)
    assert record["settings"]["window"] == 7
    assert record["fixed"]["size"] == [31, 26, 20]
    assert record["folds"] == 0
    assert 0 < record["determinant_min"] < 1 < record["determinant_max"]
    assert len(record["levels"]) == 2
    assert set(record["versions"]) == {"torchdeform", "torch", "python"}

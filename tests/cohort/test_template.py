"""A template of files: what is written, that it is what the library makes, going on after a stop, broken images."""

import json
import os
from pathlib import Path

import pytest
import torch
from cohort_files import GRID, cohort, write_images

from torchdeform import AveragingSettings, build_template
from torchdeform.cohort.schema import read_cohort
from torchdeform.cohort.settings import TemplateSettings
from torchdeform.cohort.template import Built, build
from torchdeform.errors import ComputationError, InputError
from torchdeform.io import read_image, read_labels, read_transform


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Built:
    folder = tmp_path_factory.mktemp("template")
    write_images(folder / "images")
    return build(cohort(folder))


def ages(folder: Path) -> dict[Path, int]:
    """When each result was written; journals and summaries grow with every run."""
    return {p: p.stat().st_mtime_ns for p in folder.rglob("*") if p.suffix in (".h5", ".gz") or p.name == "round.json"}


def test_everything_is_written(built):
    record = json.loads((built.folder / "result.json").read_text(encoding="utf-8"))
    assert record["images"].keys() == {"sub-0", "sub-1", "sub-2"}
    assert record["left_out"] == {}
    assert all((built.folder / name).is_file() for name in record["files"])
    assert {"template.nii.gz", "overview.png", "subjects/sub-1/warped_labels.nii.gz"} <= set(record["files"])
    assert all(one["folds"] == 0 and one["determinant_min"] > 0 for one in record["images"].values())
    first, second = record["rounds"]
    assert first["bias_voxels"][0] > 1
    assert second["bias_voxels"][0] < first["bias_voxels"][0] / 2
    assert not (built.folder / "rounds" / "1" / "pairs" / "sub-0").exists()  # the reference itself


@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        ({"sliding": [1]}, "tissues and sliding are for pairs, a template has none; remove them"),
        ({"labels_weight": 1.0}, r"labels that pull \(labels_weight\) are for pairs, a template has none"),
        ({"features": "files"}, "features: files are for pairs, a template has none; remove them"),
        ({"features": "missing.ts"}, "features: .*missing.ts does not exist"),
    ],
)
def test_settings_that_do_not_suit_a_template_are_refused_before_any_round(tmp_path, settings, problem):
    write_images(tmp_path / "images")
    asked = cohort(tmp_path).model_copy(update={"settings": settings})
    with pytest.raises(InputError, match=problem):
        build(asked)
    assert not asked.out.exists()


def test_it_is_what_the_library_makes(built):
    images = [read_image(built.folder.parent / "images" / f"sub-{i}.nii.gz") for i in range(3)]
    wanted = build_template(images, cohort(built.folder.parent).resolve(), rounds=2)
    torch.testing.assert_close(read_image(built.folder / "template.nii.gz").data, wanted.image.data, atol=0.5, rtol=0)


def test_transforms_take_points_and_images_the_ways_they_say(built):
    subject, template = built.folder / "subjects" / "sub-1", read_image(built.folder / "template.nii.gz")
    forward, back = read_transform(subject / "transform.h5"), read_transform(subject / "inverse.h5")
    image = read_image(built.folder.parent / "images" / "sub-1.nii.gz")
    warped = read_image(subject / "warped.nii.gz").data
    torch.testing.assert_close(forward.image(image, template, outside="auto").data, warped, atol=1e-2, rtol=1e-4)
    points = template.to_world(GRID.points(dtype=torch.float64))[..., 8:-8, 8:-8]
    assert float((back.points(forward.points(points)) - points).norm(dim=1).mean()) < 0.02
    regions = [read_labels(built.folder / "subjects" / f"sub-{i}" / "warped_labels.nii.gz").data for i in range(3)]
    assert float((regions[0] == regions[1]).double().mean()) > 0.97
    assert float((regions[0] == regions[2]).double().mean()) > 0.97


def test_a_second_run_makes_nothing_anew(built):
    before, said = ages(built.folder), []
    again = build(cohort(built.folder.parent), report=lambda number, event: said.append((number, event.kind)))
    assert ages(built.folder) == before
    assert {kind for _, kind in said} == {"begin", "skipped", "end"}
    assert {number for number, _ in said} == {1, 2}
    assert again.record["images"] == json.loads(json.dumps(built.record["images"]))


def test_what_a_stop_left_undone_is_done_the_same(built):
    template, record = built.folder / "template.nii.gz", built.folder / "result.json"
    wanted = read_image(template).data
    subject = built.folder / "subjects" / "sub-2" / "warped.nii.gz"
    for lost in (template, record, subject, built.folder / "rounds" / "2" / "template.nii.gz"):
        lost.unlink()
        build(cohort(built.folder.parent))
        assert lost.is_file()
        assert torch.equal(read_image(template).data, wanted)


def test_a_reference_that_cannot_be_read_ends_it_with_the_reason(tmp_path):
    write_images(tmp_path / "images", 2)
    (tmp_path / "images" / "sub-0.nii.gz").write_bytes(b"nothing")
    with pytest.raises(ComputationError, match=r"a template needs 2 images, and 1 are left: .*sub-0"):
        build(cohort(tmp_path))
    assert not (tmp_path / "out" / "template.nii.gz").exists()


def test_one_image_is_too_few(tmp_path):
    write_images(tmp_path / "images", 1)
    with pytest.raises(InputError, match="needs at least 2 images, got 1"):
        build(cohort(tmp_path))


@pytest.mark.parametrize("line", ["pose: middle", "corrections: 0", "tolerance: -1", "round: 3", "reference: 3"])
def test_wrong_settings_are_refused(tmp_path, line):
    with pytest.raises(InputError, match=f"template.*{line.split(':')[0]}"):
        cohort(tmp_path, more=line)
    with pytest.raises(InputError, match="rounds"):
        cohort(tmp_path, rounds=0)


def test_the_defaults_are_those_of_the_library():
    assert TemplateSettings().averaging == AveragingSettings()


def test_the_shipped_cohorts_can_be_read(root, monkeypatch):
    monkeypatch.setenv("TORCHDEFORM_DATA", os.environ.get("TORCHDEFORM_DATA", str(root.parent / "shared" / "data")))
    found = {path.stem for path in (root / "configs").glob("template_*.yaml") if read_cohort(path).images is not None}
    assert {"template_example", "template_brains"} <= found

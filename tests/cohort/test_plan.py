"""Plans: jobs with settings and places of their own, problems told, collisions refused, costs, and the verb."""

import json
import math
from pathlib import Path

import pytest
import torch

from torchdeform.cli.main import torchdeform
from torchdeform.cohort.estimate import Costs, estimate
from torchdeform.cohort.plan import Job, description, plan, register_job
from torchdeform.cohort.schema import read_cohort
from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.errors import InputError
from torchdeform.io import write_image
from torchdeform.io.learn2reg import voxel_displacement, write_voxel_displacement
from torchdeform.pipeline.config import configs_folder, load_settings
from torchdeform.pipeline.register import PairFiles

_PATTERN = "pairs: {pattern: {files: 'sub-{subject}_ses-{session}.png', pairing: consecutive, within: [subject]}}\n"
_IMAGES = [f"sub-{subject}_ses-{session}.png" for subject in ("a", "b") for session in (1, 2)]


def test_jobs_have_everything_resolved(touch, cohort_of, tmp_path):
    touch(_IMAGES)
    work = plan(cohort_of(f"preset: fast\nsettings: {{window: 5}}\ndevice: cpu\nmemory: 1GB\n{_PATTERN}"))
    job = work.jobs[0]
    assert (len(work.jobs), work.problems, work.out) == (2, (), tmp_path / "results")
    assert job.files.out == tmp_path / "results" / "sub-a" / "sub-a_from-ses2_to-ses1"
    assert job.settings == load_settings("fast", overrides={"window": 5})
    assert (job.device, job.memory, job.submission, job.voxels) == ("cpu", 10**9, None, False)
    assert job.files.fixed.is_absolute()


def test_settings_of_a_pair_are_its_own(touch, cohort_of, tmp_path):
    touch(["a.png", "b.png"])
    (tmp_path / "t.csv").write_text("fixed,moving,settings.window\na.png,b.png,7\nb.png,a.png,\n", encoding="utf-8")
    one, other = plan(cohort_of("settings: {window: 5}\npairs: {table: {file: t.csv}}\n")).jobs
    assert (one.settings.window, other.settings.window) == (7, 5)
    (tmp_path / "t.csv").write_text("fixed,moving,settings.windw\na.png,b.png,7\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"t.csv line 2: .*no setting 'windw'; did you mean 'window'"):
        plan(cohort_of("pairs: {table: {file: t.csv}}\n"))


def test_missing_files_are_problems_and_the_rest_is_not(touch, cohort_of, tmp_path):
    touch(["a.png", "b.png"])
    rows = [
        "fixed,moving,fixed_labels,moving_mask",
        "a.png,b.png,,",
        "a.png,c.png,,",
        "b.png,a.png,a.png,",
        "b.png,b.png,,m",
    ]
    (tmp_path / "t.csv").write_text("\n".join(rows), encoding="utf-8")
    work = plan(cohort_of("pairs: {table: {file: t.csv}}\n"))
    assert [job.name for job in work.jobs] == ["from-b_to-a"]
    assert [problem.name for problem in work.problems] == ["from-c_to-a", "from-a_to-b", "from-b_to-b"]
    sentences = [problem.sentence for problem in work.problems]
    assert sentences[0] == f"moving {tmp_path / 'c.png'} does not exist; check {tmp_path / 't.csv'} line 3"
    assert "fixed_labels needs moving_labels too" in sentences[1]
    assert "moving_mask" in sentences[2]


@pytest.mark.parametrize(
    ("pairs", "sentence"),
    [
        (
            "{fixed: a.png, moving: b.png}, {fixed: x/a.png, moving: y/b.png}",
            "both be called from-b_to-a; give each its own",
        ),
        ("{name: a, fixed: a.png, moving: b.png}, {name: A, fixed: b.png, moving: a.png}", "both be called A"),
        ("{name: logs, fixed: a.png, moving: b.png}", "cannot be called logs"),
        ("{name: Summary.csv, fixed: a.png, moving: b.png}", "cannot be called Summary.csv"),
    ],
)
def test_pairs_that_would_write_one_place_are_refused(cohort_of, pairs, sentence):
    with pytest.raises(InputError, match=sentence):
        plan(cohort_of(f"pairs: {{list: [{pairs}]}}\n"))


def test_parts_that_are_not_named_collide(touch, cohort_of):
    touch(["sub-1_run-1.png", "sub-1_run-2.png", "t.png"])
    with pytest.raises(InputError, match="would both be called sub-1"):
        plan(cohort_of("pairs: {pattern: {files: 'sub-{subject}_*.png', pairing: template, fixed: t.png}}\n"))


def test_places_are_all_inside_the_folder(touch, cohort_of, tmp_path):
    touch(["..a..__.png", "-b.png", "c d.png", "ü;$(x).png", "t/t.tif"])
    work = plan(cohort_of("pairs: {pattern: {files: '{subject}.png', pairing: template, fixed: t/t.tif}}\n"))
    assert len(work.jobs) == 3  # hidden files are no images
    for job in work.jobs:
        assert job.files.out.parent.parent == tmp_path / "results"
        assert job.files.out.resolve().is_relative_to(tmp_path / "results")


def test_a_selection_keeps_jobs_and_problems(touch, cohort_of):
    touch([*_IMAGES, "sub-c_ses-1.png"])
    work = plan(cohort_of(_PATTERN))
    assert [job.name for job in work.only(["sub-b"]).jobs] == ["sub-b_from-ses2_to-ses1"]
    assert work.only(["sub-*"]).jobs == work.jobs
    with pytest.raises(InputError, match="no pair is called 'sub-c'"):
        work.only(["sub-a", "sub-c"])


def test_description_is_that_of_derived_data():
    assert description()["DatasetType"] == "derivative"
    assert {"Name", "BIDSVersion", "GeneratedBy"} <= set(description())


# Submissions


def _pair(make_image, dim):
    """Return a fixed and a moving image that differ in size, spacing, place and orientation."""
    shapes, spacings = ((9, 8, 7), (8, 10, 9)), ((1.5, 1.0, 0.8), (1.0, 1.2, 1.1))
    fixed = make_image(shapes[0][:dim], spacings[0][:dim], origin=(3.0, -2.0, 1.0)[:dim])
    moving = make_image(shapes[1][:dim], spacings[1][:dim], origin=(2.0, -3.0, 0.5)[:dim], tilted=True)
    return fixed, moving


@pytest.mark.parametrize("dim", [2, 3])
def test_voxel_displacement_leads_to_the_same_point_of_the_world(make_image, make_displacement, dim):
    fixed, moving = _pair(make_image, dim)
    u = make_displacement(fixed.grid, 0.1)
    nodes = fixed.grid.points(dtype=torch.float64)
    index = nodes / fixed.grid.along(fixed.grid.spacing, nodes) + voxel_displacement(u, fixed, moving)
    there = moving.to_world(index * moving.grid.along(moving.grid.spacing, index))
    assert torch.allclose(there, fixed.to_world(nodes + u), atol=1e-9)


def test_submission_is_read_as_the_challenge_reads_it(make_image, make_displacement, tmp_path):
    """Its evaluation takes arrays from nibabel and samples moving at identity + displacement with map_coordinates."""
    nibabel = pytest.importorskip("nibabel")
    import numpy as np
    from scipy.ndimage import map_coordinates

    fixed, moving = _pair(make_image, 3)
    u = make_displacement(fixed.grid, 0.05)
    write_voxel_displacement(u, fixed, moving, tmp_path / "disp_0001_0002.nii.gz")
    write_image(moving, tmp_path / "moving.nii.gz")
    displacement = nibabel.load(tmp_path / "disp_0001_0002.nii.gz").get_fdata()
    values = nibabel.load(tmp_path / "moving.nii.gz").get_fdata()
    assert displacement.shape == (*fixed.grid.shape[::-1], 3)
    identity = np.meshgrid(*map(np.arange, displacement.shape[:3]), indexing="ij")
    warped = map_coordinates(values, identity + displacement.transpose(3, 0, 1, 2), order=1, cval=0.0)
    from torchdeform.core.image import resample

    ours = resample(moving, fixed, u)[0, 0].numpy().transpose()
    inside = (
        map_coordinates(np.ones_like(values), identity + displacement.transpose(3, 0, 1, 2), order=1, cval=-9.0) > 0.99
    )
    assert inside.mean() > 0.3
    assert np.abs(warped - ours)[inside].max() < 1e-2


def test_jobs_of_the_challenge_write_its_files(cohort_of, make_image, tmp_path):
    for name in ("Set_0001_0000", "Set_0002_0000"):
        write_image(make_image((12, 11, 10)), tmp_path / f"{name}.nii.gz")
        (tmp_path / f"{name}.csv").write_text("1,2,3\n4.5,5,6\n", encoding="utf-8")
    content = {
        "training": [{"image": f"./{n}.nii.gz", "keypoints": f"./{n}.csv"} for n in ("Set_0001_0000", "Set_0002_0000")],
        "registration_val": [{"fixed": "./Set_0001_0000.nii.gz", "moving": "./Set_0002_0000.nii.gz"}],
    }
    (tmp_path / "d.json").write_text(json.dumps(content), encoding="utf-8")
    (job,) = plan(cohort_of("layout: learn2reg\nsettings: {steps: [1]}\npairs: {learn2reg: {file: d.json}}\n")).jobs
    assert job.submission == tmp_path / "results" / "submission" / "disp_0001_0002.nii.gz"
    assert job.voxels
    outcome = register_job(job)
    assert job.submission.exists()
    assert outcome.record["evaluation"]["before"]["landmark_error_max"] == 0
    assert len(outcome.record["evaluation"]["before"]["landmark_errors"]) == 2


def test_two_submissions_of_one_name_are_refused(touch, cohort_of):
    touch(["A_0001_0000.nii.gz", "A_0002_0000.nii.gz", "B_0002_0000.nii.gz"])
    text = ", ".join(f"{{fixed: A_0001_0000.nii.gz, moving: {name}_0002_0000.nii.gz}}" for name in "AB")
    with pytest.raises(InputError, match=r"both be submitted as disp_0001_0002.nii.gz"):
        plan(cohort_of(f"layout: learn2reg\npairs: {{list: [{text}]}}\n"))
    with pytest.raises(InputError, match="must end in _CASE_MODALITY"):
        plan(cohort_of("layout: learn2reg\npairs: {list: [{fixed: a.png, moving: b.png}]}\n"))


# Costs


def _job(tmp_path, shape, **changes):
    write_image(Image(torch.rand(1, 1, *shape), Grid(shape)), path := tmp_path / f"{'x'.join(map(str, shape))}.nii.gz")
    settings = load_settings(overrides=changes.pop("settings", {}))
    return Job(name="a", files=PairFiles(fixed=path, moving=path, out=tmp_path), settings=settings, **changes)


def test_costs_grow_with_size_steps_and_number(tmp_path):
    small, large = _job(tmp_path, (32, 32)), _job(tmp_path, (64, 64, 64))
    slow, tight = (
        _job(tmp_path, (32, 32), settings={"symmetric": True}),
        _job(tmp_path, (64, 64, 64), memory=480_000_000),
    )
    refused = _job(tmp_path, (64, 64, 64), memory=460_000_000)
    one, two, both = estimate([small]), estimate([large]), estimate([small, large])
    assert one.seconds < two.seconds < both.seconds == pytest.approx(one.seconds + two.seconds)
    assert one.memory < two.memory == both.memory
    assert estimate([slow]).seconds > one.seconds
    assert estimate([tight]).seconds < two.seconds
    assert estimate([tight]).memory <= 480_000_000
    assert (estimate([refused]).seconds, estimate([refused]).unknown) == (0, 1)


def test_costs_of_files_that_say_nothing_are_unknown(tmp_path):
    (tmp_path / "a.png").touch()
    job = Job(
        name="a", files=PairFiles(fixed=tmp_path / "a.png", moving=tmp_path, out=tmp_path), settings=load_settings()
    )
    assert estimate([job]) == Costs(0, 0, 1)
    assert estimate([]) == Costs(0, 0, 0)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0, "0 s"), (59, "59 s"), (600, "10 min"), (5400, "1.5 h"), (1e6, "12 days"), (1e8, "1157 days")],
)
def test_times_are_readable(seconds, text):
    assert Costs(seconds, 0, 0).readable_time == text


# The verb


def _file(tmp_path, text):
    (tmp_path / "cohort.yaml").write_text(f"out: results\n{text}", encoding="utf-8")
    return str(tmp_path / "cohort.yaml")


def test_dry_run_shows_pairs_problems_and_costs_and_writes_nothing(make_image, tmp_path, capsys):
    for name in ("a", "b"):
        write_image(make_image((32, 32)), tmp_path / f"{name}.nii.gz")
    pairs = "{fixed: a.nii.gz, moving: b.nii.gz}, {name: lost, fixed: a.nii.gz, moving: no.nii.gz}"
    before = set(tmp_path.iterdir()) | {tmp_path / "cohort.yaml"}
    assert torchdeform(["batch", _file(tmp_path, f"pairs: {{list: [{pairs}]}}\n"), "--dry-run"]) == 0
    shown = capsys.readouterr().out
    assert f"from-b_to-a: {tmp_path / 'b.nii.gz'} -> {tmp_path / 'a.nii.gz'}" in shown
    assert f"cannot run: lost: moving {tmp_path / 'no.nii.gz'} does not exist" in shown
    assert "1 to register, 1 cannot run" in shown
    assert "memory" in shown
    assert set(tmp_path.iterdir()) == before


def test_print_config_is_a_file_that_can_be_read(tmp_path, capsys):
    path = _file(tmp_path, "pairs: {list: [{fixed: a.png, moving: b.png}]}\n")
    assert torchdeform(["batch", path, "--print-config"]) == 0
    (tmp_path / "printed.yaml").write_text(capsys.readouterr().out, encoding="utf-8")
    printed = read_cohort(tmp_path / "printed.yaml")
    assert printed.pairs == read_cohort(Path(path)).pairs
    assert printed.resolve() == load_settings()


def test_only_and_mistakes_at_the_shell(touch, tmp_path, capsys):
    touch(_IMAGES)
    path = _file(tmp_path, _PATTERN)
    assert torchdeform(["batch", path, "--dry-run", "--only", "sub-a"]) == 0
    assert "1 to register" in capsys.readouterr().out
    assert torchdeform(["batch", path, "--dry-run", "--only", "sub-x"]) == 2
    assert "no pair is called 'sub-x'" in capsys.readouterr().err
    assert torchdeform(["batch", _file(tmp_path, "otu: x\n")]) == 2
    assert "cohort.yaml line 2: there is no key 'otu'; did you mean 'out'?" in capsys.readouterr().err


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "count"), [("example", 2), ("mindboggle_2d", 7), ("heart_2d", 12), ("hippocampus_3d", 7)]
)
def test_shipped_cohorts_find_their_images(name, count, data_folder, monkeypatch):
    monkeypatch.setenv("TORCHDEFORM_DATA", str(data_folder))
    work = plan(read_cohort(configs_folder() / f"cohort_{name}.yaml"))
    assert (len(work.jobs), work.problems) == (count, ())
    assert all((job.files.fixed_labels is None) == (name == "example") for job in work.jobs)
    costs = estimate(work.jobs)
    assert costs.unknown == 0
    assert math.isfinite(costs.seconds)

"""Plans: jobs with settings and places of their own, problems told, collisions refused, costs, and the verb."""

import json
import math
import os

import pytest

from torchdeform.cohort.estimate import estimate
from torchdeform.cohort.plan import description, plan, register_job
from torchdeform.cohort.schema import read_cohort
from torchdeform.errors import InputError
from torchdeform.io import write_image
from torchdeform.pipeline.config import configs_folder, load_settings

_PATTERN = "pairs: {pattern: {files: 'sub-{subject}_ses-{session}.png', pairing: consecutive, within: [subject]}}\n"


_IMAGES = [f"sub-{subject}_ses-{session}.png" for subject in ("a", "b") for session in (1, 2)]


def test_jobs_have_everything_resolved(touch, cohort_of, tmp_path):
    touch(_IMAGES)
    work = plan(cohort_of(f"preset: fast\nsettings: {{similarity.window: 5}}\ndevice: cpu\nmemory: 1GB\n{_PATTERN}"))
    job = work.jobs[0]
    assert (len(work.jobs), work.problems, work.out) == (2, (), tmp_path / "results")
    assert job.files.out == tmp_path / "results" / "sub-a" / "sub-a_from-ses2_to-ses1"
    assert job.settings == load_settings("fast", overrides={"similarity.window": 5})
    assert (job.device, job.memory, job.submission, job.voxels) == ("cpu", 10**9, None, False)
    assert job.files.fixed.is_absolute()


def test_settings_of_a_pair_are_its_own(touch, cohort_of, tmp_path):
    touch(["a.png", "b.png"])
    (tmp_path / "t.csv").write_text(
        "fixed,moving,settings.similarity.window\na.png,b.png,7\nb.png,a.png,\n", encoding="utf-8"
    )
    one, other = plan(cohort_of("settings: {similarity.window: 5}\npairs: {table: {file: t.csv}}\n")).jobs
    assert (one.settings.similarity.window, other.settings.similarity.window) == (7, 5)
    (tmp_path / "t.csv").write_text("fixed,moving,settings.windw\na.png,b.png,7\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"t.csv line 2: .*no setting 'windw'; did you mean 'similarity.window'"):
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


def test_tissue_goes_with_its_settings(touch, cohort_of, tmp_path):
    """Labels 1 of one and 2 of another pair; a pair without labels, and labels that nothing is said of."""
    touch(["a.png", "b.png", "c.png", "d.png", "bones.nii"])
    rows = [
        "fixed,moving,tissue,settings.tissues.2,settings.symmetric",
        "a.png,b.png,bones.nii,,",
        "a.png,c.png,bones.nii,{div: 50},",
        "a.png,d.png,,,",
        "b.png,c.png,bones.nii,,true",
        "b.png,d.png,skin.nii,,",
    ]
    (tmp_path / "t.csv").write_text("\n".join(rows), encoding="utf-8")
    text = "settings: {tissues: {1: rigid}, sliding: [4]}\npairs: {table: {file: t.csv}}\n"
    cohort = cohort_of(text)
    work = plan(cohort)
    assert [job.settings.tissues for job in work.jobs] == [{1: "rigid"}, {1: "rigid", 2: {"div": 50.0}}]
    assert all(job.files.tissue == tmp_path / "bones.nii" and job.settings.sliding == (4,) for job in work.jobs)
    sentences = [problem.sentence for problem in work.problems]
    assert sentences[0] == (
        "tissues and sliding name labels (1, 4), but there is no tissue; give the labels of the fixed image; see "
        f"{tmp_path / 't.csv'} line 4"
    )
    assert "symmetric: tissue is known of the fixed image only" in sentences[1]
    assert "skin.nii does not exist" in sentences[2]
    assert "1: rigid" in cohort.to_yaml()
    (said,) = plan(cohort_of("pairs: {list: [{fixed: a.png, moving: b.png, tissue: bones.nii}]}\n")).problems
    assert "the settings do not say what the labels of tissue are, as tissues: {1: rigid} does; see" in said.sentence


def test_settings_of_tissue_are_wrong_where_they_stand(cohort_of):
    with pytest.raises(InputError, match=r"cohort.yaml line 3: settings: tissues: label 2 .* did you mean 'rigid'\?"):
        cohort_of("settings:\n  tissues: {2: rgid}\n")


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


def test_jobs_of_the_challenge_write_its_files(cohort_of, make_image, tmp_path):
    for name in ("Set_0001_0000", "Set_0002_0000"):
        write_image(make_image((12, 11, 10)), tmp_path / f"{name}.nii.gz")
        (tmp_path / f"{name}.csv").write_text("1,2,3\n4.5,5,6\n", encoding="utf-8")
    content = {
        "training": [{"image": f"./{n}.nii.gz", "keypoints": f"./{n}.csv"} for n in ("Set_0001_0000", "Set_0002_0000")],
        "registration_val": [{"fixed": "./Set_0001_0000.nii.gz", "moving": "./Set_0002_0000.nii.gz"}],
    }
    (tmp_path / "d.json").write_text(json.dumps(content), encoding="utf-8")
    (job,) = plan(
        cohort_of("layout: learn2reg\nsettings: {optimiser: {steps: [1]}}\npairs: {learn2reg: {file: d.json}}\n")
    ).jobs
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


def test_what_is_no_file_is_a_problem_and_nobody_waits_for_it(touch, cohort_of, tmp_path):
    touch(["a.png", "b.png"])
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "empty.png").touch()
    (tmp_path / "loop.png").symlink_to("loop.png")
    others = {
        "pipe": ("pipe.png", "is no file but a device or a pipe"),
        "device": ("/dev/zero", "is no file but a device or a pipe"),
        "empty": ("empty.png", "is empty"),
        "loop": ("loop.png", "does not exist"),
        "long": ("x" * 300 + ".png", "does not exist"),
    }
    pairs = ", ".join(f"{{name: {name}, fixed: a.png, moving: {file}}}" for name, (file, _) in others.items())
    work = plan(cohort_of(f"pairs: {{list: [{pairs}, {{name: fine, fixed: a.png, moving: b.png}}]}}\n"))
    assert [job.name for job in work.jobs] == ["fine"]
    for problem in work.problems:
        assert others[problem.name][1] in problem.sentence
        assert problem.sentence.startswith("moving ")


def test_no_pair_leads_out_of_the_results(touch, cohort_of, tmp_path):
    touch([*_IMAGES, "results/x", "elsewhere/x"])
    (tmp_path / "results" / "sub-a").symlink_to(tmp_path / "elsewhere")
    work = plan(cohort_of(_PATTERN))
    assert [job.files.out.parent.name for job in work.jobs] == ["sub-b"]
    assert "leads out of" in work.problems[0].sentence


@pytest.mark.parametrize("name", ["..", ".", "a/b", "/a", "../x", "a\\0b", "x" * 250, "", "Logs", "journal.jsonl"])
def test_names_that_no_folder_may_have_are_refused(touch, cohort_of, name):
    touch(["a.png", "b.png"])
    with pytest.raises(InputError, match=r"name|called"):
        plan(cohort_of(f'pairs: {{list: [{{name: "{name}", fixed: a.png, moving: b.png}}]}}\n'))


def test_subjects_and_names_of_patterns_stay_inside_and_short(touch, cohort_of, tmp_path):
    touch([f"{'s' * 120}..-{'t' * 120}_1.png", f"{'s' * 120}..-{'t' * 120}_2.png", ".._1.png", ".._2.png"])
    pattern = "{files: '{subject}_{run}.png', pairing: consecutive, within: [subject]}"
    for job in plan(cohort_of(f"pairs: {{pattern: {pattern}}}\n")).jobs:
        inside = job.files.out.relative_to(tmp_path / "results")
        assert ".." not in inside.parts
        assert all(len(part) <= 250 for part in inside.parts)


def test_features_and_labels_that_pull_need_their_files(touch, cohort_of, tmp_path):
    touch(["a.png", "b.png", "fa.png", "fb.png", "net.ts"])
    rows = [
        "name,fixed,moving,fixed_features,moving_features,settings.features,settings.labels_weight",
        "files,a.png,b.png,fa.png,fb.png,,",
        "program,a.png,b.png,,,net.ts,",
        "twice,a.png,b.png,fa.png,fb.png,mind,",
        "none,a.png,b.png,,,missing.ts,",
        "labels,a.png,b.png,,,,1",
        "one,a.png,b.png,fa.png,,,",
    ]
    (tmp_path / "t.csv").write_text("\n".join(rows), encoding="utf-8")
    work = plan(cohort_of("pairs: {table: {file: t.csv}}\n"))
    assert [job.name for job in work.jobs] == ["files", "program"]
    assert work.jobs[0].files.moving_features == tmp_path / "fb.png"
    assert work.jobs[1].settings.features == str(tmp_path / "net.ts")  # seen from the cohort's file
    sentences = {problem.name: problem.sentence for problem in work.problems}
    assert "features are given twice" in sentences["twice"]
    assert f"{tmp_path / 'missing.ts'} does not exist" in sentences["none"]
    assert "labels_weight needs labels of both images" in sentences["labels"]
    assert "fixed_features needs moving_features too" in sentences["one"]
    pattern = "{files: '{n}.png', parts: {n: '[ab]'}, features: 'f{n}.png', pairing: consecutive}"
    (job,) = plan(cohort_of(f"pairs: {{pattern: {pattern}}}\n")).jobs
    assert (job.files.fixed_features, job.files.moving_features) == (tmp_path / "fa.png", tmp_path / "fb.png")

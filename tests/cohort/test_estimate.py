"""What a cohort will take: memory and time from the sizes of the images and the settings."""

from dataclasses import replace

import pytest
import torch
from bad_headers import size_or_death
from nested_settings import changed

from torchdeform.cohort.estimate import Costs, estimate, measure, size_of
from torchdeform.cohort.plan import Job
from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.errors import InputError
from torchdeform.io import write_image
from torchdeform.pipeline.config import load_settings
from torchdeform.pipeline.memory import footprint
from torchdeform.pipeline.register import PairFiles


def test_needs_are_those_of_the_estimate(jobs, tmp_path):
    volume = tmp_path / "missing.nii.gz"
    unknown = replace(jobs[0], files=replace(jobs[0].files, fixed=volume))
    symmetric = replace(jobs[0], settings=changed(jobs[0].settings, symmetric=True))
    small, limited = replace(jobs[0], memory=10**12), replace(unknown, memory=5)
    one, two, none, same, five = measure([jobs[0], symmetric, unknown, small, limited])
    assert one == same > 4e8
    assert two == footprint(Grid((16, 16)), 1, symmetric.settings) > one
    assert (none, five) == (0, 5)


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
    searched = _job(tmp_path, (32, 32), settings={"start": "keypoints"})
    assert estimate([searched]).seconds > one.seconds
    assert estimate([_job(tmp_path, (32, 32), settings={"sliding": [1, 2]})]).seconds > estimate([slow]).seconds
    assert estimate([tight]).seconds < two.seconds
    assert estimate([tight]).memory <= 480_000_000
    assert (estimate([refused]).seconds, estimate([refused]).unknown) == (0, 1)


def test_a_limit_of_memory_coarsens_what_takes_more(tmp_path):
    plain, discrete, both = (
        _job(tmp_path, (64, 64, 64), memory=490_000_000, settings={"similarity": "ncc"} | some)
        for some in ({}, {"start": "discrete"}, {"symmetric": True})
    )
    free = replace(both, memory=None)
    assert estimate([discrete]).seconds < estimate([plain]).seconds
    assert estimate([both]).seconds < estimate([free]).seconds
    assert estimate([replace(both, memory=footprint(Grid((64, 64, 64)), 1, both.settings))]) == estimate([free])
    assert estimate([both]).memory == 490_000_000


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


def test_a_header_that_takes_its_reader_with_it_costs_its_pair_only(jobs, tmp_path, monkeypatch):
    monkeypatch.setattr("torchdeform.cohort.estimate.size_of", size_or_death)
    monkeypatch.setattr("torchdeform.cohort.estimate._HEADER", 5.0)
    names = ["fine.png", "crash.png", "none.png", "hang.png"]
    some = [
        replace(job, files=replace(job.files, fixed=tmp_path / name)) for job, name in zip(jobs, names, strict=True)
    ]
    needs = measure([*some, replace(some[0], name="last")])
    assert needs[0] == needs[-1] > 0
    assert needs[1] == needs[3] == 0
    costs = estimate(some)
    assert (costs.unknown, sorted(costs.unreadable)) == (2, ["b", "d"])
    assert "makes its reader crash" in costs.unreadable["b"]
    assert "keeps the reader of its header busy" in costs.unreadable["d"]


@pytest.mark.parametrize("error", [RuntimeError("what is this"), InputError("a.png is damaged"), MemoryError()])
def test_a_header_that_cannot_be_read_is_a_sentence(tmp_path, monkeypatch, error):
    def broken(_: object) -> None:
        raise error

    monkeypatch.setattr("torchdeform.cohort.estimate.image_size", broken)
    assert isinstance(size_of(tmp_path / "a.png"), str)

"""The journal and the prints of inputs: what a crash leaves can be read, and what changed is noticed."""

import errno
import hashlib
import json
import math
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from dicom_files import single, volume
from nested_settings import changed

from torchdeform.cohort.journal import JOURNAL, Journal, Record, open_lines
from torchdeform.cohort.plan import Job
from torchdeform.cohort.task import DONE, FAILED, PairReport
from torchdeform.errors import InputError, MachineError
from torchdeform.pipeline.register import PairFiles
from torchdeform.registration.settings import RegistrationSettings

REPORT = PairReport(DONE, "", 1.5, 4, 0, {"folds": 0, "dice_after": 0.9}, ("warped.png", "result.json"))


@pytest.fixture
def job(tmp_path) -> Job:
    """A pair of two files that are no images, which is all the same here."""
    for name in ("fixed.png", "moving.png"):
        (tmp_path / name).write_text(name, encoding="ascii")
    files = PairFiles(fixed=tmp_path / "fixed.png", moving=tmp_path / "moving.png", out=tmp_path / "out" / "a")
    return Job(name="a", files=files, settings=RegistrationSettings())


def fingerprint(folder: Path, job: Job) -> str:
    with Journal(folder / "out") as journal:
        return journal.fingerprint(job)


def records(folder: Path) -> dict[str, Record]:
    with Journal(folder) as journal:
        return journal.records


def test_what_is_recorded_is_read_again(tmp_path):
    written = {name: Record(name, f"key {name}", REPORT) for name in ("a", "b")}
    with Journal(tmp_path) as journal:
        for record in written.values():
            journal.record(record)
    assert records(tmp_path) == written


def test_the_last_line_of_a_pair_counts(tmp_path):
    with Journal(tmp_path) as journal:
        journal.record(Record("a", "1", PairReport(FAILED, "why")))
        journal.record(Record("a", "2", REPORT))
    assert records(tmp_path) == {"a": Record("a", "2", REPORT)}
    assert len((tmp_path / JOURNAL).read_text(encoding="utf-8").splitlines()) == 2


def test_a_line_torn_anywhere_costs_that_line_only(tmp_path):
    with Journal(tmp_path) as journal:
        journal.record(Record("a", "1", REPORT))
        whole = (tmp_path / JOURNAL).read_bytes()
        journal.record(Record("b", "2", REPORT))
    second = (tmp_path / JOURNAL).read_bytes()[len(whole) :]
    for length in range(len(second)):
        (tmp_path / JOURNAL).write_bytes(whole + second[:length])
        with Journal(tmp_path) as journal:
            assert "a" in journal.records
            journal.record(Record("c", "3", REPORT))
        assert records(tmp_path).keys() - {"b"} == {"a", "c"}


@pytest.mark.parametrize(
    "change",
    [
        {"status": "finished"}, {"status": ["done"]}, {"status": None}, {"pair": 3}, {"key": None}, {"sentence": {}},
        {"seconds": "1"}, {"seconds": -1}, {"seconds": math.inf}, {"seconds": math.nan}, {"peak_memory": 1.5},
        {"peak_memory": 10**400}, {"figures": []}, {"figures": {"folds": [0]}}, {"files": "warped.png"},
        {"files": [1]}, {"files": []}, {"files": None}, {"sentence": "x" * 2_000_000},
    ],
)  # fmt: skip
def test_a_line_with_wrong_types_or_an_unknown_status_counts_for_nothing(tmp_path, change):
    with Journal(tmp_path) as journal:
        journal.record(Record("a", "1", REPORT))
        journal.record(Record("b", "2", REPORT))
    first, second = (tmp_path / JOURNAL).read_bytes().splitlines()
    third = json.dumps(json.loads(second) | change)
    (tmp_path / JOURNAL).write_bytes(b"\n".join([first, third.encode()]) + b"\n")
    with Journal(tmp_path) as journal:
        assert journal.records.keys() == {"a"}
        assert journal.skipped >= 1


@pytest.mark.parametrize(
    "line",
    [b"\xff\xfe\n", b"[]\n", b"3\n", b"{}\n", b'{"pair": "b"}\n', b"\0\n", b"[" * 100_000 + b"\n", b"{" * 3_000_000]
)  # fmt: skip
def test_lines_that_make_no_sense_are_skipped(tmp_path, line):
    with Journal(tmp_path) as journal:
        journal.record(Record("a", "1", REPORT))
    with (tmp_path / JOURNAL).open("ab") as file:
        file.write(line)
    with Journal(tmp_path) as journal:
        assert journal.records.keys() == {"a"}
        assert journal.skipped


def test_dates_of_files_that_earlier_versions_kept_are_no_wrong_lines(tmp_path):
    (tmp_path / JOURNAL).write_text('{"file": "/a.png", "size": 1, "mtime_ns": 2, "digest": "x"}\n', encoding="ascii")
    with Journal(tmp_path) as journal:
        assert journal.skipped == 0


def test_a_line_that_cannot_be_written_whole_is_not_written(tmp_path, monkeypatch):
    """A full disk takes a part of it; what is written when there is space again stands on a line of its own."""
    write = os.write

    def full(file: int, line: memoryview) -> int:
        if len(line) < 50:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(file, line[: len(line) - 40])

    with Journal(tmp_path) as journal:
        journal.record(Record("a", "1", REPORT))
        before = (tmp_path / JOURNAL).read_bytes()
        monkeypatch.setattr("os.write", full)
        with pytest.raises(OSError, match="No space left"):
            journal.record(Record("b", "2", REPORT))
        monkeypatch.undo()
        assert (tmp_path / JOURNAL).read_bytes() == before
        assert journal.records.keys() == {"a"}
        journal.record(Record("c", "3", REPORT))
    assert records(tmp_path).keys() == {"a", "c"}


def test_nothing_is_appended_to_what_could_block(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="pipe is no file"):
        open_lines(tmp_path / "pipe")


@pytest.mark.parametrize("how", ["removed", "replaced", "moved"])
def test_a_journal_that_is_not_there_any_more_takes_no_records(tmp_path, how):
    with Journal(tmp_path / "out") as journal:
        (tmp_path / "out").rename(tmp_path / "other")
        if how == "replaced":
            shutil.copytree(tmp_path / "other", tmp_path / "out")
        if how != "moved":
            shutil.rmtree(tmp_path / "other")
        with pytest.raises(MachineError, match="was removed or replaced while the run was working"):
            journal.record(Record("a", "1", REPORT))


def test_a_pipe_in_the_place_of_the_journal_is_refused(tmp_path):
    os.mkfifo(tmp_path / JOURNAL)
    with pytest.raises(InputError, match="is no file"):
        Journal(tmp_path)


def test_two_runs_of_one_folder_are_refused(tmp_path):
    with Journal(tmp_path), pytest.raises(InputError, match="another run is working"):
        Journal(tmp_path)
    with Journal(tmp_path):
        pass


def test_a_file_in_the_folders_place_is_refused(tmp_path):
    (tmp_path / "out").touch()
    with pytest.raises(InputError, match="cannot write to"):
        Journal(tmp_path / "out")


def test_the_print_depends_on_content_not_on_paths_or_dates(tmp_path, job):
    before = fingerprint(tmp_path, job)
    os.utime(job.files.fixed, (1, 1))
    assert fingerprint(tmp_path, job) == before
    elsewhere = tmp_path / "elsewhere.png"
    job.files.fixed.rename(elsewhere)
    moved = replace(job, files=replace(job.files, fixed=elsewhere, out=tmp_path / "other"))
    assert fingerprint(tmp_path, moved) == before
    elsewhere.write_text("FIXED.png", encoding="ascii")
    assert fingerprint(tmp_path, moved) != before


@pytest.mark.parametrize(
    "change",
    [
        lambda job: replace(job, settings=changed(job.settings, window=7)),
        lambda job: replace(job, device="cpu"),
        lambda job: replace(job, memory=10**9),
        lambda job: replace(job, voxels=True),
        lambda job: replace(job, files=replace(job.files, fixed=job.files.moving, moving=job.files.fixed)),
        lambda job: replace(job, files=replace(job.files, fixed_mask=job.files.fixed)),
    ],
)
def test_the_print_depends_on_all_that_results_depend_on(tmp_path, job, change):
    assert fingerprint(tmp_path, change(job)) != fingerprint(tmp_path, job)


def test_the_print_depends_on_the_version(tmp_path, job, monkeypatch):
    before = fingerprint(tmp_path, job)
    monkeypatch.setattr("torchdeform.cohort.journal.__version__", "another")
    assert fingerprint(tmp_path, job) != before


def test_a_file_that_comes_back_changes_the_print(tmp_path, job):
    job.files.fixed.rename(tmp_path / "aside")
    missing = fingerprint(tmp_path, job)
    (tmp_path / "aside").rename(job.files.fixed)
    assert fingerprint(tmp_path, job) != missing


@pytest.mark.parametrize(
    ("header", "data"), [("a.mhd", "a.raw"), ("a.nhdr", "a.raw"), ("a.hdr", "a.img"), ("a.mhd", "b.raw")]
)
def test_pixels_in_a_file_of_their_own_count(tmp_path, job, header, data):
    sitk.WriteImage(sitk.GetImageFromArray(np.zeros((4, 5, 6), np.uint8)), str(tmp_path / header))
    if data == "b.raw":
        (tmp_path / "a.raw").rename(tmp_path / data)
        text = (tmp_path / header).read_text(encoding="ascii").replace("a.raw", data)
        (tmp_path / header).write_text(text, encoding="ascii")
    detached = replace(job, files=replace(job.files, fixed=tmp_path / header))
    before, status = fingerprint(tmp_path, detached), (tmp_path / data).stat()
    (tmp_path / data).write_bytes(bytes(status.st_size - 1) + b"1")
    os.utime(tmp_path / data, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert fingerprint(tmp_path, detached) != before


@pytest.mark.parametrize("given", ["folder", "file"])
def test_every_slice_of_a_series_counts(tmp_path, job, given):
    series = single(tmp_path / "series", volume())
    files = sorted(series.iterdir())
    of_series = replace(job, files=replace(job.files, fixed=series if given == "folder" else files[0]))
    before = fingerprint(tmp_path, of_series)
    content = bytearray(files[-1].read_bytes())
    content[-2] ^= 1  # a bit of a pixel
    files[-1].write_bytes(content)
    assert fingerprint(tmp_path, of_series) != before


def test_one_run_reads_a_file_once_and_the_next_run_reads_it_again(tmp_path, job, monkeypatch):
    read, digest = [], hashlib.file_digest
    monkeypatch.setattr("torchdeform.cohort.journal._SETTLED", -1)  # as if the files were old
    monkeypatch.setattr("hashlib.file_digest", lambda file, kind: (read.append(file.name), digest(file, kind))[1])
    for _ in range(2):
        with Journal(tmp_path / "out") as journal:
            assert len({journal.fingerprint(job) for _ in range(3)}) == 1
    assert len(read) == 4


@pytest.mark.parametrize("settled", [-(10**18), 10**18])
def test_content_is_what_counts_whatever_the_dates_say(tmp_path, job, monkeypatch, settled):
    """Written again, or replaced, with the size and date of before, in one run, and with a clock that goes back."""
    monkeypatch.setattr("torchdeform.cohort.journal._SETTLED", settled)
    with Journal(tmp_path / "out") as journal:
        found = [journal.fingerprint(job)]
        for text in ("FIXED.png", "FIXED.PNG"):
            status = job.files.fixed.stat()
            (tmp_path / "new").write_text(text, encoding="ascii")
            if text == "FIXED.PNG":
                (tmp_path / "new").replace(job.files.fixed)
            else:
                job.files.fixed.write_text(text, encoding="ascii")
            os.utime(job.files.fixed, ns=(status.st_atime_ns, status.st_mtime_ns))
            found.append(journal.fingerprint(job))
    assert len(set(found)) == 3


def test_the_date_of_a_file_just_written_is_not_trusted(tmp_path, job):
    """Written again within a tick of the clock, it may have the same size and date."""
    before, status = fingerprint(tmp_path, job), job.files.fixed.stat()
    job.files.fixed.write_text("FIXED.png", encoding="ascii")
    os.utime(job.files.fixed, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert fingerprint(tmp_path, job) != before


def test_a_record_is_one_line_of_json_on_the_disk(tmp_path, monkeypatch):
    synced = []
    monkeypatch.setattr("torchdeform.cohort.journal.os.fsync", lambda file: synced.append(os.fstat(file).st_size))
    with Journal(tmp_path) as journal:
        journal.record(Record("a", "1", PairReport(FAILED, "line one\nline two")))
    text = (tmp_path / JOURNAL).read_text(encoding="utf-8")
    assert json.loads(text)["sentence"] == "line one\nline two"
    assert synced[-1] == len(text)

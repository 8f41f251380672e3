"""Damaged files of every format are read or refused in one sentence: no crash, no end that does not come, no NaN."""

import sys
from collections.abc import Iterator
from random import Random

import bad_readers
import fuzz
import pytest
from fuzz_files import FORMATS
from fuzz_mutations import mutant

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="memory is read from /proc")

COUNT, SEED = 40, 0


@pytest.fixture(scope="module")
def reader() -> Iterator[fuzz.Reader]:
    """A process that reads files."""
    reader = fuzz.Reader()
    yield reader
    reader.stop()


@pytest.mark.parametrize(
    ("name", "outcome"),
    [
        ("sound", "ok"), ("refusing", "typed"), ("rambling", "untyped"), ("failing", "untyped"), ("crashing", "signal"),
        ("endless", "hang"), ("infinite", "NaN"), ("greedy", ">1 GB"), ("boundless", ">1 GB"),
    ],
)  # fmt: skip
def test_every_failure_is_seen(tmp_path, monkeypatch, reader, name, outcome):
    monkeypatch.setattr(fuzz, "SECONDS", 1.0 if name == "endless" else fuzz.SECONDS)
    path = tmp_path / "a.txt"
    path.write_text("x", encoding="utf-8")
    assert reader(getattr(bad_readers, name), path).outcome == outcome
    assert reader(bad_readers.sound, path).outcome == "ok"


def test_a_seed_gives_the_same_mutants():
    content = bytes(range(256)) * 4 + b"spacing: 1.5 2\n"
    mutants = [[mutant(content, Random(f"{k}")) for k in range(200)] for _ in range(2)]
    assert mutants[0] == mutants[1]
    assert len(set(mutants[0])) > 190
    assert mutants[0].count(content) < 5


@pytest.mark.parametrize("name", FORMATS)
def test_codings_come_back(tmp_path, name):
    path = tmp_path / FORMATS[name].file
    FORMATS[name].write(path)
    unpack, pack = FORMATS[name].coding or (bytes, bytes)
    assert unpack(pack(unpack(path.read_bytes()))) == unpack(path.read_bytes())


@pytest.mark.parametrize("name", FORMATS)
def test_the_file_itself_is_read(tmp_path, reader, name):
    path = tmp_path / FORMATS[name].file
    FORMATS[name].write(path)
    trial = reader(FORMATS[name].read, path)
    assert trial.outcome == "ok", trial.detail


@pytest.mark.parametrize("name", FORMATS)
def test_its_mutants_do_no_harm(tmp_path, reader, name):
    found = fuzz.trials(name, range(COUNT), SEED, reader, tmp_path)
    assert {index: trial for index, trial in found if trial.outcome not in fuzz.SOUND} == {}

"""Files come all or none, and places that cannot be written are named before any work."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest
from broken_files import files_in, save, volume

from torchdeform.cli.main import main
from torchdeform.errors import InputError, MachineError
from torchdeform.io import read_image, write_image
from torchdeform.io.files import atomic_folder, remove_leftovers, require_target, require_writable


@pytest.mark.parametrize("out", ["sound.nii.gz", "sound.nii.gz/deeper", "/proc/nothing/here", "/dev/null"])
def test_places_that_cannot_be_written(folder, capfd, out):
    save(volume(), folder / "moving.mha")
    before = files_in(folder)
    assert main(["sound.nii.gz", "moving.mha", "--out", out]) == 2
    assert "cannot write to" in capfd.readouterr().err
    assert files_in(folder) == before


NEW = {"a.bin": "new a", "b.bin": "new b", "c.bin": "new c", "result.json": "new record"}
OLD = {"a.bin": "old a", "gone.bin": "old gone", "result.json": "old record", "notes.txt": "mine"}


def write(folder: Path, texts: dict[str, str]) -> None:
    folder.mkdir(exist_ok=True)
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="ascii")


def texts(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text(encoding="ascii") for path in folder.iterdir()}


def exchange(folder: Path) -> None:
    with atomic_folder(folder, lambda: {"gone.bin", "never.bin"}) as new:
        write(new, NEW)


class Renames:
    """Renames files, but not the k-th time, or from then on if it is for good."""

    def __init__(self, fails: int, *, for_good: bool) -> None:
        self.count, self._fails, self._for_good, self._rename = 0, fails, for_good, os.replace

    def replace(self, source: Path, target: Path) -> None:
        self.count += 1
        if self.count == self._fails or (self._for_good and self.count > self._fails):
            raise OSError(errno.EIO, "Input/output error", str(source))
        self._rename(source, target)


@pytest.fixture
def renames(monkeypatch):
    """Return ``renames(fails, for_good)``, which puts `Renames` in place."""

    def make(fails: int, *, for_good: bool = False) -> Renames:
        found = Renames(fails, for_good=for_good)
        monkeypatch.setattr(Path, "replace", lambda source, target: found.replace(source, target))
        return found

    return make


def test_what_is_new_replaces_what_it_should_and_no_more(tmp_path, renames):
    write(tmp_path / "out", OLD)
    counted = renames(0)
    exchange(tmp_path / "out")
    assert texts(tmp_path / "out") == {**NEW, "notes.txt": "mine"}
    assert counted.count == 7
    assert list(tmp_path.iterdir()) == [tmp_path / "out"]


@pytest.mark.parametrize("fails", range(1, 8))
def test_a_rename_that_fails_leaves_everything_as_before(tmp_path, renames, fails):
    write(tmp_path / "out", OLD)
    renames(fails)
    with pytest.raises(MachineError, match="Input/output error; mend that and run the same command again"):
        exchange(tmp_path / "out")
    assert texts(tmp_path / "out") == OLD
    assert list(tmp_path.iterdir()) == [tmp_path / "out"]


@pytest.mark.parametrize("fails", range(1, 8))
def test_a_disk_that_fails_for_good_leaves_no_record_beside_files_of_two_runs(tmp_path, renames, fails):
    write(tmp_path / "out", OLD)
    renames(fails, for_good=True)
    with pytest.raises(MachineError):
        exchange(tmp_path / "out")
    left = texts(tmp_path / "out")
    assert left == OLD or "result.json" not in left


@pytest.mark.parametrize("fails", range(1, 5))
def test_a_rename_that_fails_leaves_no_new_folder(tmp_path, renames, fails):
    renames(fails)
    with pytest.raises(MachineError):
        exchange(tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_a_single_file_is_there_at_any_time(tmp_path, renames):
    write(tmp_path, {"a.txt": "old"})
    counted = renames(1)
    with pytest.raises(MachineError), atomic_folder(tmp_path) as new:
        write(new, {"a.txt": "new"})
    assert (counted.count, texts(tmp_path)) == (1, {"a.txt": "old"})


def test_a_folder_is_never_replaced_by_a_file(tmp_path):
    (tmp_path / "out" / "a.bin").mkdir(parents=True)
    with pytest.raises(InputError, match=r"a\.bin is a folder where a file is to be written"):
        exchange(tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["a.bin"]


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.ESTALE])
def test_what_a_disk_says_is_a_failure_of_the_machine(tmp_path, number):
    with pytest.raises(MachineError, match=f"cannot write to {tmp_path}") as raised, atomic_folder(tmp_path):
        raise InputError("this hides the reason") from OSError(number, os.strerror(number))
    assert os.strerror(number) in str(raised.value)
    assert ("are free, which is not enough" in str(raised.value)) == (number in (errno.ENOSPC, errno.EDQUOT))


def test_a_library_that_does_not_say_why_is_explained_by_the_disk(tmp_path, monkeypatch):
    monkeypatch.setattr("torchdeform.io.files._probe", lambda _: OSError(errno.ENOSPC, "No space left on device"))
    with pytest.raises(MachineError, match="No space left"), atomic_folder(tmp_path):
        raise RuntimeError("itk::ERROR: something")


def test_other_errors_stay_what_they_are(tmp_path):
    for error in (InputError("no"), PermissionError(errno.EACCES, "denied"), KeyError("x")):
        with pytest.raises(type(error)), atomic_folder(tmp_path):
            raise error
    assert list(tmp_path.iterdir()) == []


HOLD = """
import sys, time
from pathlib import Path
from torchdeform.io.files import atomic_folder
with atomic_folder(Path(sys.argv[1])) as new:
    (new / "half").write_text("x")
    print("ready", flush=True)
    time.sleep(600)
"""


def test_what_the_dead_left_goes_and_what_the_living_write_stays(tmp_path):
    def start() -> subprocess.Popen[str]:
        process = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        return process

    dead, living = start(), start()
    dead.kill()
    dead.communicate()
    (tmp_path / ".torchdeform-of-an-earlier-version").mkdir()
    assert len(list(tmp_path.glob(".torchdeform-*"))) == 3
    require_writable(tmp_path)
    (left,) = tmp_path.glob(".torchdeform-*")
    assert (left / "new" / "half").is_file()
    living.kill()
    living.communicate()
    require_writable(tmp_path / "out")  # which is missing: the folder above it is looked at
    assert list(tmp_path.iterdir()) == []


def test_a_folder_of_another_machine_is_left_for_a_day(tmp_path):
    place = tmp_path / ".torchdeform-x"
    place.mkdir()
    (place / "lock").write_text("another machine", encoding="ascii")
    remove_leftovers(tmp_path)
    assert place.is_dir()
    os.utime(place, (1e9, 1e9))
    remove_leftovers(tmp_path)
    assert not place.exists()


def test_a_link_of_such_a_name_is_not_followed(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / ".torchdeform-x").symlink_to(tmp_path / "mine")
    remove_leftovers(tmp_path)
    assert (tmp_path / "mine").is_dir()


@pytest.mark.parametrize("name", ["a" * 300 + ".nrrd", "a\udcff.mha", "a\udcff.tif"])
def test_names_that_no_file_can_have(folder, capfd, name):
    """ITK ends the whole process at a name that does not encode."""
    for call in (lambda: write_image(read_image("sound.nii.gz"), name), lambda: require_target(Path(name))):
        with pytest.raises(InputError, match=r"choose another name|rename the file"):
            call()
    before = files_in(folder)
    assert main(["sound.nii.gz", "sound.nii.gz", "--out", name]) == 2
    assert len(capfd.readouterr().err.splitlines()) == 1
    assert files_in(folder) == before

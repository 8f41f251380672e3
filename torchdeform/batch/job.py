"""One pair of a cohort, as plain data that travels to a worker, and its registration there."""

from dataclasses import dataclass, replace
from pathlib import Path

from torchdeform.io import read_displacement, read_image
from torchdeform.io.files import staged
from torchdeform.io.learn2reg import write_voxel_displacement
from torchdeform.pair import Outcome, PairFiles, register_files
from torchdeform.registration.result import Callback
from torchdeform.registration.settings import RegistrationSettings

_POINTS = ("fixed_points", "moving_points")


@dataclass(frozen=True, kw_only=True)
class Job:
    """A pair to register.

    Args:
        name: of the pair, unique in its cohort, of letters, digits, ``.``, ``_`` and ``-`` only.
        files: all paths absolute; ``files.out`` is the pair's own folder inside the cohort's.
        settings: resolved, the pair's own included.
        device: ``auto``, ``cpu`` or ``cuda``.
        memory: bytes to take at most, None for what is free.
        submission: file for the displacement as the Learn2Reg challenge reads it, None for none.
        voxels: landmarks are rows of voxel indices without titles, as Learn2Reg has them.
    """

    name: str
    files: PairFiles
    settings: RegistrationSettings
    device: str = "auto"
    memory: int | None = None
    submission: Path | None = None
    voxels: bool = False


def register_job(job: Job, *, callback: Callback | None = None) -> Outcome:
    """Register a pair as `register_files` does, and write what else its cohort wants of it.

    Raises:
        InputError: see `register_files`.
        ComputationError: see `register_files`.
    """
    files = _with_titles(job.files) if job.voxels else job.files
    outcome = register_files(files, job.settings, device=job.device, memory=job.memory, callback=callback)
    if job.submission is not None:
        displacement = read_displacement(outcome.folder / "displacement.nii.gz")
        fixed, moving = read_image(files.fixed), read_image(files.moving)
        write_voxel_displacement(displacement.data, fixed, moving, job.submission)
    return outcome


def _with_titles(files: PairFiles) -> PairFiles:
    """Return the files with landmarks written anew into the pair's folder, titled i, j, k as `read_points` wants it."""
    given = {key: path for key in _POINTS if (path := getattr(files, key)) is not None}
    with staged(files.out) as folder:
        for key, path in given.items():
            rows = path.read_text(encoding="utf-8-sig")
            (folder / f"{key}.csv").write_text(f"i,j,k\n{rows}", encoding="utf-8")
    return replace(files, **{key: files.out / f"{key}.csv" for key in given})

"""One pair of a cohort, as plain data that travels to a worker."""

from dataclasses import dataclass

from torchdeform.pair import PairFiles
from torchdeform.registration.settings import RegistrationSettings


@dataclass(frozen=True, kw_only=True)
class Job:
    """A pair to register.

    Args:
        name: of the pair, unique in its cohort, of letters, digits, ``.``, ``_`` and ``-`` only.
        files: all paths absolute; ``files.out`` is the pair's own folder inside the cohort's.
        settings: resolved, the pair's own included.
        device: ``auto``, ``cpu`` or ``cuda``.
        memory: bytes to take at most, None for what is free.
    """

    name: str
    files: PairFiles
    settings: RegistrationSettings
    device: str = "auto"
    memory: int | None = None

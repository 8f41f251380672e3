"""What every test shares: threads that do not fight, and synthetic images with known answers."""

import locale
import math
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, settings
from torch import Tensor

from torchdeform.core.diagnostics import diagnose
from torchdeform.core.grid import Grid
from torchdeform.core.image import Image, resample
from torchdeform.core.warp import invert
from torchdeform.registration.annotations import Annotations
from torchdeform.registration.evidence import Evidence
from torchdeform.registration.result import Callback, LevelRecord, Progress, RegistrationResult
from torchdeform.registration.settings import RegistrationSettings

# What tells programs that they are seen in a terminal, or not; typer looks when it is imported.
for _name in ("FORCE_COLOR", "CLICOLOR_FORCE", "PY_COLORS", "GITHUB_ACTIONS", "NO_COLOR", "TTY_COMPATIBLE"):
    os.environ.pop(_name, None)

# How long an example takes says nothing about what it tests, and the folder of the tests may not be writable.
settings.register_profile("any machine", database=None, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")

if os.environ.get("PYTEST_XDIST_WORKER"):
    torch.set_num_threads(1)

ROOT = Path(__file__).resolve().parents[1]

# A rotation that mixes all axes, columns orthonormal.
_TILTED = {
    2: ((math.cos(0.4), -math.sin(0.4)), (math.sin(0.4), math.cos(0.4))),
    3: ((0.936293363584, -0.275095847318, 0.218350663146),
        (0.289629477625, 0.956425085849, -0.036957013525),
        (-0.198669330795, 0.097843395007, 0.975170327202)),
}  # fmt: skip


@pytest.fixture(autouse=True)
def _seed() -> None:
    """Random numbers are the same on every machine and in every order of the tests."""
    torch.manual_seed(0)


@pytest.fixture(autouse=True)
def _kept_locale() -> Iterator[None]:
    """Writing DICOM with ITK, as tests do, leaves the process's locale at "C", where text files are read as ASCII."""
    before = locale.setlocale(locale.LC_ALL)
    yield
    locale.setlocale(locale.LC_ALL, before)


@pytest.fixture
def root() -> Path:
    """The project's folder."""
    return ROOT


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """The folder of real images that ``TORCHDEFORM_DATA`` names."""
    folder = Path(os.environ.get("TORCHDEFORM_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip("no real images: set TORCHDEFORM_DATA to their folder")
    return folder


@pytest.fixture
def make_image() -> Callable[..., Image]:
    """Return ``make_image(shape, spacing, ...)``: a smooth image of Gaussian blobs on a tilted grid."""
    return smooth_image


def smooth_image(
    shape: tuple[int, ...],
    spacing: tuple[float, ...] | None = None,
    *,
    channels: int = 1,
    origin: tuple[float, ...] | None = None,
    tilted: bool = False,
    name: str = "image",
    pixel_type: str = "float32",
    unit: str = "mm",
) -> Image:
    """Return an image between 0 and 200 whose value depends on the world position only, so any grid may sample it."""
    dim = len(shape)
    grid = Grid(shape, spacing or (1.0,) * dim)
    empty = torch.zeros(1, channels, *shape)
    place = Image(empty, grid, origin or (), _TILTED[dim] if tilted else (), name, pixel_type)
    world = place.to_world(grid.points(dtype=torch.float64))
    values = [_blobs(world, phase) for phase in range(channels)]
    return Image(torch.cat(values, dim=1).float(), grid, place.origin, place.direction, name, pixel_type, unit)


@pytest.fixture
def make_result() -> Callable[..., RegistrationResult]:
    """Return ``make_result(fixed, moving, settings, callback)``: a registration that is known beforehand."""
    return known_result


def known_result(
    fixed: Image,
    moving: Image,
    config: RegistrationSettings | None = None,
    *,
    annotations: Annotations | None = None,
    affine: object = None,
    callback: Callback | None = None,
) -> RegistrationResult:
    """Answer like `torchdeform.register`, at once: the map is `smooth_displacement`, whatever the images."""
    del annotations, affine
    grid = fixed.grid
    u = smooth_displacement(grid)
    inverse = invert(u, grid)
    shapes = [tuple(max(n // 2 ** (1 - level), 2) for n in grid.shape) for level in range(2)]
    for level, shape in enumerate(shapes):
        for step in range(1, 4):
            if callback is not None:
                callback(Progress(level, 2, step, 3, torch.tensor([0.1 * step]), shape))
    similarity = tuple(torch.tensor([0.1 * step]) for step in range(4))
    return RegistrationResult(
        displacement=u,
        inverse=inverse,
        warped=resample(moving, fixed, u),
        grid=grid,
        similarity_before=torch.tensor([0.1]),
        similarity_after=torch.tensor([0.9]),
        objective_before=torch.tensor([0.3]),
        objective_after=torch.tensor([0.6]),
        diagnosis=diagnose(u, grid),
        inverse_error_mean=torch.tensor([0.01]),
        inverse_error_max=torch.tensor([0.2]),
        levels=tuple(LevelRecord(shape, similarity, 0, 0.5) for shape in shapes),
        seconds={"optimise": 1.0},
        settings=config or RegistrationSettings(),
        evidence=(_FINE,),
    )


_FINE = Evidence(
    correlation_before=0.5,
    correlation=0.9,
    information_before=0.4,
    information=0.7,
    structure_before=0.5,
    edges_before=2.0,
    edges=0.5,
    foreground_before=0.8,
    foreground=0.95,
    disagreement=0.02,
    extreme=0.01,
    extreme_inside=0.01,
    inverse_error=0.001,
    covered=1.0,
)


@pytest.fixture
def fine_evidence() -> Evidence:
    """Return the evidence of an ordinary registration that went well."""
    return _FINE


def _blobs(world: Tensor, phase: int) -> Tensor:
    waves = torch.stack([torch.cos(0.11 * (k + 1) * world[:, k] + 0.7 * phase) for k in range(world.shape[1])], dim=1)
    return 100 + 100 * waves.prod(dim=1, keepdim=True)


@pytest.fixture
def make_displacement() -> Callable[[Grid, float], Tensor]:
    """Return ``make_displacement(grid, share)``: smooth, zero at the faces, at most ``share`` of each side long."""
    return smooth_displacement


def smooth_displacement(grid: Grid, share: float = 0.05) -> Tensor:
    """Return u with components of different shape, so that swapped axes show."""
    unit = grid.points(dtype=torch.float64) / grid.along(grid.extent, grid.points(dtype=torch.float64))
    parts = []
    for k in range(grid.dim):
        waves = torch.ones_like(unit[:, :1])
        for axis in range(grid.dim):
            waves = waves * torch.sin(math.pi * (1 + (axis == k) * (k % 2)) * unit[:, axis : axis + 1])
        parts.append(waves * share * grid.extent[k] * (1.0, -0.8, 0.6)[k])
    return torch.cat(parts, dim=1).float()

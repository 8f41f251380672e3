"""torchdeform: registration of images by maps that do not fold, built from divergence and curl.

The names below are loaded when they are first used, so ``import torchdeform`` costs little more than ``import torch``.
"""

import os
import sys
from importlib import import_module
from typing import TYPE_CHECKING

# OpenMP's threads spin while they wait for each other. Where another program has one of the cores that made a
# registration 25 times slower; after a short spin they sleep instead. Read once, when torch is loaded.
if "torch" not in sys.modules:
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")

# Not lazy: the module `warp` would hide the function of the same name as soon as anything imports it.
from torchdeform.warp import compose, invert, warp

if TYPE_CHECKING:
    from torchdeform.config import load_settings
    from torchdeform.deformation.averages import average_maps
    from torchdeform.deformation.monitors import (
        MonitorSettings,
        ball_monitor,
        box_monitor,
        curvature_monitor,
        density_monitor,
        gradient_monitor,
        label_monitor,
        line_monitor,
        normalise_monitor,
        ring_monitor,
    )
    from torchdeform.deformation.prescribed import NewtonSettings, from_jacobian_and_curl
    from torchdeform.deformation.reconstruction import reconstruct
    from torchdeform.deformation.velocity import find_velocity
    from torchdeform.deformation.versions import (
        DeformationSettings,
        grid_from_initial_monitor,
        grid_from_target_monitor,
        track_moving_monitor,
    )
    from torchdeform.deformation.volumes import simulate_volume_change
    from torchdeform.diagnostics import Diagnosis, diagnose
    from torchdeform.errors import ComputationError, InputError, TorchdeformError
    from torchdeform.fem import SolverSettings, Weights, solve_div_curl
    from torchdeform.flow import OdeSolver, integrate
    from torchdeform.grid import Grid
    from torchdeform.image import Image
    from torchdeform.io import (
        read_image,
        read_labels,
        read_points,
        read_transform,
        write_image,
        write_labels,
        write_points,
        write_transform,
    )
    from torchdeform.registration.affine import Alignment, AlignmentSettings, align
    from torchdeform.registration.deformable import register
    from torchdeform.registration.discrete import DiscreteSettings, discrete_start
    from torchdeform.registration.evaluation import Evaluation, Measures, dice, hausdorff
    from torchdeform.registration.guidance import Guidance
    from torchdeform.registration.result import RegistrationResult
    from torchdeform.registration.settings import RegistrationSettings
    from torchdeform.solvers.solution import Solution, Status
    from torchdeform.stencil import curl, divergence, jacobian_determinant
    from torchdeform.transform import Affine, Displacement, Transform

__version__ = "0.1.0"

_HOMES = {
    "config": ("load_settings",),
    "deformation.averages": ("average_maps",),
    "deformation.monitors": (
        "MonitorSettings",
        "ball_monitor",
        "box_monitor",
        "curvature_monitor",
        "density_monitor",
        "gradient_monitor",
        "label_monitor",
        "line_monitor",
        "normalise_monitor",
        "ring_monitor",
    ),
    "deformation.prescribed": ("NewtonSettings", "from_jacobian_and_curl"),
    "deformation.reconstruction": ("reconstruct",),
    "deformation.volumes": ("simulate_volume_change",),
    "deformation.velocity": ("find_velocity",),
    "deformation.versions": (
        "DeformationSettings",
        "grid_from_initial_monitor",
        "grid_from_target_monitor",
        "track_moving_monitor",
    ),
    "diagnostics": ("Diagnosis", "diagnose"),
    "errors": ("ComputationError", "InputError", "TorchdeformError"),
    "fem": ("SolverSettings", "Weights", "solve_div_curl"),
    "flow": ("OdeSolver", "integrate"),
    "grid": ("Grid",),
    "image": ("Image",),
    "io": (
        "read_image",
        "read_labels",
        "read_points",
        "read_transform",
        "write_image",
        "write_labels",
        "write_points",
        "write_transform",
    ),
    "registration.affine": ("Alignment", "AlignmentSettings", "align"),
    "registration.discrete": ("DiscreteSettings", "discrete_start"),
    "registration.evaluation": ("Evaluation", "Measures", "dice", "hausdorff"),
    "registration.guidance": ("Guidance",),
    "registration.deformable": ("register",),
    "registration.result": ("RegistrationResult",),
    "registration.settings": ("RegistrationSettings",),
    "solvers.solution": ("Solution", "Status"),
    "transform": ("Affine", "Displacement", "Transform"),
    "stencil": ("curl", "divergence", "jacobian_determinant"),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [
    "Affine",
    "Alignment",
    "AlignmentSettings",
    "ComputationError",
    "DeformationSettings",
    "Diagnosis",
    "DiscreteSettings",
    "Displacement",
    "Evaluation",
    "Grid",
    "Guidance",
    "Image",
    "InputError",
    "Measures",
    "MonitorSettings",
    "NewtonSettings",
    "OdeSolver",
    "RegistrationResult",
    "RegistrationSettings",
    "Solution",
    "SolverSettings",
    "Status",
    "TorchdeformError",
    "Transform",
    "Weights",
    "align",
    "average_maps",
    "ball_monitor",
    "box_monitor",
    "compose",
    "curl",
    "curvature_monitor",
    "density_monitor",
    "diagnose",
    "dice",
    "discrete_start",
    "divergence",
    "find_velocity",
    "from_jacobian_and_curl",
    "gradient_monitor",
    "grid_from_initial_monitor",
    "grid_from_target_monitor",
    "hausdorff",
    "integrate",
    "invert",
    "jacobian_determinant",
    "label_monitor",
    "line_monitor",
    "load_settings",
    "normalise_monitor",
    "read_image",
    "read_labels",
    "read_points",
    "read_transform",
    "reconstruct",
    "register",
    "ring_monitor",
    "simulate_volume_change",
    "solve_div_curl",
    "track_moving_monitor",
    "warp",
    "write_image",
    "write_labels",
    "write_points",
    "write_transform",
]


def __getattr__(name: str) -> object:
    """Load a public name on its first use (PEP 562)."""
    if name not in _HOME_OF:
        raise AttributeError(f"module 'torchdeform' has no attribute {name!r}")
    value = getattr(import_module(f"torchdeform.{_HOME_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

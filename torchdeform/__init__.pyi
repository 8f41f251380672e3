# The public face: `__init__.py` loads a name from the module that this file names when it is first used.
from .core.derivatives import curl, divergence, jacobian_determinant
from .core.diagnostics import Diagnosis, diagnose
from .core.flow import OdeSolver, integrate
from .core.grid import Grid
from .core.image import Image
from .core.transform import Affine, Displacement, Transform
from .core.warp import compose, invert, warp
from .deformation.averages import average_maps
from .deformation.incompressible import hold_volume
from .deformation.monitors import (
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
from .deformation.prescribed import NewtonSettings, from_jacobian_and_curl
from .deformation.reconstruction import reconstruct
from .deformation.rigid import hold_rigid
from .deformation.tissue import label_fit
from .deformation.velocity import find_velocity
from .deformation.versions import (
    DeformationSettings,
    grid_from_initial_monitor,
    grid_from_target_monitor,
    monitor_misfit,
    track_moving_monitor,
)
from .deformation.volumes import simulate_volume_change
from .errors import ComputationError, InputError, TorchdeformError
from .fem import SolverSettings, Weights, solve_div_curl
from .io import (
    read_image,
    read_labels,
    read_points,
    read_transform,
    write_image,
    write_labels,
    write_points,
    write_transform,
)
from .metrics.evaluation import Evaluation, Measures, dice, hausdorff
from .pipeline.config import load_settings
from .registration.affine.align import Alignment, align
from .registration.affine.settings import AlignmentSettings
from .registration.annotations import Annotations
from .registration.deformable import register
from .registration.discrete import discrete_start
from .registration.evidence import Evidence
from .registration.keypoints import Keypoints, keypoint_start
from .registration.result import RegistrationResult
from .registration.settings import (
    DiscreteSettings,
    KeypointSettings,
    RegistrationSettings,
)
from .registration.template import AveragingSettings, Template, build_template
from .registration.tissue import TissueFit, TissueOutcome
from .registration.verdict import Finding, Verdict
from .solvers.base import Solution, Status

__version__: str

# fmt: off
__all__ = [
    "Affine", "Alignment", "AlignmentSettings", "Annotations", "AveragingSettings", "ComputationError",
    "DeformationSettings", "Diagnosis", "DiscreteSettings", "Displacement", "Evaluation", "Evidence", "Finding",
    "Grid", "Image", "InputError", "KeypointSettings", "Keypoints", "Measures", "MonitorSettings", "NewtonSettings",
    "OdeSolver", "RegistrationResult", "RegistrationSettings", "Solution", "SolverSettings", "Status", "Template",
    "TissueFit", "TissueOutcome", "TorchdeformError", "Transform", "Verdict", "Weights", "align", "average_maps",
    "ball_monitor", "box_monitor", "build_template", "compose", "curl", "curvature_monitor", "density_monitor",
    "diagnose", "dice", "discrete_start", "divergence", "find_velocity", "from_jacobian_and_curl",
    "gradient_monitor", "grid_from_initial_monitor", "grid_from_target_monitor", "hausdorff", "hold_rigid",
    "hold_volume", "integrate", "invert", "jacobian_determinant", "keypoint_start", "label_fit", "label_monitor",
    "line_monitor", "load_settings", "monitor_misfit", "normalise_monitor", "read_image", "read_labels",
    "read_points", "read_transform", "reconstruct", "register", "ring_monitor", "simulate_volume_change",
    "solve_div_curl", "track_moving_monitor", "warp", "write_image", "write_labels", "write_points",
    "write_transform",
]
# fmt: on

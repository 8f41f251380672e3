"""Layers: what the library does, as modules of torch.nn for training pipelines."""

from torchdeform.nn.augmentation import RandomDeformation, RandomMap
from torchdeform.nn.conversions import from_grid_sample, from_itk, from_voxels, to_grid_sample, to_itk, to_voxels
from torchdeform.nn.heads import JacobianCurlHead
from torchdeform.nn.losses import (
    CurlLoss,
    DeterminantLoss,
    DiceLoss,
    DivergenceLoss,
    InverseConsistencyLoss,
    SimilarityLoss,
)
from torchdeform.nn.registration import DeformableRegistration
from torchdeform.nn.spatial import SpatialTransformer
from torchdeform.nn.velocity import DivCurlVelocity, FlowIntegrator

__all__ = [
    "CurlLoss",
    "DeformableRegistration",
    "DeterminantLoss",
    "DiceLoss",
    "DivCurlVelocity",
    "DivergenceLoss",
    "FlowIntegrator",
    "InverseConsistencyLoss",
    "JacobianCurlHead",
    "RandomDeformation",
    "RandomMap",
    "SimilarityLoss",
    "SpatialTransformer",
    "from_grid_sample",
    "from_itk",
    "from_voxels",
    "to_grid_sample",
    "to_itk",
    "to_voxels",
]

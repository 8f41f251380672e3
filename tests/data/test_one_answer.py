"""Every solver and every way to integrate a flow gives a real pair nearly the same map. Skipped without the images.

All make as many steps: where a level stops is decided by a share of its rise, and one step more or less moves a map by
some hundredths of a voxel, whatever computes it.
"""

import sys

import pytest

import torchdeform as td

pytestmark = [pytest.mark.data, pytest.mark.slow]

PAIRS = {
    "slice": ("mindboggle_2d/subject1.nii.gz", "mindboggle_2d/subject2.nii.gz"),
    "heart": ("heart_2d/SC-HF-I-09_slice12_ED.png", "heart_2d/SC-HF-I-09_slice12_ES.png"),
    "hippocampus": ("hippocampus_3d/hippocampus_001.nii.gz", "hippocampus_3d/hippocampus_003.nii.gz"),
}
STEPS = {"optimiser.steps": [14, 18, 14], "optimiser.tolerance": 0.0}
# The preset `reference` takes each piece of the method as it is written down.
WAYS = {
    "cg": ("default", {"solver": "cg"}),
    "assembled": ("default", {"solver": "assembled"}),
    "rk4": ("default", {"flow.method": "rk4"}),
    "reference": ("reference", {}),
}


@pytest.fixture(scope="module", params=PAIRS)
def pair(request, data_folder):
    fixed, moving = (td.read_image(data_folder / name) for name in PAIRS[request.param])
    aligned = td.align(fixed, moving).affine
    return (
        fixed,
        moving,
        aligned,
        td.register(fixed, moving, td.load_settings("default", overrides=STEPS), affine=aligned),
    )


@pytest.mark.parametrize("way", WAYS)
def test_the_map_is_that_of_the_default(pair, way):
    fixed, moving, affine, default = pair
    preset, overrides = WAYS[way]
    found = td.register(fixed, moving, td.load_settings(preset, overrides=overrides | STEPS), affine=affine)
    apart = (found.displacement - default.displacement) / fixed.grid.along(fixed.grid.spacing, found.displacement)
    assert apart.square().sum(1).sqrt().mean() < 0.1
    assert found.diagnosis.folds.item() == 0
    assert "torchdiffeq" in sys.modules

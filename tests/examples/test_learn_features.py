"""The example that learns features is nearer to the truth than MIND in a few steps; `register` takes its program."""

import re
import subprocess
import sys

import torch

import torchdeform as td


def test_its_program_brings_two_contrasts_together(root, tmp_path):
    program = tmp_path / "features.ts"
    script = [sys.executable, str(root / "examples" / "learn_features.py"), str(program)]
    done = subprocess.run([*script, "--dim", "2", "--steps", "30"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    learned, *others = map(float, re.findall(r"never seen (\S+)", done.stdout))
    assert learned < 0.85 * min(others)
    (fixed, wanted), (moving, there) = disc(20.0, (0.0, 1.0, 0.3)), disc(14.0, (0.6, 0.1, 0.9))
    result = td.register(fixed, moving, td.RegistrationSettings(features=str(program)))
    warped = td.warp(there.float(), result.displacement, td.Grid((64, 64)), mode="nearest")
    assert td.dice(wanted, there, (1,)).item() < 0.7
    assert td.dice(wanted, warped.long(), (1,)).item() > 0.95


def disc(radius: float, greys: tuple[float, float, float]) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the picture of a disc in a larger one, and where it is, ``(1, 1, 64, 64)`` both."""
    distance = (td.Grid((64, 64)).points() - 31.5).norm(dim=1, keepdim=True)
    labels = (distance < radius).long() + 2 * ((distance >= radius) & (distance < 28)).long()
    return torch.tensor(greys)[labels], (labels == 1).long()

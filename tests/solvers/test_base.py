"""The outcome of a solve: only what converged is fine, and everything else says what to do."""

import pytest
import torch

from torchdeform.solvers.base import Solution, Status


@pytest.mark.parametrize("status", Status)
def test_only_what_converged_is_fine(status):
    assert status.ok == (status is Status.CONVERGED)
    assert status.ok or ":" in status.value  # what happened: what to do about it


@pytest.mark.parametrize(("second", "ok"), [(Status.CONVERGED, True), (Status.ROUNDING, False)])
def test_a_batch_is_fine_when_all_its_items_are(second, ok):
    zeros = torch.zeros(2)
    assert Solution(zeros, (Status.CONVERGED, second), zeros.long(), zeros).ok == ok

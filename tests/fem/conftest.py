"""The oracle of the finite elements."""

import pytest
from brute_force import Brute


@pytest.fixture
def brute() -> type[Brute]:
    """The brute-force assembly: ``brute(shape, spacing, points=3)``."""
    return Brute

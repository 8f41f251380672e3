"""Settings: frozen, and with a copy of their own of what they were given."""

from dataclasses import FrozenInstanceError, asdict

import pytest
from nested_settings import settings_of


def test_settings_keep_what_they_were_made_with():
    weights = {"lncc": 1.0, "mi": 0.5}
    settings = settings_of(similarity=weights)
    weights["mi"] = 2.0
    assert settings.similarity == {"lncc": 1.0, "mi": 0.5}
    with pytest.raises(FrozenInstanceError):
        settings.similarity = "lncc"  # type: ignore[misc]


def test_settings_can_be_made_again_from_their_values():
    settings = settings_of(similarity={"ncc": 2.0, "ngf": 1.0})
    assert settings_of(**asdict(settings)) == settings

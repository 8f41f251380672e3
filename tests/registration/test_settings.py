"""Settings: frozen, and with a copy of their own of what they were given."""

from dataclasses import FrozenInstanceError, asdict

import pytest
from nested_settings import settings_of

from torchdeform.errors import InputError
from torchdeform.pipeline.config import load_settings
from torchdeform.registration.settings import RegistrationSettings


def test_settings_keep_what_they_were_made_with():
    weights = {"lncc": 1.0, "mi": 0.5}
    settings = settings_of(similarity=weights)
    weights["mi"] = 2.0
    assert settings.similarity.measure == {"lncc": 1.0, "mi": 0.5}
    with pytest.raises(FrozenInstanceError):
        settings.similarity = "lncc"  # type: ignore[misc]
    with pytest.raises(FrozenInstanceError):
        settings.similarity.measure = "lncc"  # type: ignore[misc]


def test_settings_can_be_made_again_from_their_values():
    settings = settings_of(similarity={"ncc": 2.0, "ngf": 1.0})
    assert load_settings(overrides=asdict(settings)) == settings


def test_a_group_may_be_given_by_its_leading_value():
    """``solver: cg`` is ``solver: {method: cg}``, in Python too; what is not said stays as it is by default."""
    short = RegistrationSettings(align="rigid", similarity={"mi": 1.0}, solver="cg", flow="rk4")  # type: ignore[arg-type]
    assert short == settings_of(align="rigid", similarity={"mi": 1.0}, solver="cg", flow="rk4")
    assert (short.align.kind, short.solver.method, short.flow.method, short.flow.steps) == ("rigid", "cg", "rk4", 1)
    with pytest.raises(InputError, match="did you mean 'assembled'"):
        RegistrationSettings(solver="asembled")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="stencil must be one of"):
        RegistrationSettings(stencil="shift")


@pytest.mark.parametrize(("given", "kept"), [("off", "off"), (False, "off"), ("auto", "auto"), (True, "auto")])
def test_off_may_be_written_as_yaml_reads_it(given, kept):
    assert RegistrationSettings(absent=given).absent == kept
    assert load_settings("default", overrides={"absent": given}).absent == kept


def test_auto_is_decided_by_what_is_compared():
    plain = RegistrationSettings().decided()
    assert (plain.similarity.measure, plain.start) == ("lncc", "identity")
    other = RegistrationSettings().decided("mind")
    assert (other.similarity.measure, other.start) == ("mind", "discrete")
    given = settings_of(similarity="mi").decided("mind")
    assert (given.similarity.measure, given.start) == ("mi", "identity")
    assert settings_of(similarity="mind", start="identity").decided().start == "identity"

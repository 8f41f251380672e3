"""Settings: frozen, and with a copy of their own of what they were given."""

from dataclasses import FrozenInstanceError, asdict
from pathlib import Path

import pytest
from nested_settings import settings_of

from torchdeform.errors import InputError
from torchdeform.pipeline.config import load_settings
from torchdeform.registration.settings import TISSUES, RegistrationSettings


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


def test_tissue_may_be_named_or_priced():
    given = {1: "rigid", 2: {"div": 3.0, "curl": 0.0, "strain": 0.5}}
    settings = settings_of(tissues=given, sliding=(2, 5))
    given[1] = "free"
    assert settings.tissues == {1: "rigid", 2: {"div": 3.0, "curl": 0.0, "strain": 0.5}}
    assert settings.knows_tissue
    assert settings_of(sliding=(1,)).knows_tissue
    assert not settings_of().knows_tissue
    assert settings.decided("mind").tissues == settings.tissues
    assert load_settings(overrides=asdict(settings)) == settings


@pytest.mark.parametrize("kind", TISSUES)
def test_kinds_of_tissue_cost_what_settings_may_say(kind):
    assert settings_of(tissues={1: TISSUES[kind]}).tissues == {1: TISSUES[kind]}


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"tissues": {1: "bone"}}, "tissues: label 1 must be one of"),
        ({"tissues": {1: "ridgid"}}, "did you mean 'rigid'"),
        ({"tissues": {2: {"shear": 1.0}}}, "tissues: label 2 must be one of"),
        ({"tissues": {2: {"div": 0.0}}}, "label 2: div must be finite and positive, got 0"),
        ({"tissues": {2: {"strain": -1.0}}}, "label 2: strain must be finite and at least 0, got -1"),
        ({"tissues": {2: {"curl": float("inf")}}}, "label 2: curl must be finite and at least 0, got inf"),
        ({"tissues": {2: {"div": float("nan")}}}, "label 2: div must be finite and positive, got nan"),
        ({"tissues": {2: {"curl": 0.0}}}, "curl and strain must not both be 0"),
        ({"tissues": {0: "rigid"}}, "tissues: labels are whole numbers from 1"),
        ({"sliding": (0,)}, "sliding: labels are whole numbers from 1"),
        ({"sliding": (-3,)}, "sliding: labels are whole numbers from 1"),
    ],
)
def test_tissue_that_cannot_be_is_named(values, said):
    with pytest.raises(InputError, match=said):
        settings_of(**values)


def test_features_are_names_files_programs_or_several_with_weights():
    def program(image):
        return image

    assert settings_of().sources == {}
    assert not settings_of(features={"intensities": 1, "net.ts": 2}).only_features
    alone = settings_of(features=program).decided()
    assert (alone.similarity.measure, alone.seen_by, alone.maximised) == ("ssd", "lncc", "ssd of features")
    several = settings_of(features={"intensities": 1, "net.ts": 0.5, "mind": 1}, labels_weight=2.0)
    assert several.programs == ("net.ts",)
    assert several.with_programs(lambda name: Path("/there") / name).sources["/there/net.ts"] == 0.5
    assert settings_of(features="net.ts").with_programs(lambda name: Path("/a") / name).features == "/a/net.ts"
    assert several.maximised == "lncc + features + labels"
    for wrong, problem in (
        ({"features": 3}, "features must be mind, a file of a program"),
        ({"features": ["mind", "net.ts"]}, r"several with their weights as .*, got \['mind', 'net.ts'\]"),
        ({"features": ("mind", ["net.ts"])}, "features must be mind, a file of a program"),
        ({"features": ""}, "features must be mind, a file of a program"),
        ({"features": {"mind": 0.0}}, "features: the weight of mind must be a positive"),
        ({"features": {"intensities": 1.0}}, "features: intensities alone"),
        ({"features": "mind", "similarity": "mind"}, "similarity: mind makes features of its own"),
        ({"labels_weight": -1.0}, "labels_weight must be finite and not negative"),
    ):
        with pytest.raises(InputError, match=problem):
            settings_of(**wrong)


def test_features_in_layers_of_settings_take_the_place_of_others(tmp_path):
    (tmp_path / "s.yaml").write_text("features: {intensities: 1, net.ts: 0.5}\nlabels_weight: 1\n", encoding="utf-8")
    settings = load_settings(file=tmp_path / "s.yaml")
    assert settings.features == {"intensities": 1, "net.ts": 0.5}
    assert load_settings(file=tmp_path / "s.yaml", overrides={"features": {"mind": 1, "a.b": 2}}).features == {
        "mind": 1,
        "a.b": 2,
    }
    assert load_settings(file=tmp_path / "s.yaml", overrides={"features": None}).features is None

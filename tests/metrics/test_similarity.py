"""Similarities by name: which features, which weights, which settings; and that a registration can climb each."""

import pickle
from dataclasses import asdict, replace

import pytest
import torch
from metric_images import images as related
from metric_images import soft_mask
from nested_settings import changed, settings_of

from torchdeform.cohort.estimate import estimate
from torchdeform.cohort.plan import Job
from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.core.warp import warp
from torchdeform.errors import InputError
from torchdeform.io import write_image
from torchdeform.metrics.mind import mind_ssc
from torchdeform.metrics.similarity import (
    MEASURES,
    features,
    make_similarity,
    mark,
    measure_name,
    needs_common_scale,
    similarity_weights,
)
from torchdeform.nn import DeformableRegistration, SimilarityLoss
from torchdeform.pipeline.citations import citations
from torchdeform.pipeline.config import load_settings
from torchdeform.pipeline.memory import footprint
from torchdeform.pipeline.register import PairFiles
from torchdeform.registration.affine.settings import AlignmentSettings
from torchdeform.registration.deformable import register

SHAPES = [(9, 12), (8, 9, 10)]
PAIRS = {2: 4, 3: 12}


def images(shape: tuple[int, ...], channels: int = 2) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.rand(2, 2, channels, *shape, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("shape", SHAPES)
def test_features_are_the_image_its_mind_or_both(shape):
    image = images(shape)[0]
    count = 2 * PAIRS[len(shape)]
    assert features({"lncc": 1, "mi": 2}, image) is image
    assert torch.equal(features("mind", image), mind_ssc(image))
    both = features({"mind": 1, "ssd": 2}, image)
    assert both.shape == (2, 2 + count, *shape)
    assert torch.equal(both, torch.cat([image, mind_ssc(image)], dim=1))


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("weights", [{"lncc": 1, "mi": 3}, {"mind": 2, "ngf": 1, "ssd": 0.5}, {"mind": 2.5}])
def test_a_combination_is_the_weighted_mean(weights, shape, masked):
    grid = Grid(shape, (1.0, 2.0, 0.5)[: len(shape)])
    fixed, warped = (features(weights, x) for x in images(shape))
    mask = torch.rand(2, 1, *shape, dtype=torch.float64) if masked else None
    value, slope = make_similarity(weights, fixed, 5, grid=grid).evaluate(warped, mask)
    expected, total, count = torch.zeros_like(slope), 0, fixed.shape[1]
    for name, weight in weights.items():
        alone = count > 2 and len(weights) == 1
        own = slice(0 if alone else 2, None) if name == "mind" else slice(0, 2)
        part = make_similarity(name, fixed[:, own], 5, grid=grid).evaluate(warped[:, own], mask)
        share = weight / sum(weights.values())
        total = total + share * part[0]
        expected[:, own] += share * part[1] * count / fixed[:, own].shape[1]
    torch.testing.assert_close(value, total)
    torch.testing.assert_close(slope, expected)


@pytest.mark.parametrize("weights", [{"ncc": 1, "lncc": 2}, {"mind": 1, "mi": 2}])
def test_the_derivative_of_a_combination_is_that_of_its_value(weights):
    fixed, warped = (features(weights, x) for x in images((8, 9)))
    similarity, step = make_similarity(weights, fixed, 5), 1e-5
    direction = torch.randn(warped.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    direction = direction * ((warped > 0.01) & (warped < 0.99))
    ahead, behind = (similarity.evaluate(warped + sign * step * direction)[0] for sign in (1, -1))
    slope = (similarity.evaluate(warped)[1] * direction).flatten(1).mean(1)
    torch.testing.assert_close((ahead - behind) / (2 * step), slope, rtol=1e-4, atol=1e-7)


def test_only_a_squared_difference_of_intensities_needs_one_scale():
    assert [name for name in MEASURES if needs_common_scale(name)] == ["ssd"]
    assert needs_common_scale({"mi": 1, "ssd": 0.1})
    assert not needs_common_scale({"mi": 1, "mind": 0.1})


@pytest.mark.parametrize(
    ("similarity", "message"),
    [
        ("lnc", "did you mean 'lncc'"),
        ("", "must be auto, name one of ssd, ncc"),
        ({}, "must be auto, name one of ssd, ncc"),
        (5, "must be auto, name one of ssd, ncc"),
        (["lncc"], "must be auto, name one of ssd, ncc"),
        ({"lncc": 1, "mindd": 1}, "did you mean 'mind'"),
        ({"lncc": 0}, "weight of lncc must be a positive finite number, got 0"),
        ({"lncc": -1.0}, "weight of lncc"),
        ({"mi": float("nan")}, "weight of mi"),
        ({"mi": float("inf")}, "weight of mi"),
        ({"mi": "much"}, "weight of mi"),
        ({3: 1.0}, "similarity must be one of"),
    ],
)
def test_unknown_names_and_bad_weights_are_explained(similarity, message):
    for function in (similarity_weights, lambda s: settings_of(similarity=s)):
        with pytest.raises(InputError, match=message):
            function(similarity)
    with pytest.raises(InputError, match="similarity"):
        load_settings(overrides={"similarity": similarity})


def test_settings_take_a_name_or_weights():
    assert settings_of(similarity="mi").similarity.measure == "mi"
    given = {"lncc": 1, "mi": 0.5}
    settings = settings_of(similarity=given)
    given["mi"] = 7
    assert settings.similarity.measure == {"lncc": 1, "mi": 0.5}
    assert asdict(settings)["similarity"]["measure"] == {"lncc": 1, "mi": 0.5}
    assert pickle.loads(pickle.dumps(settings)) == settings
    assert changed(settings, window=5).similarity.measure == settings.similarity.measure


def test_weights_come_from_files_and_overrides(tmp_path):
    file = tmp_path / "settings.yaml"
    file.write_text("similarity: {lncc: 1, mind: 5e-1}\n", encoding="utf-8")
    assert load_settings(file=file).similarity.measure == {"lncc": 1.0, "mind": 0.5}
    double = load_settings(file=file, overrides={"similarity.measure.mind": 2})
    assert double.similarity.measure == {"lncc": 1.0, "mind": 2.0}
    assert load_settings(file=file, overrides={"similarity": "mi"}).similarity.measure == "mi"


@pytest.mark.parametrize("similarity", [*MEASURES, {"lncc": 1, "mind": 2}])
def test_a_registration_finds_a_known_map_by_it(similarity):
    """Waves bent by a known map are bent back, with another contrast for the measures that allow it."""
    grid = Grid((64, 60))
    x = grid.points(dtype=torch.float64)
    moving = sum(torch.sin(a * x[:, :1] + b * x[:, 1:] + a) for a, b in ((0.3, 0.2), (0.25, -0.3), (-0.1, 0.4)))
    window = torch.sin(torch.pi * x[:, :1] / 63) * torch.sin(torch.pi * x[:, 1:] / 59)
    truth = torch.cat([2.5 * window, -2 * window], dim=1)
    fixed = warp(moving, truth, grid)
    if similarity not in ("ssd", "ncc"):
        fixed = 5 - 2 * fixed
    settings = settings_of(similarity=similarity, steps=(40, 30), length_scale=6.0)
    result = register(fixed, moving, settings)
    before = truth.square().sum(1).sqrt().mean()
    after = (result.displacement - truth).square().sum(1).sqrt().mean()
    assert after < 0.3 * before
    assert (result.similarity_after > result.similarity_before).all()


def test_a_new_measure_is_a_new_row(monkeypatch, tmp_path):
    """Whoever asks for a measure by name reads the table."""
    row = replace(MEASURES["ncc"], memory=(1e4, 1e4), time=100.0, common_scale=True, references=("new",))
    monkeypatch.setitem(MEASURES, "new", row)
    settings, old = settings_of(similarity="new"), settings_of(similarity="ncc")
    fixed, moving = (torch.rand(1, 1, 64, 64, generator=torch.Generator().manual_seed(k)) for k in (0, 1))
    found = register(fixed, moving, changed(settings, steps=(2,)))
    assert found.similarity_after > found.similarity_before
    assert needs_common_scale("new")
    assert AlignmentSettings(similarity="new").similarity == "new"
    assert load_settings(overrides={"similarity": {"new": 2}}).similarity.measure == {"new": 2.0}
    assert SimilarityLoss("new")(fixed, moving) == SimilarityLoss("ncc")(fixed, moving)
    assert DeformableRegistration(Grid((64, 64)), steps=1, settings=settings)(fixed, moving).abs().max() > 0
    assert footprint(Grid((64, 64)), 1, settings) > footprint(Grid((64, 64)), 1, old)
    assert set(citations(settings)) - set(citations(old)) == {"new"}
    write_image(Image(fixed, Grid((64, 64))), path := tmp_path / "a.nrrd")
    files = PairFiles(fixed=path, moving=path, out=tmp_path)
    slow, fast = (estimate([Job(name="a", files=files, settings=some)]).seconds for some in (settings, old))
    assert slow > fast


def test_several_measures_have_one_name():
    assert (measure_name("mi"), measure_name({"lncc": 1, "mi": 0.5})) == ("mi", "lncc + mi")


@pytest.mark.parametrize("shape", [(48, 40), (22, 20, 18)])
@pytest.mark.parametrize("name", [*MEASURES, "several"])
def test_a_mark_is_1_for_the_image_itself_and_about_0_for_noise(name, shape):
    similarity = {"lncc": 1.0, "mind": 2.0} if name == "several" else name
    first, second = torch.rand(2, 1, 1, *shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    mask = soft_mask(shape, items=1)
    for given in (None, mask):
        assert mark(similarity, first, first, mask=given).item() == pytest.approx(1, abs=1e-9)
        assert abs(mark(similarity, first, second, mask=given).item()) < 0.1


@pytest.mark.parametrize("name", list(MEASURES))
def test_a_mark_looks_only_where_there_is_contrast(name):
    """A picture on a large empty background has the mark of the picture alone, nearly."""
    fixed, warped = related((40, 40), items=1)
    wide = [torch.nn.functional.pad(x, (0, 120), value=0.0) for x in (fixed, warped)]
    alone, padded = mark(name, fixed, warped).item(), mark(name, *wide).item()
    assert padded == pytest.approx(alone, abs=0.12)


def test_the_mark_of_ssd_is_the_concordance_correlation():
    first, second = related((30, 34), items=1)
    f, w = first.flatten(), (second + 0.1).flatten()
    covariance = ((f - f.mean()) * (w - w.mean())).mean()
    expected = 2 * covariance / (f.var(correction=0) + w.var(correction=0) + (f.mean() - w.mean()).square())
    assert mark("ssd", first, second + 0.1).item() == pytest.approx(expected.item(), rel=1e-3)

"""Labels of tissue and what the settings say of them: what does not go together is named before any long work."""

from dataclasses import replace

import pytest
import torch

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.pipeline.preflight import ERROR, NOTE, WARNING
from torchdeform.pipeline.tissue import check_tissue, contradiction
from torchdeform.registration.settings import RegistrationSettings

RIGID = RegistrationSettings(tissues={1: "rigid"})


def image_of(shape, *, spacing=1.0, origin=0.0, name="t1.nii", unit="mm"):
    dim = len(shape)
    return Image(torch.zeros(1, 1, *shape), Grid(shape, (spacing,) * dim), (origin,) * dim, name=name, unit=unit)


def labelled(shape, regions, **how):
    """Return labels that are 0 but in boxes of so many nodes at a corner each."""
    image = image_of(shape, name="tissue.nii", **how)
    for label, (start, size) in regions.items():
        image.data[(..., *(slice(start, start + size) for _ in shape))] = label
    return image


@pytest.mark.parametrize(
    ("given", "settings", "words"),
    [
        (False, {}, ""),
        (True, {}, ""),  # what its labels may be is said once they are read
        (True, {"tissues": {1: "rigid"}}, ""),
        (False, {"tissues": {1: "rigid"}, "sliding": (3,)}, "name labels (1, 3), but there is no --tissue; give"),
        (False, {"sliding": (3,)}, "but there is no --tissue"),
        (True, {"sliding": (3,), "symmetric": True}, "symmetric: tissue is known of the fixed image only"),
    ],
)
def test_files_and_settings_that_contradict_each_other(given, settings, words):
    found = contradiction(given, RegistrationSettings(**settings))
    assert words in found
    assert bool(found) == bool(words)


@pytest.mark.parametrize("dim", [2, 3])
def test_labels_that_are_there_pass(dim):
    labels = labelled((20,) * dim, {1: (2, 6), 2: (10, 5), 255: (16, 3)})
    settings = RegistrationSettings(tissues={1: "rigid", 2: {"div": 3.0}}, sliding=(255, 1))
    assert list(check_tissue(image_of((20,) * dim), labels, settings)) == []


@pytest.mark.parametrize(
    ("regions", "settings", "sentence"),
    [
        ({}, RIGID, "tissue.nii has no label above 0; check that it is the right file"),
        ({-3: (1, 5)}, RIGID, "tissue.nii has no label above 0; check that it is the right file"),
        ({1.5: (1, 5)}, RIGID, "tissue.nii must hold whole numbers, the labels of tissue; check that it is the"),
        (
            {float("nan"): (1, 5)},
            RIGID,
            "tissue.nii must hold whole numbers, the labels of tissue; check that it is the",
        ),
        ({255: (1, 5)}, RIGID, "tissue.nii has no label 1, which tissues names; it has the label 255"),
        (
            {1: (1, 5), 7: (9, 5)},
            RegistrationSettings(tissues={1: "rigid"}, sliding=(2,)),
            "tissue.nii has no label 2, which sliding names; it has the labels 1, 7",
        ),
        (
            {4: (1, 5), 7: (9, 5)},
            RegistrationSettings(),
            "tissue.nii has the labels 4, 7, and settings must say what they are: add --set tissues.4=rigid (or free, "
            "stiff, incompressible), or --set 'sliding=[4]'",
        ),
    ],
)
def test_labels_that_settings_cannot_name(regions, settings, sentence):
    (found,) = check_tissue(image_of((20, 20)), labelled((20, 20), regions), settings)
    assert found.severity == ERROR
    assert found.text.startswith(sentence)


def test_a_sentence_lists_some_labels_of_many():
    labels = labelled((40, 40), {k: (k, 1) for k in range(1, 40)})
    (found,) = check_tissue(image_of((40, 40)), labels, RegistrationSettings(tissues={99: "rigid"}))
    assert found.text.endswith("it has the labels 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12 and 27 more")


@pytest.mark.parametrize(("size", "count"), [(1, "1 voxel"), (2, "4 voxels")])
def test_labels_that_are_too_small_are_doubtful(size, count):
    (found,) = check_tissue(image_of((20, 20)), labelled((20, 20), {1: (4, size)}), RIGID)
    assert found.severity == WARNING
    assert found.text == f"label 1 of tissue.nii has {count} of t1.nii, too few to keep their shape; draw it larger"


def test_voxels_are_counted_where_the_image_has_them():
    """Labels of a finer grid, between the nodes of the image, and of one that goes beyond it."""
    fine = labelled((39, 39), {1: (5, 1), 2: (20, 10)}, spacing=0.5)
    (found,) = check_tissue(image_of((20, 20)), fine, RIGID)
    assert found.severity == ERROR
    assert found.text.startswith("label 1 of tissue.nii is at no voxel of t1.nii; correct the place of the labels")
    beyond = labelled((60, 60), {1: (40, 10), 2: (5, 5)})
    assert [f.severity for f in check_tissue(image_of((20, 20)), beyond, RIGID)] == [WARNING, ERROR]


@pytest.mark.parametrize(
    ("labels", "sentence"),
    [
        (
            labelled((16, 20), {1: (1, 9)}, unit="px"),
            "tissue.nii is 20×16 but t1.nii is 20×20; give labels with a value",
        ),
        (
            labelled((20, 20), {1: (1, 9)}, origin=100.0),
            "tissue.nii lies beside t1.nii; correct the origin and spacing",
        ),
        (
            labelled((20, 20, 20), {1: (1, 9)}),
            "tissue.nii is 3D with 1 channels; labels of tissue in t1.nii must be 2D",
        ),
        (
            replace(labelled((20, 20), {1: (1, 9)}), data=torch.ones(1, 3, 20, 20)),
            "tissue.nii is 2D with 3 channels; labels of tissue in t1.nii must be 2D with one channel",
        ),
    ],
)
def test_labels_of_another_image_are_refused_once(labels, sentence):
    (found,) = check_tissue(image_of((20, 20), unit=labels.unit), labels, RIGID)
    assert found.severity == ERROR
    assert found.text.startswith(sentence)


def test_without_settings_the_labels_are_a_note():
    (found,) = check_tissue(image_of((20, 20)), labelled((20, 20), {2: (4, 9)}))
    assert found.severity == NOTE
    said = "tissue.nii has the label 2, and settings must say what they are: add --set tissues.2="
    assert found.text.startswith(said)

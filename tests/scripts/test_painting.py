"""What is painted goes with its label map, and with the contrast that is asked for."""

import importlib.util

import pytest
import torch


@pytest.fixture
def painting(root):
    spec = importlib.util.spec_from_file_location("painting", root / "scripts" / "painting.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def halves(first: int, second: int, *shape: int) -> torch.Tensor:
    """Return a map with one label before the middle of the last axis, and one after."""
    labels = torch.full((1, 1, *shape), first)
    labels[..., shape[-1] // 2 :] = second
    return labels


@pytest.mark.parametrize("shape", [(40, 40), (20, 20, 40)])
def test_white_matter_is_brighter_than_cortex_in_t1_and_darker_in_t2(painting, shape):
    labels = halves(2, 3, *shape)
    for contrast, sign in (("t1", 1), ("t2", -1)):
        image = painting.paint(labels, contrast, seed=1)
        assert image.shape == labels.shape
        assert 0 <= image.min() <= image.max() <= 1
        assert sign * (image[labels == 2].mean() - image[labels == 3].mean()) > 0.1


def test_a_drawn_contrast_is_that_of_the_label_whatever_else_is_there(painting):
    plain = {"seed": 1, "noise": 0.0}
    one, other = (painting.paint(halves(5, largest, 20, 40), 7, **plain) for largest in (9, 900))
    assert torch.equal(one[..., :10], other[..., :10])
    assert not torch.allclose(one, painting.paint(halves(5, 9, 20, 40), 8, **plain), atol=0.05)


def test_the_same_seed_paints_the_same(painting):
    labels = halves(2, 4, 20, 40)
    assert torch.equal(painting.paint(labels, "t1", 3), painting.paint(labels, "t1", 3))
    assert not torch.equal(painting.paint(labels, "t1", 3), painting.paint(labels, "t1", 4))

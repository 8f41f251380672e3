"""What can be set of an alignment: defaults by the number of axes, values that are refused."""

import pickle
from dataclasses import asdict

import pytest
import torch
from affine_pairs import make_pair, make_true, turn

from torchdeform.errors import InputError
from torchdeform.registration.affine.align import align
from torchdeform.registration.affine.settings import ALIGNMENTS, AlignmentSettings


@pytest.mark.parametrize("dim", [2, 3])
def test_settings_left_open_go_by_the_number_of_axes(dim):
    window, nodes = {2: (7, 20_000), 3: (5, 150_000)}[dim]
    open_, said = AlignmentSettings(), AlignmentSettings(window=9, nodes=5000)
    assert (open_.window_in(dim), open_.nodes_in(dim)) == (window, nodes)
    assert (said.window_in(dim), said.nodes_in(dim)) == (9, 5000)
    fixed, moving = make_pair(make_true(turn(dim, 10)))
    first, second = (align(fixed, moving, settings=s) for s in (open_, AlignmentSettings(window=window, nodes=nodes)))
    assert torch.equal(first.affine.matrix, second.affine.matrix)


@pytest.mark.parametrize("kind", ALIGNMENTS)
def test_settings_can_be_copied_and_stored(kind):
    given = {"lncc": 1, "mi": 0.5}
    settings = AlignmentSettings(kind=kind, similarity=given)
    given["mi"] = 7
    assert asdict(settings)["similarity"] == {"lncc": 1, "mi": 0.5}
    assert next(iter(asdict(settings))) == "kind"
    assert pickle.loads(pickle.dumps(settings)) == settings


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: AlignmentSettings(kind="rigit"), "kind must be one of .* did you mean 'rigid'"),
        (lambda: AlignmentSettings(similarity="nncc"), "did you mean 'ncc'"),
        (lambda: AlignmentSettings(window=4), "window must be"),
        (lambda: AlignmentSettings(min_overlap=0.0), "min_overlap must"),
        (lambda: AlignmentSettings(nodes=10), "nodes must"),
        (lambda: AlignmentSettings(steps=0), "steps must"),
    ],
)
def test_bad_settings_are_one_sentence(call, sentence):
    with pytest.raises(InputError, match=sentence):
        call()

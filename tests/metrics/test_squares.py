"""Squared differences of features."""

import torch
from metric_images import images

from torchdeform.metrics.mind import mind_ssc
from torchdeform.metrics.similarity import features, make_similarity
from torchdeform.metrics.squares import mind


def test_mind_is_the_mean_squared_difference_of_features():
    fixed, warped = images((9, 8, 7), channels=2)
    expected = -((mind_ssc(fixed, radius=2) - mind_ssc(warped, radius=2)) ** 2).mean(dim=(1, 2, 3, 4))
    torch.testing.assert_close(mind(fixed, warped, radius=2), expected)
    value, _ = make_similarity("mind", features("mind", fixed)).evaluate(features("mind", warped))
    torch.testing.assert_close(value, mind(fixed, warped))

"""Names of pairs: they stay inside their folder, and a selection finds them."""

import re

from hypothesis import given
from hypothesis import strategies as st

from torchdeform.cohort.names import clean, image_name, pair_name, select


@given(st.text(max_size=300), st.text(max_size=300))
def test_names_made_of_anything_stay_in_their_folder(tmp_path_factory, one, other):
    root = tmp_path_factory.getbasetemp()
    fixed, moving = root / "f.png", root / "m.png"
    for name in (clean(one), image_name(fixed, {"subject": one}), pair_name(fixed, moving, {"a": one}, {"a": other})):
        assert re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,299}", name)


def test_selection_is_by_name_beginning_or_pattern():
    names = ["sub-1", "sub-1_ses-2", "sub-10", "sub-2_ses-1"]
    assert select(names, "sub-1") == names[:2]
    assert select(names, "sub-1*") == names[:3]
    assert select(names, "*_ses-?") == [names[1], names[3]]
    assert select(names, "sub") == []

"""Options: one name for one thing."""

import re

from torchdeform.cli.main import VERBS, torchdeform


def test_one_name_for_one_thing(capsys):
    """An option of two verbs has one meaning: one placeholder, whether it is a flag or takes a value."""
    kinds: dict[str, set[str]] = {}
    for verb in VERBS:
        assert torchdeform([verb, "--help"]) == 0
        for name, kind in re.findall(r"│ (?:\*  )?(--[a-z-]+) +([A-Z=]*)", capsys.readouterr().out):
            kinds.setdefault(name, set()).add(kind)
    several = {name: kind for name, kind in kinds.items() if len(kind) > 1}
    assert set(several) <= {"--out", "--reference"}  # a file or a folder; the metavar says which

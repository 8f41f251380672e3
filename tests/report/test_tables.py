"""The figures of the page: the worst come first, long tables are folded, what was not measured is left out."""

import pytest

from torchdeform.report.tables import command_lines, file_name, tables, tiles


@pytest.fixture
def record(make_full):
    return make_full(3, labels=3, landmarks=14)[1]


def test_tiles_say_what_was_measured(record):
    names = [tile.name for tile in tiles(record)]
    assert {"Folds", "Similarity (lncc + mi)", "Dice of the labels", "Distance of landmarks", "Time"} <= set(names)
    bare = tiles(record | {"evaluation": {}})
    assert len(bare) == len(names) - 2


def test_the_worst_label_comes_first_and_long_tables_are_folded(record):
    dice = record["evaluation"]["after"]["dice"]
    dice |= dict(zip(dice, (0.9, 0.2, 0.5), strict=True))
    found = {table.title: table for table in tables(record)}
    assert [row[0] for row in found["Labels"].parts[0].rows] == ["2", "3", "1"]
    assert [bool(part.fold) for part in found["Landmarks"].parts] == [False, True]
    assert len(found["Landmarks"].parts[1].rows) == 14
    assert found["Time and memory"].parts[0].rows[0] == ["read", "0.1 s", "0.10 GB"]


def test_tissue_is_shown_before_and_after(record):
    (part,) = next(table.parts for table in tables(record) if table.title == "Tissue")
    assert [list(row) for row in part.rows] == [
        ["1", "rigid", "1,234", "0.312 → 0.02", "4 % → 0.01 %", "+1 % → +0 %"],
        ["2", "incompressible", "1,234", "2 → 2.1", "4.1 % → 0.8 %", "-2.1 % → +0.02 %"],
        ["3", "stiff", "1,234", "1.5", "20 %", "+12 %"],
        ["14", "own prices, sliding", "0", "–", "–", "–"],
    ]
    assert part.head[3:] == ["off a rigid motion", "determinant within", "volume"]


def test_what_is_not_known_has_no_table(record):
    bare = record | {"evaluation": {}, "levels": [], "tissue": []}
    titles = [table.title for table in tables(bare)]
    assert titles == ["Time and memory", "Files", "Settings and versions"]


def test_commands_are_those_of_the_record(record):
    lines = command_lines(record)
    assert record["command"] in lines.values()
    assert len(lines) > 1
    assert command_lines({}) == {}
    assert file_name({"path": "/some/where/a.png"}) == "a.png"

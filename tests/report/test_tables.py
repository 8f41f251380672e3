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


def test_what_is_not_known_has_no_table(record):
    bare = record | {"evaluation": {}, "levels": []}
    titles = [table.title for table in tables(bare)]
    assert titles == ["Time and memory", "Files", "Settings and versions"]


def test_commands_are_those_of_the_record(record):
    lines = command_lines(record)
    assert record["command"] in lines.values()
    assert len(lines) > 1
    assert command_lines({}) == {}
    assert file_name({"path": "/some/where/a.png"}) == "a.png"

"""The cohort file: what it means, what is refused and where, and what editors are told."""

import json

import pytest

from torchdeform.cli.main import torchdeform
from torchdeform.cohort.schema import Cohort, cohort_schema, read_cohort
from torchdeform.errors import InputError
from torchdeform.pipeline.config import configs_folder, load_settings

_LIST = "pairs:\n  list:\n    - fixed: a.png\n      moving: b.png\n"


_PATTERN = "pairs:\n  pattern:\n    files: '{subject}.png'\n    pairing: all\n"


def test_paths_are_relative_to_the_file_and_variables_filled_in(cohort_of, tmp_path, monkeypatch):
    monkeypatch.setenv("IMAGES", "/data/of [me]")
    cohort = cohort_of("pairs:\n  list:\n    - {fixed: ../up/a.png, moving: '${IMAGES}/b$$.png'}\n")
    pair = cohort.pairs.list[0]
    assert cohort.out == tmp_path / "results"
    assert pair.fixed == tmp_path.parent / "up" / "a.png"
    assert str(pair.moving) == "/data/of [me]/b$.png"


def test_what_a_variable_holds_is_no_pattern(touch, cohort_of, monkeypatch):
    folder = touch(["set [1]/a.png", "set 1/b.png"])
    monkeypatch.setenv("IMAGES", str(folder / "set [1]"))
    from torchdeform.cohort.pairs import find_images

    cohort = cohort_of("images:\n  files: $IMAGES/*.png\n")
    assert [one.path.name for one in find_images(cohort.images)] == ["a.png"]


def test_settings_come_from_the_preset_the_cohort_and_the_pair(cohort_of):
    cohort = cohort_of(f"preset: fast\nsettings: {{similarity.window: 7, similarity: {{mi: 1}}}}\n{_LIST}")
    assert cohort.resolve() == load_settings("fast", overrides={"similarity.window": 7, "similarity": {"mi": 1}})
    resolved = cohort.resolve({"similarity": {"ngf": 2}})
    assert (resolved.similarity.window, resolved.similarity.measure) == (7, {"ngf": 2})


def test_resolved_file_says_the_same(cohort_of, tmp_path, monkeypatch):
    monkeypatch.setenv("IMAGES", "/da$ta/{x}")
    cohort = cohort_of(
        f"preset: smooth\nmemory: 4GB\nsettings: {{optimiser: {{steps: [3]}}}}\nimages: {{files: $IMAGES/*}}\n{_LIST}"
    )
    again = tmp_path / "elsewhere" / "again.yaml"
    again.parent.mkdir()
    again.write_text(cohort.to_yaml(), encoding="utf-8")
    second = read_cohort(again)
    assert second.resolve() == cohort.resolve()
    assert second.model_dump(exclude={"settings"}) == cohort.model_dump(exclude={"settings"})
    assert second.to_yaml() == cohort.to_yaml()


@pytest.mark.parametrize(
    ("text", "line", "sentence"),
    [
        ("otu: x\n", 2, "there is no key 'otu'; did you mean 'out'?"),
        (_PATTERN.replace("pairing", "pairng"), 5, "there is no key 'pairs.pattern.pairng'; did you mean 'pairing'?"),
        (_LIST + "      fixd: x\n", 6, r"there is no key 'pairs.list\[0\].fixd'; did you mean 'fixed'?"),
        (_PATTERN.replace("all", "al"), 5, "pairs.pattern.pairing: 'al'.*did you mean 'all'?"),
        (
            "settings:\n  symmetric: true\n  similarty: mi\n",
            4,
            "settings: there is no setting 'similarty'; did you mean",
        ),
        ("settings:\n  similarity.window: 4\n", 3, "settings: similarity.window must be an odd number"),
        (
            _LIST + "      settings:\n        similarity.window: x\n",
            7,
            r"pairs.list\[0\].settings: similarity.window = 'x'",
        ),
        ("preset: fst\n", 2, "preset must be one of .*; did you mean 'fast'?"),
        ("memory: 4 apples\n", 2, "memory: a size of memory is a number with a unit"),
        ("memory: 0\n", 2, "memory: 0"),
        ("device: gpu\n", 2, "device: 'gpu'"),
        (_LIST.replace("b.png", "$NOWHERE_SET/b.png"), 5, "environment variable NOWHERE_SET is not set"),
        (_LIST.replace("b.png", "b$.png"), 5, r"write \$\$ for a dollar sign"),
        (_LIST.replace("b.png", "5"), 5, "a path is a text, got 5"),
        (_LIST + "      name: ../x\n", 6, "a name has letters, digits"),
        (_LIST + "      name: Con.a\n", 6, "is no device of Windows"),
        (_LIST + "      name: a.\n", 6, "a name has letters, digits"),
        (_LIST + "      name: .x\n", 6, "a name has letters, digits"),
        (_LIST + "      name: 01\n", 6, "write it in quotes"),
        ("pairs:\n  list:\n    - {fixed: a.png}\n", 4, r"pairs.list\[0\]: 'moving' is missing"),
        ("pairs: {}\n", 2, "pairs come from one of list, table, pattern and learn2reg, got none"),
        (_LIST + "  table: {file: t.csv}\n", 2, "got list, table"),
        ("pairs: []\n", 2, r"pairs: \[\] is no mapping; write .* below it: list, table, pattern, learn2reg"),
        ("pairs: {table: t.csv}\n", 2, "pairs.table: 't.csv' is no mapping; write .* below it: file"),
        ("pairs: {list: {fixed: a}}\n", 2, "pairs.list: .* is no list; begin each of its entries with a dash"),
        (_PATTERN + "    within: [subjct]\n", 3, "within: there is no part 'subjct'; did you mean 'subject'?"),
        (_PATTERN + "    labels: '{x}.png'\n", 3, "labels: there is no part 'x'; the parts are subject"),
        (_PATTERN + "    parts: {subject: '('}\n", 6, "is no regular expression"),
        (_PATTERN + "    parts: {subjec: x}\n", 3, "parts: there is no part 'subjec'"),
        (_PATTERN + "    fixed: t.png\n", 3, "fixed is for pairing: template only, not for all"),
        (_PATTERN.replace("all", "template"), 3, "pairing: template needs fixed"),
        (_PATTERN.replace("all", "group"), 3, "pairing: group needs reference"),
        (_PATTERN.replace("all", "template") + "    fixed: t.png\n    labels: l.png\n", 3, "give both or neither"),
        (_PATTERN.replace("{subject}", "{sub ject}"), 4, "a part is written {name}"),
        (_PATTERN + "    expression: x\n", 3, "give either files"),
        ("images:\n  expression: x\n", 2, "expression needs folder"),
        ("images:\n  expression: '('\n  folder: .\n", 3, "is no regular expression"),
        ("engine: {kind: dusk}\n", 2, "engine.kind: 'dusk'"),
        ("engine:\n  worker: 3\n", 3, "there is no key 'engine.worker'; did you mean 'workers'?"),
    ],
)
def test_wrong_files_are_explained(cohort_of, tmp_path, text, line, sentence):
    with pytest.raises(InputError, match=rf"cohort.yaml line {line}: .*{sentence.rstrip('?')}"):
        cohort_of(text)


def test_out_is_needed(tmp_path):
    (tmp_path / "empty.yaml").write_text("# nothing\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"empty.yaml line 1: 'out' is missing"):
        read_cohort(tmp_path / "empty.yaml")


def test_files_that_are_no_cohort(tmp_path):
    with pytest.raises(InputError, match=r"no\.yaml does not exist"):
        read_cohort(tmp_path / "no.yaml")
    (tmp_path / "list.yaml").write_text("- a\n", encoding="utf-8")
    with pytest.raises(InputError, match="must hold 'key: value' lines"):
        read_cohort(tmp_path / "list.yaml")


@pytest.mark.parametrize("tag", ["!!python/object/apply:os.system [ls]", "!!python/name:os.system", "!include x"])
def test_yaml_runs_nothing(cohort_of, tag):
    with pytest.raises(InputError, match="no valid YAML"):
        cohort_of(f"preset: {tag}\n")


def test_aliases_without_end_are_refused(cohort_of):
    levels = ["a: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    levels += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 9)]
    with pytest.raises(InputError, match="line 7: there are more than 1000000 entries, aliases written out"):
        cohort_of("\n".join(levels))
    with pytest.raises(InputError, match=r"line 2: \*p stands inside of itself"):
        cohort_of("pairs: &p {list: [*p]}\n")


def test_schema_knows_every_key_and_the_settings(tmp_path):
    schema = cohort_schema()
    assert set(schema["properties"]) == set(Cohort.model_fields)
    assert schema["required"] == ["out"]
    assert schema["additionalProperties"] is False
    assert "similarity" in schema["properties"]["settings"]["properties"]
    for definition in (schema, *schema["$defs"].values()):
        for name, field in definition.get("properties", {}).items():
            assert "description" in field or "$ref" in field or definition is not schema, name
    assert torchdeform(["schema", "--out", str(tmp_path / "new" / "schema.json")]) == 0
    assert json.loads((tmp_path / "new" / "schema.json").read_text(encoding="utf-8")) == schema


@pytest.mark.parametrize("path", sorted(configs_folder().glob("cohort_*.yaml")), ids=lambda path: path.stem)
def test_shipped_cohorts_are_read(path, monkeypatch):
    monkeypatch.setenv("TORCHDEFORM_DATA", "/data")
    assert read_cohort(path).resolve()

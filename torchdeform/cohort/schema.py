"""The cohort file: its keys, strictly typed, and how it is read."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    Field,
    PrivateAttr,
    TypeAdapter,
    ValidationError,
    WithJsonSchema,
    model_validator,
)
from pydantic_core import ErrorDetails

from torchdeform.cohort.patterns import compiled, part_names, require_parts
from torchdeform.cohort.settings import (
    EngineSettings,
    Pattern,
    Place,
    Size,
    Strict,
    TemplateSettings,
    absolute_path,
    expand,
)
from torchdeform.errors import InputError, nearest_name, require_choice, shown
from torchdeform.io.texts import Lines, to_yaml
from torchdeform.pipeline.config import load_settings, merged_settings, preset_names, read_yaml, read_yaml_lines
from torchdeform.registration.annotations import PAIRED
from torchdeform.registration.settings import SHORT_FORMS, RegistrationSettings

# Companions of an image by their keys here, with their names in a pair.
COMPANIONS = {"labels": "labels", "masks": "mask", "points": "points", "features": "features"}

# What is known of the fixed image of a pair alone, by its key here and in a pair.
TISSUE = "tissue"

# Keys that belong to one pairing only.
_BELONGS = {
    **dict.fromkeys(("fixed", *(f"fixed_{name}" for name in COMPANIONS.values())), "template"),
    "reference": "group",
    "both_ways": "all",
}
_NAME = re.compile(r"(?!(?i:con|prn|aux|nul|com\d|lpt\d)(\.|$))[A-Za-z0-9]([A-Za-z0-9._-]{0,198}[A-Za-z0-9_-])?")


def checked_name(name: str) -> str:
    """Return a name that a folder can have on any system; `InputError` if it is none."""
    if not _NAME.fullmatch(name):
        allowed = "letters, digits, '.', '_' and '-' only and is no device of Windows; it starts with a letter or digit"
        raise InputError(f"a name has {allowed} and does not end in '.': {shown(name)}")
    return name


def _checked_preset(name: str) -> str:
    require_choice(name, preset_names(), "preset")
    return name


def _several(value: object) -> object:
    return (value,) if isinstance(value, str) else value


def _checked_parts(parts: dict[str, str]) -> dict[str, str]:
    for name, expression in parts.items():
        _checked_expression(expression, name)
    return parts


def _checked_expression(expression: str, name: str = "expression") -> str:
    try:
        compiled(expression, expression)
    except InputError as error:
        raise InputError(f"{name}: {error}") from error
    return expression


def _settings_schema() -> dict[str, Any]:
    """Return the JSON Schema of settings with each group in its place, or the one value that stands for it."""
    schema = TypeAdapter(RegistrationSettings).json_schema()
    groups = schema.pop("$defs")
    for name, field in schema["properties"].items():
        if "$ref" in field:
            group = groups[field.pop("$ref").rpartition("/")[2]]
            short = [group["properties"][SHORT_FORMS[name]]] if name in SHORT_FORMS else []
            field["anyOf"] = [group, *short]
    return schema


Overrides = Annotated[dict[str, Any], WithJsonSchema(_settings_schema())]
Patterns = Annotated[
    tuple[Pattern, ...],
    BeforeValidator(_several),
    WithJsonSchema({"anyOf": [{"type": "string"}, {"type": "array", "items": {"type": "string"}, "minItems": 1}]}),
]
Name = Annotated[str, AfterValidator(checked_name)]
Preset = Annotated[str, AfterValidator(_checked_preset)]
Parts = Annotated[dict[str, str], AfterValidator(_checked_parts)]
Expression = Annotated[str, AfterValidator(_checked_expression)]


class Pair(Strict):
    """One pair of a list."""

    fixed: Place
    """Image that stays."""
    moving: Place
    """Image that is warped onto it."""
    name: Name | None = None
    """Of the pair; by default from-MOVING_to-FIXED."""
    fixed_mask: Place | None = None
    """Where the fixed image counts (not 0)."""
    moving_mask: Place | None = None
    """Where the moving image counts (not 0)."""
    fixed_points: Place | None = None
    """Landmarks of the fixed image."""
    moving_points: Place | None = None
    """The same landmarks in the moving image."""
    fixed_labels: Place | None = None
    """Regions of the fixed image."""
    moving_labels: Place | None = None
    """The same regions of the moving image."""
    fixed_features: Place | None = None
    """Channels of the fixed image that are compared."""
    moving_features: Place | None = None
    """The same channels of the moving image."""
    tissue: Place | None = None
    """Labels of tissue in the fixed image, for the settings tissues and sliding."""
    settings: Overrides = Field(default_factory=dict)
    """Settings of this pair that differ from the cohort's."""


class Table(Strict):
    """Pairs in a table, one per row."""

    file: Place
    """CSV or TSV; its columns are the keys of a pair, and settings.KEY for settings that differ. Cells may be empty."""


class Images(Strict):
    """Images that patterns or a regular expression find, with named parts of their paths."""

    files: Patterns = ()
    """A pattern of paths, or several: *, ?, [abc], ** for any folders, {part} for a named part."""
    expression: Expression | None = None
    """Regular expression with named groups (?P<part>...), instead of files, for the whole path below the folder."""
    folder: Place | None = None
    """Folder to search with the expression."""
    parts: Parts = Field(default_factory=dict)
    """Regular expressions that parts must match, by name; by default anything but /."""
    labels: Pattern | None = None
    """Pattern of an image's labels, with {part} for the parts of the image's own path."""
    masks: Pattern | None = None
    """Pattern of an image's mask."""
    points: Pattern | None = None
    """Pattern of an image's landmarks."""
    features: Pattern | None = None
    """Pattern of an image's channels that are compared; a template uses none."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if bool(self.files) == (self.expression is not None):
            raise InputError("give either files (patterns) or expression (a regular expression)")
        if (self.expression is None) != (self.folder is None):
            raise InputError("expression needs folder, and folder is for expression only; give both or neither")
        require_parts(tuple(self.parts), self.part_names(), "parts")
        for name, pattern in self.companions().items():
            require_parts(part_names(pattern), self.part_names(), name)
        return self

    def part_names(self) -> tuple[str, ...]:
        """Return the names of the parts that every image has."""
        if self.expression is not None:
            return tuple(compiled(self.expression, self.expression).groupindex)
        first, *others = (part_names(pattern) for pattern in self.files)
        return tuple(name for name in first if all(name in names for names in others))

    def companions(self) -> dict[str, str]:
        """Return the patterns of an image's companions, by their keys here."""
        return {key: value for key in COMPANIONS if (value := getattr(self, key)) is not None}


class PatternPairs(Images):
    """Pairs among the images that patterns find."""

    pairing: Literal["template", "consecutive", "all", "group"]
    """template: each image to one fixed image. consecutive: each to the one before. all: every two. group: each to one
    member of its group."""
    within: tuple[str, ...] = ()
    """Parts that the images of a group share; without them all images are one group."""
    order: str | None = None
    """Part by which the images of a group are sorted; by default their paths."""
    fixed: Pattern | None = None
    """template: the fixed image; {part} is the part of the moving image."""
    fixed_labels: Pattern | None = None
    """template: its labels."""
    fixed_mask: Pattern | None = None
    """template: its mask."""
    fixed_points: Pattern | None = None
    """template: its landmarks."""
    fixed_features: Pattern | None = None
    """template: its channels that are compared."""
    tissue: Pattern | None = None
    """Labels of tissue in the fixed image of each pair, for the settings tissues and sliding. {part} is the part of the
    fixed image; template: of the moving image."""
    reference: dict[str, str] = Field(default_factory=dict)
    """group: parts of the fixed member, such as {session: pre}."""
    both_ways: bool = False
    """all: register every two in both directions, instead of only with the earlier one as fixed."""

    @model_validator(mode="after")
    def _complete(self) -> Self:
        known = self.part_names()
        require_parts(self.within, known, "within")
        require_parts((self.order,) if self.order else (), known, "order")
        require_parts(tuple(self.reference), known, "reference")
        for name, pattern in self.fixed_files().items():
            require_parts(part_names(pattern), known, name)
        for key, pairing in _BELONGS.items():
            if getattr(self, key) and self.pairing != pairing:
                raise InputError(f"{key} is for pairing: {pairing} only, not for {self.pairing}; remove it")
        for key in {"template": ("fixed",), "group": ("reference",)}.get(self.pairing, ()):
            if not getattr(self, key):
                raise InputError(f"pairing: {self.pairing} needs {key}")
        for one, other in ((name, f"fixed_{name}") for name in PAIRED):
            if self.pairing == "template" and (getattr(self, one) is None) != (getattr(self, other) is None):
                raise InputError(f"{one} and {other} are compared with each other; give both or neither")
        return self

    def fixed_files(self) -> dict[str, str]:
        """Return the patterns of a fixed image's own files, by their keys here: of a template's, and of its tissue."""
        keys = ("fixed", *(f"fixed_{name}" for name in COMPANIONS.values()), TISSUE)
        return {key: value for key in keys if (value := getattr(self, key)) is not None}


class Learn2Reg(Strict):
    """Pairs of a Learn2Reg data set."""

    file: Place
    """Its JSON, NAME_dataset.json."""
    split: Literal["train", "val", "test"] = "val"
    """Which of its pairs."""


class Pairs(Strict):
    """The pairs, given in one of four ways."""

    list: tuple[Pair, ...] | None = None
    """One by one."""
    table: Table | None = None
    """From a CSV or TSV file."""
    pattern: PatternPairs | None = None
    """From the paths of files."""
    learn2reg: Learn2Reg | None = None
    """From a Learn2Reg data set."""

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        given = [name for name in type(self).model_fields if getattr(self, name) is not None]
        if len(given) != 1:
            found = ", ".join(given) or "none"
            raise InputError(f"pairs come from one of list, table, pattern and learn2reg, got {found}")
        return self


class Cohort(Strict):
    """The content of a cohort file, with absolute paths."""

    out: Place
    """Folder of the results."""
    pairs: Pairs | None = None
    """What is registered."""
    images: Images | None = None
    """What a template is made from."""
    preset: Preset = "default"
    """Settings to start from."""
    settings: Overrides = Field(default_factory=dict)
    """Settings that differ from the preset."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where a pair is registered."""
    memory: Size | None = None
    """Limit of memory of a pair, such as 4GB; a pair that needs more is registered on a coarser grid."""
    report: Literal["none", "light", "full"] = "light"
    """Pictures of a pair: full is a page with stacks of slices, light has the middle slices only."""
    engine: EngineSettings = Field(default_factory=EngineSettings)
    """Where the pairs run."""
    layout: Literal["derivatives", "learn2reg"] = "derivatives"
    """derivatives: a folder of results per pair. learn2reg: in addition a submission to the challenge."""
    template: TemplateSettings = Field(default_factory=TemplateSettings)
    """How a template is made."""

    _path: Path = PrivateAttr(default=Path("cohort.yaml"))

    @property
    def path(self) -> Path:
        """The file that it was read from."""
        return self._path

    def resolve(self, overrides: Mapping[str, object] | None = None) -> RegistrationSettings:
        """Return the settings of a pair: the preset, changed by the cohort's settings, changed by ``overrides``."""
        settings = load_settings(self.preset, overrides=merged_settings(self.settings, overrides or {}))
        return settings.with_programs(lambda name: absolute_path(self.path.parent.resolve(), expand(name)))

    def to_yaml(self) -> str:
        """Return the cohort as a complete file: absolute paths, variables filled in, all settings."""
        content = self.model_dump(mode="json", exclude_none=True)
        return to_yaml(content | {"settings": asdict(self.resolve())})


def read_cohort(path: Path) -> Cohort:
    """Return the content of a cohort file.

    Raises:
        InputError: the file cannot be read, or the first thing that is wrong in it, with its line and keys.
    """
    content, lines = read_yaml(path), read_yaml_lines(path)
    try:
        cohort = Cohort.model_validate(content, context={"folder": path.parent.resolve()})
    except ValidationError as error:
        raise InputError(_explain(error, path, lines)) from None
    cohort._path = path
    for keys, overrides in _overrides(cohort):
        _require_settings(cohort, keys, overrides, lines)
    return cohort


def cohort_schema() -> dict[str, Any]:
    """Return the JSON Schema of a cohort file, with which editors complete and check it."""
    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema", **Cohort.model_json_schema()}
    return schema | {"title": "torchdeform cohort"}


def _overrides(cohort: Cohort) -> Iterator[tuple[tuple[str | int, ...], dict[str, Any]]]:
    """Yield all settings in a file, with the keys that lead to them."""
    yield ("settings",), cohort.settings
    for position, pair in enumerate((cohort.pairs.list if cohort.pairs else None) or ()):
        if pair.settings:
            yield ("pairs", "list", position, "settings"), pair.settings


def _require_settings(cohort: Cohort, keys: tuple[str | int, ...], overrides: dict[str, Any], lines: Lines) -> None:
    try:
        cohort.resolve(overrides)
    except InputError as error:
        words = re.findall(r"[\w.]+", str(error))
        key = next((key for key in overrides if key in words), None)
        line = lines.get((*keys, key) if key else keys, 1)
        text = str(error).removeprefix("settings: ")
        raise InputError(f"{cohort.path} line {line}: {_dotted(keys)}: {text}") from error


def _explain(error: ValidationError, path: Path, lines: Lines) -> str:
    """Return the sentence about the first error. An unknown key comes first: it is often a misspelt missing one."""
    errors = error.errors(include_url=False)
    first = next((one for one in errors if one["type"] == "extra_forbidden"), errors[0])
    keys: tuple[str | int, ...] = ()
    for key in first["loc"]:
        keys = (*keys, key) if (*keys, key) in lines else keys
    return f"{path} line {lines.get(keys, 1)}: {_sentence(first, keys)}"


def _sentence(error: ErrorDetails, keys: tuple[str | int, ...]) -> str:
    kind, last = error["type"], str(error["loc"][-1]) if error["loc"] else ""
    where = f"{_dotted(keys)}: " if keys else ""
    if kind == "extra_forbidden":
        known = _known_keys(error["loc"][:-1])
        hint = nearest_name(last, known) or f"; known are {', '.join(known)}"
        return f"there is no key '{_dotted(keys)}'{hint}"
    if kind == "missing":
        return f"{where}'{last}' is missing"
    if kind == "model_type":
        known = ", ".join(_known_keys(error["loc"]))
        return f"{where}{shown(error['input'])} is no mapping; write one or several of its keys below it: {known}"
    if kind == "tuple_type":
        return f"{where}{shown(error['input'])} is no list; begin each of its entries with a dash"
    message = error["msg"].removeprefix("Value error, ")
    if kind == "value_error":
        return f"{where}{message}"
    hint = nearest_name(str(error["input"]), re.findall(r"'(\w+)'", error.get("ctx", {}).get("expected", "")))
    if kind == "string_type" and isinstance(error["input"], int | float):
        hint = "; write it in quotes"
    return f"{where}{shown(error['input'])}: {message}{hint}"


def _dotted(keys: tuple[str | int, ...]) -> str:
    """Return ``pairs.list[0].fixed``."""
    return "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in keys).lstrip(".")


def _known_keys(keys: tuple[str | int, ...]) -> list[str]:
    """Return the keys that are allowed at this place; positions and names of union members are skipped."""
    models: list[type[BaseModel]] = [Cohort]
    for key in keys:
        inside = [m for model in models if key in model.model_fields for m in _models(model.model_fields[str(key)])]
        models = inside or models
    return list(dict.fromkeys(name for model in models for name in model.model_fields))


def _models(field: Any) -> list[type[BaseModel]]:
    """Return the models in a field's type."""
    kind = getattr(field, "annotation", field)
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return [kind]
    return [model for part in get_args(kind) for model in _models(part)]

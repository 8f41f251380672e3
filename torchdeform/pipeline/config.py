"""Settings from presets, YAML files and ``key=value`` overrides: typed, and no key unknown."""

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from pathlib import Path
from types import MappingProxyType
from typing import Any, get_type_hints

from torchdeform.errors import InputError, nearest_name, require_choice, shown
from torchdeform.io.gate import read_text
from torchdeform.io.texts import Lines, parse_yaml, yaml_lines
from torchdeform.metrics.similarity import MEASURES
from torchdeform.registration.settings import SHORT_FORMS, TISSUES, RegistrationSettings

_PRESETS = "presets"
_TISSUES = "tissues"
_LABEL = re.compile(r"[0-9]{1,18}")
_TYPE = re.compile(r"\[.+,|^(str|int|float|tuple)$|\[.+\]$")  # in the place of an error, names of a type in a choice
_DEEPEST = 5  # groups of settings inside one another


def load_settings(
    preset: str = "default",
    file: str | os.PathLike[str] | None = None,
    overrides: Mapping[str, object] | None = None,
) -> RegistrationSettings:
    """Return the settings of a preset, changed by a YAML file, changed by overrides.

    Args:
        preset: one of `preset_names`.
        file: YAML file with some of the settings of `RegistrationSettings`.
        overrides: values by name; ``"a.b"`` names setting ``b`` of group ``a``, and a group that has a short form
            may be given by it: ``{"solver": "cg"}`` is ``{"solver.method": "cg"}``.

    Returns:
        The settings, typed and checked.

    Raises:
        InputError: unknown preset or key (the nearest name is given), a file that is missing or no YAML, or a
            value out of range; the message says where it stands.
    """
    require_choice(preset, preset_names(), "preset")
    layers = [(f"preset {preset}", read_yaml(configs_folder() / _PRESETS / f"{preset}.yaml"))]
    if file is not None:
        layers.append((str(file), read_yaml(Path(file))))
    layers.append(("settings", dict(overrides or {})))
    merged: dict[str, Any] = {}
    sources: dict[str, str] = {}
    for where, layer in layers:
        values = nested(layer, where)
        _require_known(RegistrationSettings, values, where)
        _merge(merged, values)
        sources |= dict.fromkeys(_leaves(values), where)
    return _validate(merged, sources)


def preset_names() -> list[str]:
    """Return the names of the presets that come with the package."""
    return sorted(path.stem for path in (configs_folder() / _PRESETS).glob("*.yaml"))


def configs_folder() -> Path:
    """Return the folder of the YAML files: inside an installed package, or beside it in a checkout."""
    package = Path(__file__).parents[1]
    installed = package / "configs"
    return installed if installed.is_dir() else package.parent / "configs"


def read_yaml(path: Path) -> dict[str, Any]:
    """Return the mapping in a YAML file, empty if there is nothing in it.

    Raises:
        InputError: the file is missing or no text, what `parse_yaml` refuses, or no mapping.
    """
    content = parse_yaml(read_text(path, "YAML file"), str(path))
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise InputError(f"{path} must hold 'key: value' lines, one setting each")
    return content


def parse_override(text: str) -> tuple[str, object]:
    """Return key and value of ``key=value``, the value read as YAML (``3``, ``1e-6``, ``[40, 20]``, ``ssd``).

    Raises:
        InputError: no ``=``, or a value that is no YAML.
    """
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise InputError(f"--set needs key=value, got {shown(text)}")
    try:
        return key.strip(), parse_yaml(value, f"--set {shown(key.strip())[1:-1]}: {shown(value)}")
    except InputError as error:
        raise InputError(f"{error}; lists are written [40, 20]") from error


def read_yaml_lines(path: Path) -> Lines:
    """Return the lines of a YAML file that `read_yaml` has read, see `yaml_lines`."""
    return yaml_lines(read_text(path, "YAML file"), str(path))


def nested(values: Mapping[str, Any], where: str = "settings") -> dict[str, Any]:
    """Return settings by group: ``{"a.b": 1}`` as ``{"a": {"b": 1}}``, and ``solver: cg`` as ``{method: cg}``.

    Args:
        values: settings by name.
        where: what they are from, for messages.
    """
    tree: dict[str, Any] = {}
    for key, value in values.items():
        if not isinstance(key, str):
            raise InputError(f"{where}: the name of a setting is a text, got {shown(key)}")
        *parents, name = key.split(".", _DEEPEST)
        node = {name: _given_value([*parents, name], value)}
        for parent in reversed(parents):
            node = {parent: node}
        _merge(tree, {_TISSUES: _by_label(node[_TISSUES], where)} if _TISSUES in node else node)
    return tree


def merged_settings(*layers: Mapping[str, Any]) -> dict[str, Any]:
    """Return several mappings of settings as one, the later ones laid over the earlier."""
    tree: dict[str, Any] = {}
    for layer in layers:
        _merge(tree, nested(layer))
    return tree


def _given_value(keys: Sequence[str], value: object) -> object:
    """Return the value of a setting as it is laid over others: a whole group for its short form, prices as one."""
    if keys == [_TISSUES] and isinstance(value, Mapping):
        return {label: _frozen(kind) for label, kind in value.items()}
    if keys[0] == _TISSUES:
        return _frozen(value) if len(keys) == 2 else value
    if keys == ["features"]:  # names of files have dots, and a mapping takes the place of another
        return _frozen(value)
    if keys == ["sliding"] and isinstance(value, int | str) and not isinstance(value, bool):
        return [value]
    return _whole_group(keys[0], value) if len(keys) == 1 else value


def _frozen(value: object) -> object:
    """Return a mapping that `_merge` puts in the place of another, instead of laying it over that."""
    return MappingProxyType(dict(value)) if isinstance(value, Mapping) else value


def _by_label(tissues: object, where: str) -> dict[int, object]:
    """Return kinds or prices of tissue by their labels as numbers, which are texts in YAML and after a dot."""
    if not isinstance(tissues, Mapping):
        raise InputError(f"{where}: tissues gives each label its kind, such as {{1: rigid}}, got {shown(tissues)}")
    for key, kind in tissues.items():
        if isinstance(key, bool) or not _LABEL.fullmatch(str(key)):
            raise InputError(f"{where}: tissues: {shown(key)} is no label, which is a whole number from 1")
        if not isinstance(kind, str | Mapping):
            names = ", ".join(TISSUES)
            raise InputError(f"{where}: tissues: label {key} is one of {names}, or prices, got {shown(kind)}")
    return {int(key): kind for key, kind in tissues.items()}


def _whole_group(name: str, value: object) -> object:
    """Return the mapping that the short form of a group stands for; weights of measures are one, too."""
    if name not in SHORT_FORMS:
        return value
    if not isinstance(value, Mapping):
        return {SHORT_FORMS[name]: value}
    known = {field.name for field in fields(get_type_hints(RegistrationSettings)[name])}
    weights = name == "similarity" and not known & value.keys() and (not value or MEASURES.keys() & value.keys())
    return {SHORT_FORMS[name]: _frozen(value)} if weights else value


def _merge(base: dict[str, Any], change: Mapping[str, Any]) -> None:
    """Lay ``change`` over ``base``, mapping by mapping; weights and prices given as a whole replace others."""
    for key, value in change.items():
        if isinstance(value, dict) and isinstance(base.get(key), Mapping):
            base[key] = dict(base[key])
            _merge(base[key], value)
        else:
            base[key] = dict(value) if isinstance(value, dict) else value


def _leaves(values: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Yield the dotted names of settings."""
    for key, value in values.items():
        yield f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{key}.")


def setting_names(kind: Any = RegistrationSettings, prefix: str = "") -> list[str]:
    """Return the dotted names of all settings, groups left out."""
    names = []
    for name, hint in ((field.name, get_type_hints(kind)[field.name]) for field in fields(kind)):
        names += setting_names(hint, f"{prefix}{name}.") if is_dataclass(hint) else [f"{prefix}{name}"]
    return names


def _require_known(kind: Any, values: Mapping[str, Any], where: str, prefix: str = "") -> None:
    """Raise `InputError` for the first key that is no field of the dataclass ``kind``, or of one inside it."""
    hints = get_type_hints(kind)
    known = [field.name for field in fields(kind)]
    for key, value in values.items():
        if key not in known:
            name = shown(f"{prefix}{key}")
            raise InputError(f"{where}: there is no setting {name}{_suggestion(str(key), known, prefix)}")
        if not is_dataclass(hints[key]):
            continue
        if not isinstance(value, dict):
            inside = ", ".join(field.name for field in fields(hints[key]))
            raise InputError(f"{where}: {prefix}{key} is a group of settings ({inside}), got {shown(value)}")
        _require_known(hints[key], value, where, f"{prefix}{key}.")


def _suggestion(key: str, known: Sequence[str], prefix: str) -> str:
    """Return what may have been meant: the same name in another group, else the nearest name here or anywhere."""
    by_last = {name.rpartition(".")[2]: name for name in setting_names()}  # of several, the later group
    if key in by_last:
        return f"; did you mean '{by_last[key]}'?"
    near = nearest_name(key, known)
    if near:
        return near.replace("mean '", f"mean '{prefix}")
    other = [last for last in by_last if last.startswith(key)] or get_close_matches(key, by_last, n=1, cutoff=0.6)
    return f"; did you mean '{by_last[other[0]]}'?" if other else ""


def _validate(values: dict[str, Any], sources: Mapping[str, str]) -> RegistrationSettings:
    """Return the settings made of plain YAML values: strings that are numbers become numbers, lists tuples."""
    from pydantic import TypeAdapter, ValidationError

    try:
        return TypeAdapter(RegistrationSettings).validate_python(values)
    except ValidationError as error:
        errors = error.errors(include_url=False)
    # Of a choice of types, the one that goes farthest is meant.
    first = max((one for one in errors if one["loc"][:2] == errors[0]["loc"][:2]), key=lambda one: len(one["loc"]))
    problem = first["msg"].removeprefix("Value error, ").replace("a valid tuple", "a list, such as [40, 20]")
    if not first["loc"]:
        named = re.match(r"\w*", problem)
        raise InputError(f"{sources.get(named[0] if named else '', 'settings')}: {problem}")
    name = ".".join(str(part) for part in first["loc"] if not _TYPE.search(str(part)))
    inside = [known for known in sources if known.startswith(f"{name}.") and known.rpartition(".")[2] in problem]
    where = next((sources[known] for known in (*inside, name, name.partition(".")[0]) if known in sources), "settings")
    own = first["type"] == "value_error" and isinstance(first["input"], dict)  # of a whole group, with names in it
    given = "" if own else f"{name} = {shown(first['input'])}: "
    raise InputError(f"{where}: {given}{problem}")

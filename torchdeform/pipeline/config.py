"""Settings from presets, YAML files and ``key=value`` overrides: typed, and no key unknown."""

import os
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from pathlib import Path
from types import MappingProxyType
from typing import Any, get_type_hints

from torchdeform.errors import InputError, nearest_name, require_choice
from torchdeform.metrics.similarity import MEASURES
from torchdeform.registration.settings import SHORT_FORMS, RegistrationSettings

_PRESETS = "presets"
_MOST_ENTRIES = 300_000  # of a YAML file, those that aliases repeat counted again
_DEEPEST = 50  # mappings and lists inside one another

Lines = dict[tuple[str | int, ...], int]


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
        values = nested(layer)
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
        InputError: the file is missing, no YAML, no mapping, or gives a key twice.
    """
    import yaml

    try:
        content = _load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}; check the name of the settings file") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f" at line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "it is no text"
        raise InputError(f"{path} is no valid YAML{line}: {problem}") from error
    if content is None:
        return {}
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise InputError(f"{path} must hold 'key: value' lines, one setting each")
    return content


def parse_override(text: str) -> tuple[str, object]:
    """Return key and value of ``key=value``, the value read as YAML (``3``, ``1e-6``, ``[40, 20]``, ``ssd``).

    Raises:
        InputError: no ``=``, or a value that is no YAML.
    """
    import yaml

    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise InputError(f"--set needs key=value, got {text!r}")
    try:
        return key.strip(), yaml.safe_load(value)
    except yaml.YAMLError as error:
        raise InputError(f"--set {key.strip()}: {value!r} is no valid value; lists are written [40, 20]") from error


def read_yaml_lines(path: Path) -> Lines:
    """Return the line, from 1, of every key and list item of a YAML file, by the keys and positions that lead to it.

    Raises:
        InputError: aliases that repeat themselves, or each other, without end.

    Notes:
        For a file that `read_yaml` has read.
    """
    import yaml

    lines: Lines = {}
    whole = yaml.compose(path.read_text(encoding="utf-8"), _safe_loader())
    open_nodes: list[tuple[tuple[str | int, ...], Any]] = [((), whole)]
    while open_nodes:
        keys, node = open_nodes.pop()
        for key, child, mark in _children(node):
            if len(lines) + len(open_nodes) > _MOST_ENTRIES or len(keys) > _DEEPEST:
                raise InputError(f"{path} repeats its aliases too often; write out what they stand for")
            lines.setdefault((*keys, *key), mark.line + 1)
            open_nodes.append(((*keys, *key), child))
    return lines


def _children(node: object) -> list[tuple[tuple[str | int, ...], Any, Any]]:
    """Return key (none for what ``<<`` merges in), node and place of what stands in a YAML mapping or list."""
    import yaml

    if isinstance(node, yaml.MappingNode):
        return [(() if key.value == "<<" else (key.value,), value, key.start_mark) for key, value in node.value]
    if isinstance(node, yaml.SequenceNode):
        return [((position,), value, value.start_mark) for position, value in enumerate(node.value)]
    return []


def to_yaml(content: Mapping[str, object]) -> str:
    """Return plain values as YAML text, keys in their order."""
    import yaml

    return yaml.safe_dump(dict(content), sort_keys=False, allow_unicode=True, width=120)


def _safe_loader() -> Any:
    """Return PyYAML's safe loader, the fast one in C where there is one."""
    import yaml

    return getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def _load(text: str) -> Any:
    """Return what a YAML text holds; the slow loader has the better word, and line, for what is wrong."""
    import yaml

    try:
        return yaml.load(text, _unique_keys_loader(_safe_loader()))
    except yaml.YAMLError:
        return yaml.load(text, _unique_keys_loader(yaml.SafeLoader))


def _unique_keys_loader(base: Any) -> type:
    """Return a safe loader of PyYAML, made to refuse a key that is given twice (it would keep the last in silence)."""
    import yaml

    class Loader(base):
        def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
            keys = [self.construct_object(key, deep=deep) for key, _ in node.value]
            for position, key in enumerate(keys):
                if key in keys[:position]:
                    mark = node.value[position][0].start_mark
                    raise yaml.constructor.ConstructorError(None, None, f"{key} is given twice", mark)
            return super().construct_mapping(node, deep)

    return Loader


def nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings by group: ``{"a.b": 1}`` as ``{"a": {"b": 1}}``, and ``solver: cg`` as ``{method: cg}``."""
    tree: dict[str, Any] = {}
    for key, value in values.items():
        if not isinstance(key, str):
            raise InputError(f"settings: the name of a setting is a text, got {key!r}")
        *parents, name = key.split(".")
        node = {name: value if parents else _whole_group(name, value)}
        for parent in reversed(parents):
            node = {parent: node}
        _merge(tree, node)
    return tree


def merged_settings(*layers: Mapping[str, Any]) -> dict[str, Any]:
    """Return several mappings of settings as one, the later ones laid over the earlier."""
    tree: dict[str, Any] = {}
    for layer in layers:
        _merge(tree, nested(layer))
    return tree


def _whole_group(name: str, value: object) -> object:
    """Return the mapping that the short form of a group stands for; weights of measures are one, too."""
    if name not in SHORT_FORMS:
        return value
    if not isinstance(value, Mapping):
        return {SHORT_FORMS[name]: value}
    known = {field.name for field in fields(get_type_hints(RegistrationSettings)[name])}
    weights = name == "similarity" and not known & value.keys() and (not value or MEASURES.keys() & value.keys())
    return {SHORT_FORMS[name]: MappingProxyType(dict(value))} if weights else value


def _merge(base: dict[str, Any], change: Mapping[str, Any]) -> None:
    """Lay ``change`` over ``base``, mapping by mapping; weights of measures given as a whole replace others."""
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
            raise InputError(f"{where}: there is no setting '{prefix}{key}'{_suggestion(str(key), known, prefix)}")
        if not is_dataclass(hints[key]):
            continue
        if not isinstance(value, dict):
            inside = ", ".join(field.name for field in fields(hints[key]))
            raise InputError(f"{where}: {prefix}{key} is a group of settings ({inside}), got {value!r}")
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
        first = error.errors(include_url=False)[0]
    problem = first["msg"].removeprefix("Value error, ")
    if not first["loc"]:
        raise InputError(f"settings: {problem}")
    name = ".".join(map(str, first["loc"]))
    inside = [known for known in sources if known.startswith(f"{name}.") and known.rpartition(".")[2] in problem]
    where = next((sources[known] for known in (*inside, name, name.partition(".")[0]) if known in sources), "settings")
    own = first["type"] == "value_error" and isinstance(first["input"], dict)  # of a whole group, with names in it
    given = "" if own else f"{name} = {first['input']!r}: "
    raise InputError(f"{where}: {given}{problem}")

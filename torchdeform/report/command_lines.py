"""The commands that repeat a registration or apply it to other files."""

import json
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from torchdeform.core.interpolation import LABEL_MODE
from torchdeform.registration.settings import RegistrationSettings


def repeat_command(
    inputs: Mapping[str, str], settings: RegistrationSettings, device: str, memory: int | None = None
) -> str:
    """Return the ``register`` command that gives the same result again.

    Args:
        inputs: files and folder by the name of their option (``fixed``, ``moving``, ``out``, ``fixed_mask``, ...).
        settings: all of them; those that differ from the preset ``default`` become options.
        device: ``cpu`` or ``cuda``.
        memory: limit in bytes, if there was one.
    """
    words = ["register", inputs["fixed"], inputs["moving"]]
    for name, path in inputs.items():
        if name not in ("fixed", "moving"):
            words += [f"--{name.replace('_', '-')}", path]
    for key, value in changed(settings).items():
        words += ["--set", f"{key}={json.dumps(value)}"]
    words += ["--device", device]
    words += [] if memory is None else ["--memory", f"{memory}B"]
    return shlex.join(words)


def changed(settings: RegistrationSettings) -> dict[str, object]:
    """Return the settings that differ from the defaults, by their dotted names."""
    return dict(_differences(settings, RegistrationSettings(), ""))


def _differences(group: Any, defaults: Any, prefix: str) -> Iterator[tuple[str, object]]:
    for name in (field.name for field in fields(group)):
        value, default = getattr(group, name), getattr(defaults, name)
        if is_dataclass(value):
            yield from _differences(value, default, f"{prefix}{name}.")
        elif value != default:
            yield f"{prefix}{name}", value


def apply_commands(inputs: Mapping[str, str], out: Path) -> dict[str, str]:
    """Return commands that apply the result to other files, by a description."""
    forward, back = (str(out / name) for name in ("transform.h5", "inverse.h5"))
    onto = ("--reference", inputs["fixed"])
    verbs = {
        "another image of the moving space, onto the fixed grid": ("apply", forward, "IMAGE", *onto),
        "labels of the moving space": ("apply", forward, "LABELS", *onto, "--interpolation", LABEL_MODE),
        "points of the fixed space, to the moving space": ("points", forward, "POINTS"),
        "points of the moving space, to the fixed space": ("points", back, "POINTS"),
    }
    return {what: shlex.join(("torchdeform", *words, "--out", "FILE")) for what, words in verbs.items()}

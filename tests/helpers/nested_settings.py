"""Settings by the short names of their parts, as the tests change many of them one by one."""

from dataclasses import fields, is_dataclass, replace
from typing import Any

from torchdeform.registration.settings import SHORT_FORMS, RegistrationSettings

# Of groups that share a name, the first is meant; the others are named in full: ``flow__steps``.
GROUPS = ("similarity", "metric", "optimiser", "folds")


def settings_of(**values: Any) -> RegistrationSettings:
    """Return the defaults with some settings changed: ``settings_of(steps=(3,), align="none", flow__steps=2)``."""
    return changed(RegistrationSettings(), **values)


def changed(settings: RegistrationSettings, **values: Any) -> RegistrationSettings:
    """Return the settings with some of them changed, named as in `settings_of`."""
    for name, value in values.items():
        group, key = _place(settings, name)
        part = getattr(settings, group)
        settings = replace(settings, **{group: replace(part, **{key: value}) if key else value})
    return settings


def _place(settings: RegistrationSettings, name: str) -> tuple[str, str | None]:
    if "__" in name:
        group, _, key = name.partition("__")
        return group, key
    if hasattr(settings, name):
        return name, SHORT_FORMS.get(name)
    found = (g for g in GROUPS if is_dataclass(getattr(settings, g)) and name in _names(getattr(settings, g)))
    return next(found), name


def _names(group: Any) -> list[str]:
    return [field.name for field in fields(group)]

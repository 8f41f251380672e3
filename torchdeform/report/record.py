"""``result.json``: what was registered, how, how it went, and the commands that repeat it or apply it."""

import json
import math
import platform
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import asdict, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import torch

from torchdeform import __version__
from torchdeform.core.diagnostics import Diagnosis
from torchdeform.core.image import Image
from torchdeform.core.interpolation import LABEL_MODE
from torchdeform.metrics.evaluation import Evaluation, Measures
from torchdeform.registration.channels import described
from torchdeform.registration.result import LevelRecord, RegistrationResult
from torchdeform.registration.settings import RegistrationSettings
from torchdeform.registration.tissue import TissueOutcome


def describe(result: RegistrationResult, fixed: Image, moving: Image) -> dict[str, Any]:
    """Return the record of one registered pair as plain numbers, strings, lists and mappings.

    Args:
        result: a result of one pair (batch of 1).
        fixed: the fixed image as read.
        moving: the moving image as read.

    Returns:
        A mapping for `write_json`; sizes are in x, y, z order as in ITK, inverse errors in voxels. Spacings, origins
        and distances of labels and landmarks are in ``unit``, that of the fixed image; the moving image has its own.
    """
    return {
        "unit": fixed.unit,
        "fixed": _place(fixed),
        "moving": _place(moving),
        "similarity": result.settings.seen_by,
        "similarity_before": result.similarity_before.item(),
        "similarity_aligned": None if result.similarity_aligned is None else result.similarity_aligned.item(),
        "similarity_after": result.similarity_after.item(),
        "similarity_choice": result.choice,
        "objective_before": result.objective_before.item(),
        "objective_after": result.objective_after.item(),
        **describe_map(result.diagnosis),
        "determinant_log_std": result.diagnosis.det_log_std.item(),
        "inverse_error_mean": result.inverse_error_mean.item(),
        "inverse_error_max": result.inverse_error_max.item(),
        "seconds": result.seconds,
        "alignment": _alignment(result),
        "keypoints": [{"looked_for": points.looked_for, "matched": points.count} for points in result.keypoints],
        "evaluation": _evaluation(result.evaluation, fixed),
        "tissue": [_tissue(outcome) for outcome in result.tissue],
        "label_interpolation": result.evaluation and result.evaluation.label_interpolation,
        "verdict": asdict(result.verdict),
        "evidence": asdict(result.evidence[0]),
        "warnings": result.warnings,
        "levels": [_level(level) for level in result.levels],
        "device": device_name(result.displacement.device),
        "labels_in_cost": result.settings.labels_weight > 0,
        "settings": asdict(replace(result.settings, features=described(result.settings.features))),
        "versions": versions(),
    }


def describe_map(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the folds and the range of the determinant of one map."""
    return {
        "folds": int(diagnosis.folds.item()),
        "determinant_min": diagnosis.det_min.item(),
        "determinant_max": diagnosis.det_max.item(),
    }


def _place(image: Image) -> dict[str, object]:
    return {
        "path": image.name,
        "size": image.grid.shape[::-1],
        "unit": image.unit,
        "spacing": [image.in_unit(length) for length in image.grid.spacing[::-1]],
        "origin": [image.in_unit(length) for length in image.origin],
        "channels": image.data.shape[1],
        "pixel_type": image.pixel_type,
    }


def _alignment(result: RegistrationResult) -> dict[str, object]:
    """Return the affine map x -> M x + t of the world (x, y, z in LPS mm), and how it was found."""
    if result.affine is None:
        return {"kind": "none"}
    found = result.alignment
    return {
        "kind": result.settings.align.kind if found else "given" if result.similarity_aligned is None else "keypoints",
        "matrix": result.affine.matrix.tolist(),
        "offset": result.affine.offset.tolist(),
        "start": found and found.start,
        "similarity_before": found and found.similarity_before,
        "similarity_after": found and found.similarity_after,
    }


def _evaluation(evaluation: Evaluation | None, fixed: Image) -> dict[str, object]:
    """Return overlap and distances before, after the alignment and at the end."""
    if evaluation is None:
        return {}
    stages = {"before": evaluation.before, "aligned": evaluation.aligned, "after": evaluation.after}
    return {name: _measures(measures, fixed) for name, measures in stages.items() if measures is not None}


def _measures(measures: Measures, fixed: Image) -> dict[str, object]:
    """Return the figures of one stage; distances in the unit of the fixed image."""
    found: dict[str, object] = {}
    if measures.labels:
        names = [str(label) for label in measures.labels]
        found["dice_mean"] = measures.dice[0].nanmean().item()
        found["dice"] = dict(zip(names, measures.dice[0].tolist(), strict=True))
        found["hausdorff_95"] = dict(zip(names, fixed.in_unit(measures.hausdorff[0]).tolist(), strict=True))
    if measures.distances is not None:
        errors = fixed.in_unit(measures.distances[0])
        found["landmark_error_mean"] = errors.mean().item()
        found["landmark_error_median"] = errors.median().item()
        found["landmark_error_max"] = errors.max().item()
        found["landmark_errors"] = errors.tolist()
    return found


def _tissue(outcome: TissueOutcome) -> dict[str, object]:
    """Return how one label was kept: residuals in voxels, the others as shares."""
    fits = {stage: getattr(outcome, stage) for stage in ("before", "after")}
    return {
        "label": outcome.label,
        "kind": outcome.kind,
        "sliding": outcome.sliding,
        "nodes": int(outcome.nodes.item()),
        **{stage: {name: value.item() for name, value in vars(fit).items()} for stage, fit in fits.items()},
    }


def _level(level: LevelRecord) -> dict[str, object]:
    return {
        "size": level.shape[::-1],
        "similarity": [value.item() for value in level.similarity],
        "shortened": level.shortened,
        "seconds": level.seconds,
    }


def device_name(device: torch.device) -> str:
    """Return ``cpu`` or ``cuda``, the latter with the name of the card."""
    return f"cuda ({torch.cuda.get_device_name(device)})" if device.type == "cuda" else device.type


def versions() -> dict[str, str]:
    """Return the versions of the software that a result depends on."""
    return {"torchdeform": __version__, "torch": torch.__version__, "python": platform.python_version()}


def write_json(record: Mapping[str, object], path: Path) -> None:
    """Write a record as JSON, one figure per line."""
    path.write_text(as_json(record, indent=2) + "\n", encoding="utf-8")


def as_json(record: Mapping[str, object], indent: int | None = None) -> str:
    """Return a record as strict JSON: numbers that are not finite become null."""
    return json.dumps(_plain(record), indent=indent, allow_nan=False, default=str)


def _plain(value: object) -> object:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


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

"""Whether labels of tissue and what the settings say of them go together, before any long work."""

from collections.abc import Iterator, Sequence

from torchdeform.core.image import Image, resample
from torchdeform.pipeline.annotations import check_labels
from torchdeform.pipeline.preflight import ERROR, NOTE, WARNING, Finding
from torchdeform.registration.settings import TISSUES, RegistrationSettings

_FEW = 8  # voxels of a label that are too few to be held
_SHOWN = 12  # labels that a sentence lists


def contradiction(given: bool, settings: RegistrationSettings, option: str = "--tissue") -> str:
    """Return what is wrong with the settings where labels of tissue are ``given`` or not; empty if nothing is.

    Args:
        given: whether there is a file of labels; what is in it is looked at later.
        settings: how the pair is registered.
        option: the name of that file where it is given.
    """
    if settings.knows_tissue and not given:
        names = _listed(sorted({*settings.tissues, *settings.sliding}))
        return (
            f"tissues and sliding name labels ({names}), but there is no {option}; give the labels of the fixed image"
        )
    if settings.knows_tissue and settings.symmetric:
        return "symmetric: tissue is known of the fixed image only, so tissues and sliding do not go with it; drop one"
    return ""


def check_tissue(fixed: Image, tissue: Image, settings: RegistrationSettings | None = None) -> Iterator[Finding]:
    """Yield what looks wrong with the labels of tissue.

    Args:
        fixed: the fixed image.
        tissue: whole numbers with one channel, on the fixed image's grid or one of their own in the same place.
        settings: what the labels are; None if that is not known yet.
    """
    dim, values = fixed.grid.dim, tissue.data.unique()
    if tissue.grid.dim != dim or tissue.data.shape[1] != 1:
        kind = f"{tissue.grid.dim}D with {tissue.data.shape[1]} channels"
        yield Finding(
            ERROR, f"{tissue.name} is {kind}; labels of tissue in {fixed.name} must be {dim}D with one channel"
        )
        return
    if not bool((values.isfinite() & (values == values.round())).all()):
        yield Finding(
            ERROR, f"{tissue.name} must hold whole numbers, the labels of tissue; check that it is the right file"
        )
        return
    labels = [int(value) for value in values.tolist() if value > 0]
    if not labels:
        yield Finding(ERROR, f"{tissue.name} has no label above 0; check that it is the right file")
        return
    found = list(check_labels(fixed, tissue))
    yield from found
    if settings is None or not settings.knows_tissue:
        yield Finding(NOTE if settings is None else ERROR, _unexplained(tissue.name, labels))
    elif not any(finding.severity == ERROR for finding in found):
        yield from _check_named(fixed, tissue, labels, settings)


def _unexplained(name: str, labels: Sequence[int]) -> str:
    kinds = ", ".join(kind for kind in TISSUES if kind != "rigid")
    return (
        f"{name} has {_these(labels)}, and settings must say what they are: add --set tissues.{labels[0]}=rigid (or "
        f"{kinds}), or --set 'sliding=[{labels[0]}]'"
    )


def _check_named(
    fixed: Image, tissue: Image, labels: Sequence[int], settings: RegistrationSettings
) -> Iterator[Finding]:
    """Labels that the settings name: some voxels of the fixed image must have them."""
    nodes = None
    for setting in ("tissues", "sliding"):
        for label in sorted(getattr(settings, setting)):
            if label not in labels:
                text = f"{tissue.name} has no label {label}, which {setting} names; it has {_these(labels)}"
                yield Finding(ERROR, text)
                continue
            nodes = resample(tissue, fixed, mode="nearest") if nodes is None else nodes
            yield from _check_size(int((nodes == label).sum()), f"label {label} of {tissue.name}", fixed.name)


def _check_size(voxels: int, label: str, image: str) -> Iterator[Finding]:
    if voxels == 0:
        yield Finding(ERROR, f"{label} is at no voxel of {image}; correct the place of the labels, or draw it larger")
    elif voxels < _FEW:
        count = f"{voxels} voxel{'s' if voxels > 1 else ''}"
        yield Finding(WARNING, f"{label} has {count} of {image}, too few to keep their shape; draw it larger")


def _these(labels: Sequence[int]) -> str:
    return f"the label{'s' if len(labels) > 1 else ''} {_listed(labels)}"


def _listed(labels: Sequence[int]) -> str:
    """Return labels with commas, the first if there are many."""
    more = f" and {len(labels) - _SHOWN} more" if len(labels) > _SHOWN else ""
    return f"{', '.join(map(str, labels[:_SHOWN]))}{more}"

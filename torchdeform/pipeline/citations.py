"""Which publications the methods of a registration come from, as BibTeX."""

import re
from pathlib import Path

from torchdeform import __version__
from torchdeform.metrics.similarity import MEASURES
from torchdeform.pipeline.memory import choices
from torchdeform.registration.settings import MIND, RegistrationSettings

# What every registration uses, and what some settings add; the keys are those of references.bib.
_ALWAYS = {"torchdeform": "the software", "liu2007reconstruction": "the method", "liu2024finite": "what a fold is"}
_STARTS = {
    "identity": (),
    "discrete": ("steinbruecker2009large", "siebert2021fast", "heinrich2013towards"),
    "keypoints": ("foerstner1987fast", "heinrich2015estimating", "steinbruecker2009large", "heinrich2013towards"),
}


def citations(settings: RegistrationSettings) -> dict[str, str]:
    """Return the keys in `bibliography` of what a registration with these settings uses, each with what for.

    Args:
        settings: of the registration.

    Notes:
        Measures that are common property (``ssd``, ``ncc``) have no entry.
    """
    found, (measures, start, _) = dict(_ALWAYS), choices(settings)
    measures = measures | ({"mind": MEASURES["mind"]} if MIND in settings.sources else {})
    for name, measure in measures.items():
        found |= dict.fromkeys(measure.references, f"similarity: {name}")
    use = f"start: {start}"
    found |= {key: f"{found[key]}, {use}" if key in found else use for key in _STARTS[start]}
    return found


def bibliography() -> dict[str, str]:
    """Return all entries of ``references.bib`` as BibTeX, by key."""
    text = (Path(__file__).parent / "references.bib").read_text(encoding="utf-8").replace("VERSION", __version__)
    entries = [entry.strip() for entry in re.split(r"^(?=@)", text, flags=re.MULTILINE) if entry.strip()]
    return {entry.partition("{")[2].partition(",")[0]: entry for entry in entries}


def bibtex(settings: RegistrationSettings) -> str:
    """Return what to cite for a registration with these settings, as BibTeX with comments that say what for."""
    entries = bibliography()
    return "\n\n".join(f"% {use}\n{entries[key]}" for key, use in citations(settings).items())

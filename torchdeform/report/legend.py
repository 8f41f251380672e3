"""The legend of what is drawn over the pictures of the page, with what each line of it shows or hides."""

from collections.abc import Sequence
from dataclasses import dataclass

from torchdeform.report.drawing import Scale
from torchdeform.report.marks import (
    ABSENT,
    ABSENT_COLOUR,
    EMPTY_COLOUR,
    FIXED_COLOUR,
    LANDMARK_COLOURS,
    LANDMARKS,
    MASKS,
    MOVING_COLOUR,
    NO_DATA,
    OUTLINES,
    TISSUE,
    TISSUE_COLOUR,
    WORST,
    WORST_COLOUR,
)
from torchdeform.report.report_data import ReportData
from torchdeform.report.sampling import FIXED
from torchdeform.report.web_images import Bar, bar_of


@dataclass(frozen=True)
class Entry:
    """One line of the legend: the kind of mark, its name, swatches (colour and name), a bar, a sentence."""

    kind: str
    title: str
    swatches: Sequence[tuple[str, str]] = ()
    bar: Bar | None = None
    note: str = ""


def legend(data: ReportData) -> list[Entry]:
    """Return an entry for each kind of mark that is there."""
    drawn = {(mark.kind, mark.image) for cuts in data.slices for mark in cuts.marks}
    kinds, others = {kind for kind, _ in drawn}, {kind for kind, image in drawn if image != FIXED}
    known = data.known
    entries = [_lines(OUTLINES, "outlines of labels" if OUTLINES in others else "edges of the fixed image", others)]
    if known.landmarks is not None:
        about = "from a fixed landmark to where that of the moving image ends up"
        ticks = ((0.0, "0"), (known.limit, f"≥ {known.limit:.3g} {known.landmarks.unit}"))
        bar = bar_of(Scale(LANDMARK_COLOURS, 0.0, known.limit, ticks))
        entries.append(Entry(LANDMARKS, "landmarks", bar=bar, note=about))
    entries += [
        _lines(MASKS, "masks", others),
        Entry(TISSUE, "tissue", [(TISSUE_COLOUR, "")], note="labels that the settings tissues and sliding name"),
        Entry(NO_DATA, "no data", [(EMPTY_COLOUR, "")], note="beyond the moving image"),
        Entry(ABSENT, "in the fixed image only", [(ABSENT_COLOUR, "")], note=_ABOUT_ABSENT),
        Entry(WORST, "worst place", [(WORST_COLOUR, "")], note=known.worst.reason),
    ]
    return [entry for entry in entries if entry.kind in kinds]


_ABOUT_ABSENT = "nothing in the moving image corresponds; the map is carried through smoothly"


def _lines(kind: str, title: str, others: set[str]) -> Entry:
    both = [(FIXED_COLOUR, "fixed"), (MOVING_COLOUR, "other")]
    return Entry(kind, title, both if kind in others else [(FIXED_COLOUR, "")])

"""A figure of panels in rows and columns whose places are given in inches, so that no text meets another."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from torchdeform.report.drawing import INK, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

GAP = 0.1  # between panels
TITLE = 0.3  # room for the title of a row of panels
LINE = 0.24  # and for a line of the headline
_LETTER = 0.092  # width of a letter of the headline, on average


class Sheet:
    """The figure.

    Args:
        width: of each panel.
        columns: their number.
        heights: of the rows.
        room: above each row.
        headlines: lines at the top.
        bottom: room at the bottom.
    """

    def __init__(
        self,
        width: float,
        columns: int,
        heights: Sequence[float],
        room: Sequence[float],
        *,
        headlines: Sequence[str] = (),
        bottom: float = GAP,
    ) -> None:
        top = GAP + LINE * len(headlines)
        self._size = (columns * (width + GAP) + GAP, top + sum(heights) + sum(room) + bottom)
        self.figure: Figure = new_figure(*self._size)
        self.panels: list[list[Axes]] = []
        below = self._size[1] - top
        for height, above in zip(heights, room, strict=True):
            below -= above + height
            self.panels.append([self.add(GAP + k * (width + GAP), below, width, height) for k in range(columns)])
        for k, text in enumerate(headlines):
            y = 1 - (GAP + LINE * (k + 0.5)) / self._size[1]
            short = shortened(text, letters_in(width, columns))
            self.figure.text(0.5, y, short, ha="center", va="center", fontsize=11, color=INK)

    def add(self, left: float, bottom: float, width: float, height: float) -> "Axes":
        """Return new axes at this place, from the lower left corner."""
        across, down = self._size
        return self.figure.add_axes((left / across, bottom / down, width / across, height / down))

    def below(self, axes: "Axes", width: float, height: float, drop: float) -> "Axes":
        """Return new axes centred below a panel, its picture included, and so far from it."""
        place, (across, down) = axes.get_position(original=True), self._size
        middle = (place.x0 + place.x1) / 2 * across
        return self.add(middle - width / 2, place.y0 * down - drop - height, width, height)


def letters_in(width: float, columns: int) -> int:
    """Return how many letters of a headline fit above the panels."""
    return int(columns * (width + GAP) / _LETTER)


def title(axes: "Axes", text: str) -> None:
    """Write a title above a panel."""
    axes.set_title(text, fontsize=10, color=INK, pad=4)


def shortened(text: str, most: int) -> str:
    """Return a text of at most ``most`` letters, with an ellipsis in its middle if it is longer."""
    half = (most - 1) // 2
    return text if len(text) <= most else f"{text[:half]}…{text[-half:]}"

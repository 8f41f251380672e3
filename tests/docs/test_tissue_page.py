"""The page about tissue says what the settings cost."""

import re
from pathlib import Path

from torchdeform.registration.settings import TISSUES, RegistrationSettings

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "tissue.md"


def test_the_table_has_the_prices_of_each_kind():
    row = re.compile(r"^\| `(\w+)` \| [^|]+ \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \|", re.MULTILINE)
    rows = row.findall(PAGE.read_text(encoding="utf-8"))
    metric = RegistrationSettings().metric
    free = {"div": metric.weight_div, "strain": 0.0, "curl": metric.weight_curl}
    said = {kind: dict(zip(free, map(float, prices), strict=True)) for kind, *prices in rows}
    assert said == {kind: free | prices for kind, prices in TISSUES.items()}

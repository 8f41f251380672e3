"""The legend names what is drawn, and nothing else."""

from torchdeform.report import make_report_data
from torchdeform.report.legend import legend


def test_the_legend_has_what_is_there(make_full, make_image, make_result):
    entries = {entry.kind: entry for entry in legend(make_full(3)[0])}
    assert list(entries) == ["outlines", "landmarks", "masks", "tissue", "no-data", "absent", "worst"]
    assert entries["outlines"].title == "outlines of labels"
    assert [name for _, name in entries["outlines"].swatches] == ["fixed", "other"]
    bar = entries["landmarks"].bar
    assert bar is not None
    assert str(bar.ticks[1]["text"]).startswith("≥ ")
    assert str(bar.ticks[1]["text"]).endswith(" mm")
    image = make_image((40, 50))
    few = {entry.kind: entry.title for entry in legend(make_report_data(image, image, make_result(image, image)))}
    assert few["outlines"] == "edges of the fixed image"
    assert not {"landmarks", "masks", "tissue", "absent"} & set(few)

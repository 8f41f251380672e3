"""Stages are told to who listens, and to nobody else."""

from torchdeform.core.stages import begin, heard_by


def test_stages_are_heard_inside_the_block_only(capfd):
    heard: list[str] = []
    begin("reading")
    with heard_by(heard.append):
        begin("aligning")
        begin("100 % inverting")
    begin("drawing")
    assert heard == ["aligning", "100 % inverting"]
    assert capfd.readouterr() == ("", "")

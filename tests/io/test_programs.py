"""Programs in files: both kinds give what the network gives, everything else is refused in a sentence."""

import warnings

import pytest
import torch
from programs import network, save_exported, save_script

from torchdeform.errors import InputError
from torchdeform.io.programs import load_program

CPU = torch.device("cpu")


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize(("save", "name"), [(save_script, "net.ts"), (save_exported, "net.pt2")])
def test_a_saved_program_does_what_the_network_does(tmp_path, dim, save, name):
    net, image = network(dim), torch.rand(1, 1, *(20, 24, 22)[:dim])
    save(net, tmp_path / name)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # what torch says about its future is not for users
        program = load_program(tmp_path / name, CPU)
    torch.testing.assert_close(program(image), net(image))


def test_what_is_no_program_is_refused(tmp_path):
    torch.save(network(2).state_dict(), tmp_path / "weights.pt")
    (tmp_path / "text.ts").write_text("no archive", encoding="utf-8")
    save_script(network(2), tmp_path / "whole.ts")
    content = (tmp_path / "whole.ts").read_bytes()
    (tmp_path / "damaged.ts").write_bytes(content[:900].replace(b"PK", b"XX") + content[900:])
    (tmp_path / "half.ts").write_bytes(content[: len(content) // 2])
    for name, problem in (
        ("half.ts", "half.ts is damaged or incomplete"),
        ("weights.pt", "holds no program"),
        ("text.ts", "holds no program"),
        ("damaged.ts", "damaged|no program"),
        ("missing.ts", "does not exist"),
    ):
        with pytest.raises(InputError, match=problem):
            load_program(tmp_path / name, CPU)

"""Settings of a cohort: contradictions are refused, variables are filled in."""

from pathlib import Path

import pytest
from pydantic import ValidationError

from torchdeform.cohort.settings import EngineSettings, absolute_path, expand
from torchdeform.errors import InputError


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"kind": "dask"}, "either scheduler"),
        ({"kind": "dask", "scheduler": "tcp://a:1", "cluster": {"kind": "local"}}, "either scheduler"),
        ({"scheduler": "tcp://a:1"}, "scheduler is for kind: dask"),
        ({"cluster": {"kind": "local"}}, "cluster is for kind: dask"),
        ({"kind": "dask", "scheduler": "tcp://a:1", "workers": 2}, "workers is for kind: local"),
        ({"kind": "dask", "cluster": {"kind": "slurm", "workers": 4, "cores": 2}}, "need as many cores"),
        ({"kind": "dask", "cluster": {"kind": "slurm", "workers": 4, "cores": 8, "gpus": 2}}, "takes a GPU"),
        ({"workers": 0}, "greater than or equal to 1"),
        ({"timeout": 0}, "greater than 0"),
        ({"timeout": -1}, "greater than 0"),
        ({"timeout": float("inf")}, "less than or equal to"),
        ({"timeout": float("nan")}, "less than or equal to"),
        ({"timeout": 1e300}, "less than or equal to"),
        ({"workers": 2**62}, "less than or equal to 1000000"),
    ],
)
def test_settings_that_contradict_are_refused(settings, sentence):
    with pytest.raises(ValidationError, match=sentence):
        EngineSettings(**settings)


@pytest.mark.parametrize(
    ("path", "sentence"),
    [("~nosuchuser/a.nii", "'~nosuchuser/a.nii': there is no user of this name"), ("a" * 5000, "longer than a path")],
)
def test_paths_that_lead_nowhere(path, sentence):
    with pytest.raises(InputError, match=sentence):
        absolute_path(Path("/data"), path)


def test_expanding_leaves_other_text_alone(monkeypatch):
    monkeypatch.setenv("A", "b")
    assert expand("x/$A/${A}_{part}*[c]") == "x/b/b_{part}*[c]"

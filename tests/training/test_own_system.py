"""The example with a system that is not built in, in a shortened form."""

import sys

import pytest
from conftest import load_example

from sympflow import systems
from sympflow.flow.primed import PrimedFlow


@pytest.mark.slow
def test_own_system_in_a_minute(monkeypatch, capsys):
    example = load_example("own_system_in_a_minute")
    trained = []
    monkeypatch.setattr(example, "train", lambda *a, **k: trained.append(original(*a, **k)) or trained[0])
    original = sys.modules["sympflow.training.trainer"].train
    monkeypatch.setattr(sys, "argv", ["own_system_in_a_minute.py", "--quick"])
    example.main()
    out = capsys.readouterr().out
    (flow,) = trained
    assert isinstance(flow, PrimedFlow)
    assert flow.system_name == "coupled_morse" not in systems.SYSTEMS
    assert flow.certified is not None
    assert flow.figures["one_step_error"] < 1e-6
    rows = {line.split()[0]: line.split() for line in out.splitlines() if line.endswith("×")}
    assert {"the", "kahan_li8", "blanes_moan4"} == set(rows)
    assert rows["the"][-1] == "1.00×"

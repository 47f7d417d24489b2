"""Everything that sympflow asks of an integrator."""

from sympflow_ruth.ruth3 import Ruth3

from sympflow.testing.checks import parametrize_with_checks


@parametrize_with_checks([Ruth3])
def test_contract(integrator, check):
    check(integrator)

"""Everything that sympflow asks of an integrator, and the two forms against each other."""

import numpy as np
from sympflow_ruth.by_steps import Ruth3BySteps
from sympflow_ruth.schemes import RUTH3
from sympflow_ruth.systems import morse

from sympflow import max_energy_error, solve, splitting_method
from sympflow.testing.checks import parametrize_with_checks


@parametrize_with_checks([splitting_method(RUTH3), Ruth3BySteps])
def test_contract(integrator, check):
    check(integrator)


def test_the_scheme_and_the_step_are_one_method():
    compiled, stepped = (solve(morse(), method, (0, 5)) for method in (splitting_method(RUTH3), Ruth3BySteps))
    np.testing.assert_allclose(compiled.y, stepped.y, rtol=0, atol=1e-13)
    assert compiled.stats["backend"] == "compiled"
    assert compiled.nfev == stepped.nfev == 3 * 100


def test_the_energy_of_the_morse_oscillator_is_kept():
    assert max_energy_error(solve(morse(depth=2.0), "dop853", (0, 20), rtol=1e-11, atol=1e-13)) < 1e-8

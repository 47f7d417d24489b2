"""The checks themselves: every built-in method passes, and each lie that an integrator can tell is caught."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest

from sympflow import available, get
from sympflow.arrays import concatenate, per_state
from sympflow.integrators.base import FixedStep, Outcome
from sympflow.integrators.checks import CHECKS, check_integrator, checks_for, parametrize_with_checks
from sympflow.integrators.tableaux import ADAPTIVE


def built_in(name):
    def factory():
        return get(name)(**({"rtol": 1e-5, "atol": 1e-7} if name in ADAPTIVE else {}))

    return factory


@parametrize_with_checks([built_in(name) for name in available()])
@pytest.mark.filterwarnings("ignore:Functional iteration did not converge")
def test_built_in_methods(integrator, check):
    check(integrator)


@dataclass(frozen=True)
class SymplecticEuler(FixedStep):
    """p += h F(q), then q += h ∇T(p)."""

    name: ClassVar[str] = "symplectic_euler"
    order: ClassVar[int | None] = 1
    symplectic: ClassVar[bool] = True

    def step(self, system, t, y, h):
        d, h = system.ndof, per_state(h, y)
        p = y[..., d:] + h * system.force(y[..., :d])
        return concatenate([y[..., :d] + h * system.velocity(p), p])


def lying(**lie):
    return dataclass(frozen=True)(type("Liar", (SymplecticEuler,), lie))


def test_a_new_integrator_passes_without_further_work():
    names = check_integrator(SymplecticEuler)
    assert "the_order_is_the_slope" in names
    assert "the_inverse_undoes_the_step" not in names  # it has none
    assert "events_are_zeros_of_the_dense_output" in names


def forgets_the_short_step(self, problem):
    outcome = SymplecticEuler.run(self, problem)
    return Outcome(outcome.t[:-1], outcome.y[:-1], 0, outcome.message, outcome.stats, outcome.sol)


def writes_to_its_argument(self, system, t, y, h):
    if isinstance(y, np.ndarray):
        y *= 1.0000001
    return SymplecticEuler.step(self, system, t, y, h)


def hides_failure(self, problem):
    outcome = SymplecticEuler.run(self, problem)
    outcome.status = np.abs(outcome.status) * 0
    return outcome


@pytest.mark.parametrize(
    ("lie", "message"),
    [
        ({"order": 2}, r"^the_order_is_the_slope of .*declared 2, measured 1"),
        ({"symplectic": False}, r"^symplecticity_as_declared .*declare `symplectic = True`"),
        ({"name": ""}, r"^declarations .*`name` must be a string"),
        ({"order": "first"}, r"^declarations .*`order` must be a count"),
        ({"step": lambda self, system, t, y, h: y * (1 + 0.01 * per_state(h, y))}, r"Liar"),
        ({"inverse": lambda self, system, t, y, h: y}, r"^the_inverse_undoes_the_step .*does not undo"),
        ({"run": forgets_the_short_step}, r"Liar"),
        ({"run": hides_failure}, r"^a_blow_up_is_status_minus_one"),
        ({"step": writes_to_its_argument}, r"Liar"),
    ],
)
def test_lies_are_caught(lie, message):
    with pytest.raises(AssertionError, match=message):
        check_integrator(lying(**lie))


def test_every_check_applies_to_some_built_in_method():
    applied = {check.name for name in ("verlet", "dopri5") for check in checks_for(get(name)())}
    assert applied == {check.name for check in CHECKS}


def test_what_makes_no_integrator_is_refused():
    with pytest.raises(TypeError, match=r"^`factory` must make an Integrator; it made int"):
        check_integrator(lambda: 3)

"""check_integrator: the tests that every integrator, ours or a plug-in's, must pass.

Each check is a function check(integrator, system) that raises an AssertionError with the fault, or `NotApplicable` with
the reason. They judge by the mathematics: the declared order by slope, the declared symplecticity by the Jacobian of
the step that ran. They are in `laws`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import Integrator
from sympflow.integrators.registry import named
from sympflow.testing import laws
from sympflow.testing.laws import NotApplicable, default_system

Factory = Callable[[], Integrator]


@dataclass(frozen=True)
class Check:
    """A named check."""

    run: Callable[[Integrator, HamiltonianSystem], None]

    @property
    def name(self) -> str:
        return self.run.__name__

    def __call__(self, integrator: Integrator, system: HamiltonianSystem | None = None) -> None:
        """Run the check.

        Raises
        ------
        AssertionError
            If it fails, for whatever reason; the message begins with the name of the check.
        NotApplicable
            If there is nothing to check, with the reason.
        """
        system = default_system() if system is None else system
        try:
            self.run(integrator, system)
        except NotApplicable:
            raise
        except AssertionError as error:
            raise AssertionError(f"{self.name} of {integrator!r}: {error}") from error
        except Exception as error:
            what = f"it raised {type(error).__name__}: {error}"
            raise AssertionError(f"{self.name} of {integrator!r}: {what}") from error


CHECKS = tuple(map(Check, (*laws.OF_RUNS, *laws.OF_STEPS, *laws.OF_CONSISTENCY)))


@dataclass(frozen=True)
class CheckReport:
    """The result of `check_integrator`; iterating gives the names of the checks that passed.

    Attributes
    ----------
    passed : tuple of str
        The names of the checks that were run, and passed.
    skipped : dict of str to str
        Those that were not run, and why.
    """

    passed: tuple[str, ...]
    skipped: dict[str, str] = field(default_factory=dict)

    def __iter__(self) -> Iterator[str]:
        return iter(self.passed)

    def __str__(self) -> str:
        lines = [f"passed   {name}" for name in self.passed]
        return "\n".join(lines + [f"skipped  {name}: {reason}" for name, reason in self.skipped.items()])


def check_integrator(factory: Factory, system: HamiltonianSystem | None = None) -> CheckReport:
    """Run all checks on an integrator.

    Parameters
    ----------
    factory : callable
        Makes the integrator: its class, or a function without arguments such as ``lambda: MyMethod(dt=0.01)``.
    system : HamiltonianSystem, optional
        A nonlinear system with a domain, to which the method applies; the default is Hénon–Heiles. For a trained flow,
        the one it was trained for.

    Returns
    -------
    CheckReport
        The checks that passed, and those that do not apply with the reason; print it.

    Raises
    ------
    AssertionError
        At the first check that fails, saying which and why.
    ValueError
        If the method does not apply to the system.
    """
    integrator = _made(factory)
    if not (system is None or isinstance(system, HamiltonianSystem)):
        raise TypeError(f"`system` must be a HamiltonianSystem; got {type(system).__name__}.")
    if system is not None:
        why, remedy = "and most laws are those of {} ones", "leave `system` out: one check has {} of its own"
        system.check_conservative(why.format("conservative"), remedy.format("friction"))
        system.check_autonomous(why.format("autonomous"), remedy.format("a drive"))
    integrator.check(default_system() if system is None else system)
    passed, skipped = [], {}
    for check in CHECKS:
        try:
            check(integrator, system)
        except NotApplicable as reason:
            skipped[check.name] = str(reason)
        else:
            passed.append(check.name)
    return CheckReport(tuple(passed), skipped)


def parametrize_with_checks(factories: Iterable[Factory], system: HamiltonianSystem | None = None) -> Any:
    """A pytest decorator: one test for each integrator and check. Those that do not apply are skipped with the reason.

    Examples
    --------
    >>> @parametrize_with_checks([MyMethod])  # doctest: +SKIP
    ... def test_contract(integrator, check):
    ...     check(integrator)
    """
    import pytest

    def or_skip(check: Check, integrator: Integrator, system: HamiltonianSystem | None = system) -> None:
        try:
            check(integrator, system)
        except NotApplicable as reason:
            pytest.skip(str(reason))

    integrators = [_made(factory) for factory in factories]
    count = Counter(integrator.name for integrator in integrators)
    labels = [one.name if count[one.name] == 1 else repr(one) for one in integrators]
    cases = [
        pytest.param(integrator, partial(or_skip, check), id=f"{label}-{check.name}")
        for integrator, label in zip(integrators, labels, strict=True)
        for check in CHECKS
    ]
    return pytest.mark.parametrize(("integrator", "check"), cases)


def _made(factory: Factory) -> Integrator:
    if not callable(factory):
        what = f"a {type(factory).__name__}"
        raise TypeError(f"`factory` must be an integrator's class, or a function that makes one; got {what}.")
    integrator = factory()
    if not isinstance(integrator, Integrator):
        raise TypeError(f"`factory` must make an Integrator; it made {type(integrator).__name__}.")
    if not named(integrator):
        raise TypeError(f"`factory` made a {type(integrator).__name__} without `name`: set that class attribute.")
    return integrator

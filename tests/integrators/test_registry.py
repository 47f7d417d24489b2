"""The registry: listing without importing, built-ins that cannot be shadowed, plug-ins that break on use only."""

import re
from dataclasses import dataclass
from importlib import metadata
from importlib.metadata import EntryPoint
from typing import ClassVar

import numpy as np
import pytest

from sympflow import available, compare, get, register, solve, systems
from sympflow.integrators import registry
from sympflow.integrators.base import FixedStep


@dataclass(frozen=True)
class SymplecticEuler(FixedStep):
    name: ClassVar[str] = "symplectic_euler"
    order: ClassVar[int | None] = 1
    symplectic: ClassVar[bool] = True

    def step(self, system, t, y, h):
        d = system.ndof
        p = y[..., d:] + np.asarray(h)[..., None] * system.force(y[..., :d])
        return np.concatenate([y[..., :d] + np.asarray(h)[..., None] * system.velocity(p), p], -1)


@dataclass(frozen=True)
class Failing(SymplecticEuler):
    def __post_init__(self):
        raise SystemExit(3)


@dataclass(frozen=True)
class Refusing(SymplecticEuler):
    def __post_init__(self):
        raise ValueError("`dt` is not to my taste.")


class Optionless(SymplecticEuler):
    @classmethod
    def options(cls):
        raise KeyError("options")


class FailingStep(SymplecticEuler):
    def step(self, system, t, y, h):
        raise KeyError("inner")


class LeavingStep(SymplecticEuler):
    def step(self, system, t, y, h):
        raise SystemExit(3)


class InterruptedStep(SymplecticEuler):
    def step(self, system, t, y, h):
        raise KeyboardInterrupt


class FailingCheck(SymplecticEuler):
    def check(self, system):
        raise AttributeError("inner")


class DecliningCheck(SymplecticEuler):
    def check(self, system):
        raise ValueError("`method` needs another system.")


class Nameless(FixedStep):
    pass


def __getattr__(name):
    if name == "leaving_on_import":
        raise SystemExit("I leave")
    raise AttributeError(name)


@pytest.fixture
def plugins(monkeypatch):
    """Entry points as if installed: one that works, one that breaks, one with a built-in name, one that is none."""
    classes = (Failing, Refusing, Optionless, FailingStep, LeavingStep, InterruptedStep, FailingCheck, DecliningCheck)
    found = {re.sub("(?<=[a-z])(?=[A-Z])", "_", cls.__name__).lower(): cls.__name__ for cls in (*classes, Nameless)}
    found |= {"good": "SymplecticEuler", "verlet": "SymplecticEuler", "leaving": "leaving_on_import"}
    points = [EntryPoint(name, f"{__name__}:{cls}", registry.GROUP) for name, cls in found.items()]
    points += [EntryPoint("broken", "a_module_that_does_not_exist:Thing", registry.GROUP)]
    points += [EntryPoint("nothing", "math:pi", registry.GROUP)]
    monkeypatch.setattr(metadata, "entry_points", lambda group: [p for p in points if p.group == group])
    monkeypatch.setattr(registry, "_loaded", {})
    monkeypatch.setattr(registry, "_registered", {})
    registry._plugins.cache_clear()
    yield
    registry._plugins.cache_clear()


def test_registered_classes_solve():
    register("symplectic_euler", SymplecticEuler)
    sol = solve(systems.pendulum(), "symplectic_euler", (0, 1), dt=0.01, t_eval=[0.505, 1.0], dense_output=True)
    reference = solve(systems.pendulum(), "kahan_li8", (0, 1), t_eval=[0.505, 1.0])
    np.testing.assert_allclose(sol.y, reference.y, atol=0.02)  # order 1: the error is of the size of dt
    np.testing.assert_array_equal(sol.sol(sol.t), sol.y)
    assert get(SymplecticEuler) is SymplecticEuler
    assert solve(systems.pendulum(), SymplecticEuler(dt=0.01), (0, 1)).success


@pytest.mark.parametrize(
    ("name", "integrator", "error", "message"),
    [
        ("verlet", SymplecticEuler, ValueError, r"^`name` 'verlet' is a built-in method"),
        ("mine", lambda: None, TypeError, r"^`integrator` must be a subclass"),
        ("nameless", Nameless, TypeError, r"^`integrator` Nameless has no `name`"),
        *((name, SymplecticEuler, TypeError, r"^`name` must") for name in (3, None)),
        *((name, SymplecticEuler, ValueError, r"^`name` must") for name in ("", " ")),
    ],
)
def test_what_cannot_be_registered(name, integrator, error, message):
    with pytest.raises(error, match=message):
        register(name, integrator)
    assert not {"mine", "nameless"} & set(available())


def test_plugins_break_on_use_and_not_before(plugins):
    with pytest.warns(RuntimeWarning, match="'verlet' of .* is ignored: the name is taken"):
        names = available()
    assert {"good", "broken", "nothing"} <= set(names)
    assert get("good") is SymplecticEuler or get("good").name == "symplectic_euler"
    assert get("verlet").name == "verlet"
    with pytest.raises(ImportError, match=r"^`method` 'broken' of the plug-in .* cannot be loaded"):
        get("broken")
    with pytest.raises(ImportError, match=r"^`method` 'nothing' of the plug-in .* is not an Integrator class"):
        get("nothing")


@pytest.mark.filterwarnings("ignore:The integrator 'verlet' of")
@pytest.mark.parametrize(
    ("method", "error", "message"),
    [
        ("leaving", ImportError, r"^`method` 'leaving' of the plug-in .* cannot be loaded \(SystemExit: I leave\)"),
        ("failing", RuntimeError, r"^`method` 'failing' of the plug-in test_registry:Failing failed when it was made"),
        ("refusing", ValueError, r"^`dt` is not to my taste. \(Raised by the plug-in test_registry:Refusing.\)"),
        ("failing_step", RuntimeError, r"^`method` 'failing_step' of the plug-in .*Step failed \(KeyError: 'inner'"),
        ("leaving_step", RuntimeError, r"^`method` 'leaving_step' of the plug-in .*LeavingStep failed \(SystemExit: 3"),
        ("failing_check", RuntimeError, r"^`method` 'failing_check' of the plug-in .* failed \(AttributeError: inner"),
        ("declining_check", ValueError, r"^`method` needs another system.$"),
        ("interrupted_step", KeyboardInterrupt, "^$"),
        ("nameless", ImportError, r"^`method` 'nameless' of the plug-in .*Nameless is a class without `name`"),
        ("optionless", RuntimeError, r"^`method` 'optionless' of the plug-in test_registry:Optionless failed"),
    ],
)
def test_a_plugin_that_fails_is_named(method, error, message, plugins):
    with pytest.raises(error, match=message.replace("test_registry", __name__)):
        solve(systems.pendulum(), method, (0, 1))
    assert solve(systems.pendulum(), "verlet", (0, 1)).success


class Refined(SymplecticEuler):
    """A class that is registered under another name than its own."""


@pytest.mark.filterwarnings("ignore:The integrator 'verlet' of")
def test_plugins_are_compared_under_the_name_that_was_asked_for(plugins):
    register("mine", Refined)
    methods = ["good", get("good")(dt=0.1), "mine", Refined(), "verlet"]
    report = compare(systems.pendulum(), methods, ("energy", "volume"), t_span=(0, 1), n_outputs=5, repeats=1)
    assert [row.method for row in report.rows] == ["good", "good", "mine", "mine", "verlet"]
    assert [row.label for row in report.rows] == ["good", "good (dt=0.1)", "mine", "mine #2", "verlet"]
    assert "No volume: `method` 'good' of the plug-in" in report.rows[0].reason  # its NumPy step takes no tensors


@pytest.mark.filterwarnings("error")
def test_a_shadowing_plugin_is_skipped_where_warnings_are_errors(plugins, caplog):
    assert "good" in available()
    assert "The integrator 'verlet' of" in caplog.text
    assert get("verlet").__name__ != "SymplecticEuler"

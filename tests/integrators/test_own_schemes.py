"""Schemes of a user's own: methods of one call, by name, compiled, pickled by their table."""

import pickle
from dataclasses import replace
from importlib import metadata
from importlib.metadata import EntryPoint

import numpy as np
import pytest

import sympflow
from sympflow import Scheme, SympFlow, get, register, schemes, solve, splitting_method, systems
from sympflow.integrators import registry
from sympflow.schemes import SCHEMES
from sympflow.testing.checks import check_integrator

RUTH3 = Scheme("ruth3", 3, kicks=(7 / 24, 3 / 4, -1 / 24), drifts=(2 / 3, -2 / 3, 1.0), source="R. D. Ruth (1983)")
NOT_A_SCHEME = 7
HH, FPUT, KEPLER = systems.henon_heiles(), systems.fput(m=2, omega=20.0), systems.kepler(0.3)


def test_a_scheme_becomes_a_compiled_method_in_one_call():
    sol = solve(HH, splitting_method(RUTH3)(dt=0.05), (0, 5))
    assert sol.stats["backend"] == "compiled"
    assert sol.stats["force_evaluations"] == 3 * 100
    arrays = solve(HH, splitting_method(RUTH3), (0, 5), dt=0.05, backend="array")
    np.testing.assert_allclose(sol.y, arrays.y, rtol=0, atol=1e-13)
    check_integrator(splitting_method(RUTH3))
    lists = Scheme("ruth3", 3, kicks=list(RUTH3.kicks), drifts=np.array(RUTH3.drifts), source=RUTH3.source)
    assert (lists, hash(lists), lists.gradients) == (RUTH3, hash(RUTH3), (0.0, 0.0, 0.0))


def test_the_triple_of_a_built_in_method_is_that_method():
    assert splitting_method("verlet", "linear") is get("impulse")
    assert splitting_method(SCHEMES["kahan_li8"], clock="logarithmic") is get("log_kahan_li8")
    assert splitting_method("kahan_li8", "linear") is get("linear_kahan_li8")
    assert splitting_method("suzuki4", "linear").name == "suzuki4_linear"


def test_classes_and_instances_pickle_by_their_table():
    cls = splitting_method(RUTH3, clock="logarithmic", name="mine")
    assert pickle.loads(pickle.dumps(cls)) is cls
    method = cls(dt=0.1, shift=2.0)
    again = pickle.loads(pickle.dumps(method))
    assert again == method
    assert (again.scheme, again.clock) == (RUTH3, "logarithmic")


@pytest.fixture
def announced(monkeypatch):
    """Schemes as if installed plug-ins announced them: one that works, one of a built-in name, and two that break."""
    points = [
        EntryPoint("ruth", f"{__name__}:RUTH3", schemes.GROUP),
        EntryPoint("verlet", f"{__name__}:RUTH3", schemes.GROUP),
        EntryPoint("seven", f"{__name__}:NOT_A_SCHEME", schemes.GROUP),
        EntryPoint("absent", "a_module_that_does_not_exist:SCHEME", schemes.GROUP),
    ]
    monkeypatch.setattr(metadata, "entry_points", lambda group: [p for p in points if p.group == group])
    monkeypatch.setattr(registry, "_registered", {})
    monkeypatch.setattr(registry, "_loaded", {})
    monkeypatch.setattr(schemes, "_registered", {})
    caches = registry._plugins, schemes.announced_schemes
    for found in caches:
        found.cache_clear()
    yield
    for found in caches:
        found.cache_clear()


def test_an_announced_scheme_is_a_method_and_a_start_of_a_flow(announced):
    with pytest.warns(RuntimeWarning, match="The scheme 'verlet' of .* is ignored: the name is taken"):
        assert "ruth" in sympflow.available()
    assert get("ruth").scheme == RUTH3
    assert solve(HH, "ruth", (0, 1), splitting="kinetic").stats["backend"] == "compiled"
    flow = SympFlow.primed(HH, scheme="ruth", dt=0.5, palindromic=False)
    assert flow.scheme(0.5).kicks[0] == pytest.approx(RUTH3.kicks[0])
    with pytest.raises(ImportError, match=r"^`scheme` 'seven' of the plug-in .* is not a usable scheme"):
        get("seven")
    with pytest.raises(ImportError, match=r"^`scheme` 'absent' of the plug-in .* cannot be loaded"):
        solve(HH, "absent", (0, 1))


@pytest.mark.filterwarnings("ignore:The scheme 'verlet'")
def test_a_registered_scheme_is_a_method_and_a_start_of_a_flow(announced):
    register("third", RUTH3)
    assert get("third")().name == "third"
    assert SympFlow.primed(HH, scheme="third", dt=0.5, palindromic=False).scheme(0.5).force_evaluations == 3
    with pytest.raises(ValueError, match=r"^`name` 'ruth' belongs to the plug-in"):
        register("ruth", RUTH3)
    with pytest.raises(ValueError, match=r"^`scheme` 'ruth3' has kicks that add up to"):
        register("bad", replace(RUTH3, kicks=(0.5, 0.5, 0.5)))


def test_it_passes_all_checks():
    check_integrator(splitting_method(RUTH3))

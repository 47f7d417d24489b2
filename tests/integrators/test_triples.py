"""A method is a scheme × a splitting × a clock: the rows of the table, and triples that a user writes himself."""

import gc
import weakref

import numpy as np
import pytest

from sympflow import compare, get, solve, systems
from sympflow.schemes import SCHEMES

FPUT, PENDULUM, KEPLER = systems.fput(m=2, omega=20.0), systems.spring_pendulum(), systems.kepler(0.3)


@pytest.mark.parametrize(
    ("system", "name", "triple"),
    [
        (FPUT, "impulse", ("verlet", {"splitting": "linear"})),
        (FPUT, "mollified_impulse", ("verlet", {"splitting": "mollified"})),
        (FPUT, "implicit_explicit", ("verlet", {"splitting": "midpoint"})),
        (FPUT, "linear_srkn6b", ("srkn6b", {"splitting": "linear"})),
        (PENDULUM, "suzuki4_parts", ("suzuki4", {"splitting": "parts"})),
        (KEPLER, "log_leapfrog", ("leapfrog", {"clock": "logarithmic"})),
        (KEPLER, "log_kahan_li8", ("kahan_li8", {"clock": "logarithmic"})),
    ],
)
def test_a_triple_written_out_is_the_method_of_that_name(system, name, triple):
    scheme, options = triple
    named = solve(system, name, (0, 2), t_eval=[0.7, 2.0])
    written = solve(system, scheme, (0, 2), t_eval=[0.7, 2.0], **options)
    np.testing.assert_array_equal(written.y, named.y)
    assert named.stats["force_evaluations"] == written.stats["force_evaluations"]


# classes of a user's own ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["verlet", "gauss_legendre4", "impulse"])
def test_a_step_that_a_subclass_overrides_is_the_one_that_runs(name):
    class Standing(get(name)):
        def step(self, system, t, y, h):
            return y + 0 * y

    sol = solve(FPUT, Standing(), (0, 0.5), t_eval=[0.2, 0.5])
    np.testing.assert_array_equal(sol.y, np.repeat(FPUT.y0[:, None], 2, axis=1))
    assert sol.stats["backend"] == "numpy"


def test_triples_are_told_apart_in_reports():
    kahan = get("kahan_li8")
    report = compare(KEPLER, [kahan(), kahan(clock="logarithmic"), kahan(splitting="parts")], t_span=(0, 1), repeats=1)
    assert [row.label for row in report.rows] == ["kahan_li8", "kahan_li8 (logarithmic)", "kahan_li8 (parts)"]
    assert [get(name).forces_a_step() for name in ("kahan_li8", "kahan_li8_parts", "log_kahan_li8")] == ["17", "", ""]


@pytest.mark.parametrize("name", ["verlet", "gauss_legendre4", "impulse"])
def test_what_a_subclass_overrides_is_asked(name):
    calls = []

    class Watching(get(name)):
        def rollout(self, *arguments):
            calls.append("rollout")
            return super().rollout(*arguments)

        def evaluations(self, *arguments):
            return {"force_evaluations": 7, "hessian_evaluations": 0}

    watched, plain = (solve(FPUT, cls(), (0, 0.5), t_eval=[0.2, 0.5]) for cls in (Watching, get(name)))
    np.testing.assert_array_equal(watched.y, plain.y)
    assert calls == ["rollout"]
    assert watched.stats["force_evaluations"] == 7
    assert watched.stats["backend"] == plain.stats["backend"] == "compiled"


def test_strang_steps_are_what_parts_compose():
    with pytest.raises(ValueError, match=r"^`splitting` 'parts' composes Strang steps, .* 'blanes_moan4' is not made"):
        solve(PENDULUM, "blanes_moan4", (0, 1), splitting="parts")
    for name in ("verlet", "leapfrog", "suzuki4", "kahan_li6", "kahan_li8", "yoshida4"):
        assert sum(SCHEMES[name].strang_weights) == pytest.approx(1.0, abs=1e-14)
    assert SCHEMES["srkn11b"].strang_weights is None


@pytest.mark.parametrize("name", ["verlet", "linear_srkn6b", "strang_parts", "log_leapfrog"])
def test_no_method_keeps_a_system_alive(name):
    system = systems.kepler(0.3) if name == "log_leapfrog" else systems.fput(m=1, omega=10.0)
    solve(system, name, (0, 0.3), t_eval=[0.3])
    alive = weakref.ref(system)
    del system
    gc.collect()
    assert alive() is None

"""Natural first calls: what is meant is done, or the error names the remedy."""

import importlib
import math
import pickle
import re
import warnings

import numpy as np
import pytest
import sympy as sp
from conftest import refusals
from scipy.special import ellipk
from sympy import cos
from sympy.physics.mechanics import dynamicsymbols

import sympflow
from sympflow import HamiltonianSystem, solve, systems

H = HamiltonianSystem.from_sympy
SPRING = "p**2/2 + q**2/2"
UNSUITED = H("p**2*(1 + q**2)/2 + q**2/2")
x, y, px, py, k = sp.symbols("x y px py k")


@pytest.mark.parametrize("system", ["harmonic-oscillator", "harmonic_oscillator", SPRING, sp.sympify(SPRING)])
def test_a_name_and_a_formula_are_systems(system):
    sol = solve(system, "verlet", (0, 1), [1, 0], dt=0.1)
    np.testing.assert_array_equal(sol.y, solve(H(SPRING), "verlet", (0, 1), [1, 0], dt=0.1).y)


@pytest.mark.parametrize(
    "call",
    [
        lambda system: sympflow.compare(system, ["verlet"], t_span=(0, 1), repeats=1),
        lambda system: sympflow.ensemble(system, "verlet", (0, 1)),
        lambda system: sympflow.frequencies(system, "verlet", (0, 20)),
        lambda system: sympflow.gali(system, "verlet", (0, 1)),
        lambda system: sympflow.escape_times(system, "verlet", (0, 1)),
        lambda system: sympflow.poincare_section(system, "verlet", (0, 1)),
        lambda system: sympflow.stability(system, ["verlet"], t_span=(0, 1)),
        lambda system: sympflow.choose_step(system, "verlet", 1e-3),
        sympflow.shipped_flows,
    ],
)
def test_every_door_takes_the_name_of_a_scene(call):
    call("henon-heiles")
    with pytest.raises(ValueError, match=r"^`system` 'henon-heile' is not the name of a scene. Did you mean"):
        call("henon-heile")


SAME = {
    "RK45": "rk45",
    "Verlet": "verlet",
    "DOP853": "dop853",
    "Gauss-Legendre6": "gauss_legendre6",
    "velocity_verlet": "verlet",
    "stormer_verlet": "verlet",
    "forest_ruth": "yoshida4",
}


@pytest.mark.parametrize(("word", "name"), SAME.items())
def test_other_spellings_of_methods(word, name):
    assert sympflow.get(word) is sympflow.get(name)


NAMED = {
    "x and px": (px**2 / 2 + x**2 / 2 + y**4 + py**2, [x, y], [px, py]),
    "a text": ("px**2/2 + x**2/2 + y**4 + py**2", ["x", "y"], ["px", "py"]),
    "from 0": ("p0**2/2 + q0**2/2 + q1**4 + p1**2", ["q0", "q1"], ["p0", "p1"]),
}


@pytest.mark.parametrize(("expression", "q", "p"), NAMED.values(), ids=NAMED)
def test_coordinates_have_any_names(expression, q, p):
    assert H(expression, q=q, p=p).expression == H("p1**2/2 + q1**2/2 + q2**4 + p2**2").expression


def test_functions_of_the_time_are_coordinates():
    r, pr = dynamicsymbols("r p_r")
    assert H(pr**2 / 2 + k / r, q=[r], p=[pr], params={k: 2}).expression == H("p**2/2 + 2/q").expression
    theta = dynamicsymbols("theta")
    assert (
        H(theta.diff() ** 2 / 2 - cos(theta), q=[theta], p=[theta.diff()]).expression == H("p**2/2 - cos(q)").expression
    )


def ran():
    return solve(SPRING, "verlet", (0, 1), [1, 0], dt=0.1)


def compared():
    return sympflow.compare(SPRING, ["verlet"], ("energy",), y0=[1, 0], t_span=(0, 1), repeats=1)


def bowl(q):
    return (q**2).sum(-1)


ANSWERED = {
    "lambda": (lambda: solve(lambda q, p: p**2), TypeError, r"`system` .* HamiltonianSystem\(hamiltonian=f, ndof=d\)"),
    "factory": (lambda: solve(systems.pendulum), TypeError, r"`system` .* call it, pendulum\(\)"),
    "no such scene": (lambda: solve("henon"), "`system` 'henon' .*Did you mean 'henon-heiles'"),
    "x, v": (lambda: H("v**2/2 + x**2/2"), "q1 … qd and p1 … pd: other names .* q="),
    "x, px": (lambda: H("px**2/2 + x**2/2"), "q1 … qd and p1 … pd: other names .* q="),
    "P, Q": (lambda: H("P**2/2 + Q**2/2"), "q1 … qd and p1 … pd: other names .* q="),
    "q_1": (lambda: H("p_1**2/2 + q_1**2/2"), "q1 … qd and p1 … pd: other names .* q="),
    "q0": (lambda: H("p0**2/2 + q0**2/2"), "q1 … qd and p1 … pd: other names .* q="),
    "uneven names": (lambda: H("p**2/2", q=["q"], p=["p", "r"]), "`q` and `p` must name d"),
    "verlet,srkn11b": (lambda: sympflow.get("verlet,srkn11b"), "names several: one method .*`compare` takes several"),
    "yoshida": (lambda: sympflow.get("yoshida"), "'yoshida4' or 'yoshida6'"),
    "ruth3": (lambda: sympflow.get("ruth3"), "'yoshida4'"),
    "whfast": (lambda: sympflow.get("whfast"), "'wisdom_holman'"),
    "Radau": (lambda: sympflow.get("Radau"), "'gauss_legendre6', which is implicit"),
    "LSODA": (lambda: sympflow.get("LSODA"), "'gauss_legendre6', which is implicit"),
    "kinds": (lambda: sympflow.get("nothing"), r"(?s)unknown.*separable H +'verlet'.*Runge–Kutta .*'rk45'"),
    "args": (lambda: solve(H(SPRING), "verlet", y0=[1, 0], args=(1,)), TypeError, "`args` .* `params`"),
    "q0=": (lambda: solve(H(SPRING), "verlet", q0=[1], p0=[0], y0=[1, 0]), TypeError, r"`q0` .*`y0`, \[q, p\]"),
    "rtol": (lambda: solve(H(SPRING), "verlet", y0=[1, 0], rtol=1e-9), TypeError, "`rtol` .*fixed steps: give"),
    "functions of t": (lambda: H(dynamicsymbols("x") ** 2), TypeError, r"`expression` holds x\(t\): .*q=\[x\]"),
    "tol": (lambda: solve(H(SPRING), "rk45", y0=[1, 0], tol=1e-9), TypeError, "`tol` .*`rtol` and `atol`"),
    "keyword": (lambda: H("p**2/2 + lambda*q"), "lambda is a word of Python"),
    "2q": (lambda: H("p**2/2 + 2q"), r"2q lacks a sign: write 2\*q"),
    "²": (lambda: H("p²/2"), r"² is not understood: write q\*\*2"),
    "dimension": (lambda: HamiltonianSystem(lambda q: q**2, dimension=1), TypeError, "are `ndof` of functions"),
    "H =": (lambda: H("H(q, p) = p**2/2"), r"leave 'H\(q, p\) =' out"),
    "t_end": (lambda: solve("pendulum", "verlet", t_end=1), TypeError, r"times are `t_span`, \(start, end\)"),
    "n_steps": (lambda: solve("pendulum", "verlet", n_steps=10), TypeError, r"dt=\(t1 - t0\)/n"),
    "times": (lambda: solve("pendulum", "verlet", ts=[0, 1]), TypeError, "times of outputs are `t_eval`"),
    "order": (lambda: solve("pendulum", (0, 1)), TypeError, r"The order is solve\(system, method, t_span, y0\)"),
    "misspelled": (lambda: sympflow.sovle, AttributeError, "Did you mean 'solve'"),
    "metrics": (lambda: sympflow.compare("pendulum", ["verlet"], (0, 10)), "times are `t_span`"),
    "&": (lambda: H("p**2/2 + Piecewise((q, (q > 0) & (q < 1)), (0, True))"), "single comparison: order"),
    "text as potential": (lambda: HamiltonianSystem(SPRING), TypeError, "`potential` .*from_sympy"),
    "cos q": (lambda: H("p**2/2 - cos q"), r"cos q lacks brackets: write cos\(q\)"),
    "k q": (lambda: H("p**2/2 + k q**2"), r"k q lacks a sign: write k\*q"),
    "|q|": (lambda: H("p**2/2 + |q|"), r"write abs\(q\)"),
    "sol.times": (lambda: solve(SPRING, y0=[1, 0], t_span=(0, 1)).times, AttributeError, "'times': take `t`"),
    "sol.x": (lambda: solve(SPRING, y0=[1, 0], t_span=(0, 1)).x, AttributeError, "'x': take `y`"),
    "system.solve": (lambda: H(SPRING).solve, AttributeError, r"'solve': take sympflow.solve\(system, method"),
    "system.energy": (lambda: H(SPRING).energy, AttributeError, r"'energy': take `hamiltonian\(y\)`"),
    "a state as a list": (lambda: H(SPRING).hamiltonian([1, 0]), TypeError, r"`y` must be an array .* pass np.array"),
    "q apart from p": (lambda: solve("kepler", y0=([1, 0], [0, 1])), "`y0` must .* Join q and p"),
    "a solution": (lambda: sympflow.lyapunov(solve(SPRING, y0=[1, 0])), TypeError, "pass its `system`, and its `y0`"),
    "a condition": (
        lambda: solve(SPRING, y0=[1, 0], events=lambda t, y: y[0] > 0),
        TypeError,
        "`events` must return one number .* it returned True",
    ),
    "an event of y": (lambda: solve(SPRING, y0=[1, 0], events=lambda y: y), TypeError, r"Write g\(t, y\)"),
    "Tsit5": (lambda: sympflow.get("Tsit5"), "'dop853'"),
    "symplectic": (lambda: sympflow.get("symplectic"), "'srkn11b', or 'kahan_li8'"),
    "a coordinate of nothing": (
        lambda: H("px**2/2 + x**2/2", q=["x", "y"], p=["px", "py"]),
        "`q` and `p` name 'y' and 'py', on which H does not depend",
    ),
    "q alone": (lambda: H("px**2/2 + x**2/2", q=["x"]), r"as in q=\['x', 'y'\], p=\['px', 'py'\]"),
    "RK23": (lambda: sympflow.get("RK23"), "'rk45'"),
    "mercurius": (lambda: sympflow.get("mercurius"), "'dop853' with `rtol`"),
    "y0 turned": (lambda: solve("pendulum", y0=np.ones((2, 5))), r"got \(2, 5\). Transpose it"),
    "sympflow.plotting": (lambda: sympflow.plotting, AttributeError, "plots are methods of results"),
    "sympflow.chaos": (lambda: sympflow.chaos, AttributeError, "take lyapunov, sali"),
    "a function as text": (lambda: H(len), r"of a function make HamiltonianSystem\(hamiltonian=f, ndof=d\)"),
    "no ndof": (lambda: HamiltonianSystem(len), r"as in HamiltonianSystem\(V, ndof=2\)"),
    "Trajectories(t, y)": (
        lambda: sympflow.Trajectories(ran().t, ran().y),
        TypeError,
        r"Trajectories.read\(\(t, y\)\)",
    ),
    "sol[0]": (lambda: ran()[0], TypeError, r"`sol` has no item 0: take `sol.t`, `sol.y`"),
    "t, y = sol": (lambda: list(ran()), TypeError, r"as in t, y = sol.t, sol.y"),
    "sol.q1": (lambda: ran().q1, AttributeError, r"'q1': take `q\[..., i, :\]`"),
    "plot(kind=)": (lambda: ran().plot(kind="phase"), TypeError, r"`kind` .* of plot\(\).*: did you mean `kinds`\?"),
    "no system": (
        lambda: solve(t_span=(0, 1)),
        TypeError,
        r"`system` is missing: give it, solve\(system, method, t_span",
    ),
    "dt by place": (lambda: solve(SPRING, "verlet", (0, 1), [1, 0], 0.1), TypeError, r"after `y0` are given by name"),
    "y0 twice": (lambda: solve(SPRING, "verlet", (0, 1), [1, 0], y0=[1, 0]), TypeError, "`y0` is given twice"),
    "no tol": (lambda: sympflow.choose_step(SPRING, "verlet"), TypeError, "`tol` is missing: give it, choose_step"),
    "compare(tol=)": (lambda: sympflow.compare(SPRING, ["verlet"], tol=1), TypeError, "`tol` .*sympflow.choose_step"),
    "repeat": (lambda: sympflow.compare(SPRING, ["verlet"], repeat=1), TypeError, "did you mean `repeats`"),
    "with_params of a dict": (lambda: H(SPRING).with_params({"k": 1}), TypeError, r"with_params\(\) are given by name"),
    "force of a number": (
        lambda: H(SPRING).force(1.0),
        TypeError,
        r"`q` must be an array or a tensor, positions; got 1.0",
    ),
    "H of a solution": (lambda: H(SPRING).hamiltonian(ran()), TypeError, "got Solution: pass .*`sol.states`"),
    "H of sol.y": (lambda: H(SPRING).hamiltonian(ran().y), "Of a solution pass `sol.states`"),
    "kepler(mu=)": (lambda: systems.kepler(mu=2), TypeError, r"`mu` .*kepler\(\), which takes e: write your own H"),
    "fput_beta(N=)": (lambda: systems.fput_beta(N=9), TypeError, "`N` .* takes n, beta, amplitude: did you mean `n`"),
    "pendulum(dt=)": (lambda: systems.pendulum(dt=0.1), TypeError, r"which takes none: pass it to solve\(\)"),
    "pendulum(1)": (lambda: systems.pendulum(1), TypeError, "`pendulum` takes no arguments: leave the others out"),
    "dt0": (lambda: solve(SPRING, "verlet", y0=[1, 0], dt0=1), TypeError, "the step of fixed-step methods is `dt`"),
    "tspan": (lambda: solve(SPRING, "verlet", y0=[1, 0], tspan=1), TypeError, "did you mean `t_span`"),
    "abstol": (lambda: solve(SPRING, "rk45", y0=[1, 0], abstol=1), TypeError, "are `rtol` and `atol`"),
    "dt of rk45": (lambda: solve(SPRING, "rk45", y0=[1, 0], dt=1), TypeError, "chooses its own steps: give `rtol`"),
    "flow=": (lambda: solve(SPRING, "verlet", y0=[1, 0], flow=1), TypeError, "is given in the place of a method"),
    "n_workers": (lambda: solve(SPRING, y0=[1, 0], n_workers=2), TypeError, "sympflow.ensemble has `workers`"),
    "epochs": (
        lambda: sympflow.train("pendulum", epochs=3),
        TypeError,
        r"`budget`, in seconds, .*Adam\(steps=\.\.\.\)",
    ),
    "from_sympy(V=)": (lambda: H(SPRING, V=1), TypeError, "a potential is `potential`"),
    "from_sympy(k=)": (lambda: H("p**2/2 + k*q**2", k=1), TypeError, "values of symbols are `params`"),
    "from_sympy(tspan=)": (lambda: H(SPRING, tspan=1), TypeError, "did you mean `t_span`"),
    "any case": (lambda: systems.Kepler, AttributeError, "Did you mean 'kepler'"),
    "system.train": (lambda: H(SPRING).train, AttributeError, r"take sympflow.train\(system\)"),
    "y0 of a formula": (lambda: solve(SPRING, y0=[1, 0, 0]), r"for 'H = p1\*\*2/2 \+ q1\*\*2/2', \[q, p\] with 1 each"),
    "a flow without its system": (
        lambda: sympflow.shipped_flows("pendulum")[0].load().plot(),
        "`system` is needed, whose H bounds the domain .*load the flow with it",
    ),
    "f.pt": (lambda: sympflow.shipped_flows("pendulum")[0].load().save("f.pt"), "call it f.safetensors"),
    "a list of elements": (
        lambda: HamiltonianSystem.planets([1, 0.1], elements=[{"a": 1}]),
        r"`elements` must give a, .* as in \{'a': \[...\], 'e'",
    ),
    "Box(low)": (lambda: sympflow.Box([-1, -1]), TypeError, r"^`high` is missing: give it, Box\(low, high\)"),
    "pairs by place": (lambda: HamiltonianSystem.pairs("-1/r", [1, 1]), TypeError, r"pairs\(\) .*: write masses="),
    "pairs(mass=)": (lambda: HamiltonianSystem.pairs("-1/r", mass=[1, 1]), TypeError, "did you mean `masses`"),
    "pairs without masses": (lambda: HamiltonianSystem.pairs("-1/r"), TypeError, r"pairs\(potential, masses=…\)"),
    "from_sympy by place": (lambda: H(SPRING, [1, 0]), TypeError, r"of from_sympy\(\) after `expression` are"),
    "to_csv()": (lambda: compared().to_csv(), TypeError, r"^`path` is missing: give it, to_csv\(path\)"),
    "report[0]": (lambda: compared()[0], TypeError, r"has no item 0: take `rows`, as in report.rows\[0\]"),
    "report.save": (lambda: compared().save, AttributeError, r"take `table\(\)`, `to_csv\(path\)`"),
    "system.y0 =": (lambda: setattr(H(SPRING), "y0", [1, 0]), AttributeError, r"^`y0` .* system.with_scene\(y0=…\)"),
    "system.params =": (lambda: setattr(H(SPRING), "params", {}), AttributeError, r"^`params` .* system.with_params\("),
    "system.force =": (lambda: setattr(H(SPRING), "force", len), AttributeError, "^`force` .* make a system with it"),
    "qdot": (lambda: H("qdot**2/2 + q**2/2"), "function of momenta: if qdot is a velocity q', write p"),
    "no such file": (lambda: solve("nowhere.py:morse"), "^`system` 'nowhere.py': there is no such file"),
    "of functions": (lambda: solve(HamiltonianSystem(bowl, ndof=1)), "`y0` is needed: V = bowl has no"),
    "scene": (lambda: systems.henon, AttributeError, "Did you mean 'henon_heiles'"),
}


test_the_answer_names_the_remedy = refusals(*ANSWERED.values(), ids=ANSWERED)


def test_a_solution_without_dense_output_has_none_as_in_scipy():
    assert ran().sol is None
    assert ran().to_scipy()["sol"] is None
    assert solve(SPRING, "verlet", (0, 1), [1, 0], dt=0.1, dense_output=True).sol


def test_a_system_in_a_file_is_named_as_on_the_command_line(tmp_path):
    file = tmp_path / "own.py"
    file.write_text(f"import sympflow\nspring = sympflow.HamiltonianSystem.from_sympy({SPRING!r}, y0=[1, 0])\n")
    sol = solve(f"{file}:spring", "verlet", (0, 1), dt=0.1)
    np.testing.assert_array_equal(sol.y, ran().y)
    assert sol.system.title == "own.py:spring"


def test_systems_are_named_by_what_defines_them():
    named = [HamiltonianSystem(bowl, ndof=1), HamiltonianSystem(lambda q: 2 * bowl(q), ndof=1), H(SPRING, y0=[1, 0])]
    assert [s.name for s in named] == ["V = bowl", "V of a function", "H = p1**2/2 + q1**2/2"]
    flow = sympflow.train(named[2], restarts=1, steps=3, points=20)
    assert "of H = p1**2/2" in repr(flow)


def test_a_system_in_another_scene():
    system = H("p**2/2 + k*q**2/2", params={"k": 100.0}, y0=[1, 0])
    other = system.with_scene(y0=[0, 2], t_span=(0, 3), name="spring")
    assert (other.name, other.t_span, other.y0.tolist(), other.params) == ("spring", (0, 3), [0, 2], {"k": 100})
    assert (system.t_span, system.y0.tolist()) == ((0, 100), [1, 0])
    assert other.with_scene(dt=0.1).dt == 0.1
    assert other.dt == system.dt == 0.005
    assert system.with_scene(domain=sympflow.Box([-1, -1], [1, 1])).domain.width == 2
    forced = sympflow.doubled(other, "-p*q**2").physical
    assert forced.with_scene(y0=[1, 0]).name == forced.name == "spring_forced"


@pytest.mark.parametrize("function", [solve, systems.kepler, sympflow.lyapunov])
def test_functions_are_pickled_by_name(function):
    assert pickle.loads(pickle.dumps(function)) is function


@pytest.mark.parametrize("end", [100, math.inf])
def test_a_tolerance_chooses_the_step_of_a_run_that_an_event_ends(end):
    def turns(t, y):
        return y[1]

    turns.terminal, turns.direction = True, 1
    sol = solve("pendulum", "srkn11b", (0, end), [1.0, 0.0], events=turns, tol=1e-12)
    np.testing.assert_allclose(sol.t_events[0], 2 * ellipk(np.sin(0.5) ** 2), rtol=1e-12)


def test_a_flow_of_a_system_without_a_domain_is_trained_around_its_orbit():
    system = H("p**2/2 + q**2/2 + q**4/4", y0=[1.0, 0.0])
    flow = sympflow.train(system, restarts=1, steps=5, points=40)
    sol = solve(system, flow, (0, 50))
    assert "domain_exit" not in sol.stats
    assert sympflow.max_energy_error(sol) < 1e-4


@pytest.mark.parametrize(
    ("function", "title"), [(sympflow.lyapunov, "Lyapunov exponent"), (sympflow.sali, "SALI"), (sympflow.gali, "GALI")]
)
def test_indicators_are_shown_by_their_names(function, title):
    assert repr(function("henon-heiles", "verlet", (0, 1))).startswith(f"{title}\n")


def test_states_in_the_place_of_times_are_told():
    with pytest.warns(RuntimeWarning, match=r"`t_span` .* look interchanged: the order is solve\(system, method"):
        solve(SPRING, "verlet", [1.0, 0.5], (0, 10))
    solve(SPRING, "verlet", [0, 10], (1.0, 0.5))
    solve(SPRING, "verlet", (1, 0), (0, 10))


def test_a_tolerance_that_needs_too_many_steps_is_the_reason():
    with pytest.raises(ValueError, match=r"^`tol` 1e-13 of the states, as always on .* of order 2: take one of higher"):
        solve("p1**2/2 + p2**2/2 - 1/sqrt(q1**2 + q2**2)", "log_leapfrog", (0, 20), [1, 0, 0, 0.5], tol=1e-13)


def test_no_energy_is_shown_of_a_doubled_system():
    """It is 0 in the physical limit, whatever the step."""
    system = systems.decaying_orbit()
    assert "energy" not in repr(solve(system, t_span=(0, 1)))
    assert sympflow.compare(system, ["gauss_legendre4"], t_span=(0, 1), repeats=1).metrics[:2] == ("error", "volume")
    coarse, fine = (sympflow.choose_step(system, "gauss_legendre6", tol, t_span=(0, 5)) for tol in (1e-4, 1e-8))
    assert 2 < coarse / fine < 10


def test_rooms_are_attributes():
    assert sympflow.metrics.__name__ == "sympflow.metrics"


STIFF = {
    "kept": lambda w: H(f"p**2/2 + {w**2}*q**2/2"),
    "damped": lambda w: H(f"p**2/2 + {w**2}*q**2/2", damping=0.01 * w),
    "driven": lambda w: H(f"p**2/2 + {w**2}*q**2/2 - {w**2}*q*cos({w}*t/3)/9", time="t"),
}
LONG = [("verlet", 0.19), ("kahan_li8", 2.0), ("euler", 1e-4), ("rk4", 0.4), ("implicit_midpoint", 1.0)]
TOO_LONG = [("verlet", 0.21), ("euler", 0.1), ("rk4", 1.6)]
"""Radians a step: Verlet's method is stable up to 2, and told from a tenth of it on."""


@pytest.mark.parametrize("w", [1e-9, 1.0, 1e9])
@pytest.mark.parametrize("make", STIFF.values(), ids=STIFF)
def test_a_step_that_is_too_long_is_told_in_any_units(make, w):
    for (method, z), told in [*((row, False) for row in LONG), *((row, True) for row in TOO_LONG)]:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            for _ in range(2):  # the second time from memory
                solve(make(w), method, (0, 50 / w), [[0, 0], [2, 0]], dt=z / w)
        assert [str(each.message).startswith("`dt`") for each in caught] == [True] * 2 * told, (method, z)


@pytest.mark.parametrize(
    "call", [sympflow.ensemble, sympflow.lyapunov, sympflow.sali, sympflow.frequencies, sympflow.poincare_section]
)
@pytest.mark.parametrize("system", [H("p**2/2 + q**2/2 + q**4/7"), UNSUITED], ids=["separable", "not separable"])
def test_functions_of_orbits_choose_a_method(call, system):
    found = call(system, None, (0, 5), [1.0, 0.3])
    if call in (sympflow.ensemble, sympflow.poincare_section):
        assert found.integrator.name == ("srkn11b" if system.separable else "gauss_legendre6")
    assert found.success


def test_a_tolerance_chooses_the_step_of_orbits():
    found = sympflow.poincare_section(H(SPRING), "verlet", (0, 50), [1.0, 0.3], tol=1e-6)
    assert found.integrator.dt == pytest.approx(1.4e-3, rel=0.5)


STARTED = [
    ("p**2/(2*m) + k*q**2/2", None, (0, 1e-12), [1e-10, 0.0], {"params": {"m": 1e-26, "k": 10.0}}),
    ("p**2/2 + 3e4*q**2/2 + q**4", None, (0, 1), [1.0, 0.0], {}),
    ("p**2/2 + k*q**2/2", None, (0, 1), [1.0, 0.0], {"params": {"k": 4e4}}),
    (
        "(p1**2 + p2**2)/(2*m) - G*m/sqrt(q1**2 + q2**2)",
        None,
        (0, 3e7),
        [1.5e11, 0, 0, 1.8e29],
        {"params": {"m": 6e24, "G": 1.33e20}},
    ),
    ("(p1**2 + p2**2)/2 - 1/sqrt(q1**2 + q2**2)", None, (0, 20), [0.1, 0, 0, 4.3588989], {"tol": 1e-9}),
    ("(p1**2 + p2**2)/2 - 1/sqrt(q1**2 + q2**2)", "log_kahan_li8", (0, 1), [1.0, 0, 0, 1.8], {}),
    ("p**2*(1 + q**2)/2 + q**2/2", "tao8", (0, 10), [1.0, 0.0], {"tol": 1e-9}),
]


@pytest.mark.parametrize(("expression", "method", "span", "y0", "options"), STARTED)
def test_scales_are_those_of_the_states_of_the_call(expression, method, span, y0, options):
    """A formula has no state of its own: steps and clocks take theirs from y0."""
    sol = solve(expression, method, span, y0, **options)
    assert sol.success
    params = options.get("params")
    atol = 1e-12 * min(x for x in np.abs(y0) if x)
    exact = solve(H(expression, params=params, y0=y0), "dop853", span, rtol=1e-12, atol=atol)
    assert exact.success
    size = np.abs(exact.y).max(-1)
    assert (np.abs(sol.y[:, -1] - exact.y[:, -1]) < 1e-6 * size).all()


def test_params_of_a_formula_may_be_of_each_trajectory():
    sol = solve("p**2/2 + k*q**2/2", None, (0, 1), [[1, 0], [1, 0]], params={"k": [1.0, 4.0]})
    np.testing.assert_allclose(sol.y[:, 0, -1], np.cos([1.0, 2.0]), rtol=1e-9)


BENT = "p**2*(1 + q**2)/2 + q**2/2"
OF_ORBITS = {
    "ensemble": lambda s, y0: sympflow.ensemble(s, "tao8", (0, 2), y0, dt=0.05, reduce="final").final,
    "section": lambda s, y0: sympflow.poincare_section(s, "tao8", (0, 10), y0, tol=1e-6).states,
    "frequencies": lambda s, y0: sympflow.frequencies(s, "tao8", (0, 40), y0, dt=0.05).frequencies,
    "step": lambda s, y0: sympflow.choose_step(s, "tao8", 1e-6, y0=y0, t_span=(0, 5)),
}


@pytest.mark.parametrize("function", OF_ORBITS)
def test_scales_of_orbits_are_those_of_their_states(function):
    """The one of several states that has the highest energy counts."""
    states = np.array([[2.0, 0.0], [1.0, 0.0]])
    found, expected = (OF_ORBITS[function](H(BENT, y0=y0, dt=0.1), states) for y0 in (None, states[0]))
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    ("name", "home"), [("as_scipy", "scipy"), ("odeint", "torchdiffeq"), ("from_module", "systems")]
)
def test_names_of_other_rooms_are_told(name, home):
    with pytest.raises(AttributeError, match=f"It is `sympflow.interop.{home}.{name}`"):
        getattr(sympflow, name)
    assert callable(getattr(importlib.import_module(f"sympflow.interop.{home}"), name))


def test_a_tolerance_below_single_precision_is_refused():
    with pytest.raises(ValueError, match="`tol` 1e-09 is below the rounding of single precision: compute in float64"):
        sympflow.solve(sympflow.systems.henon_heiles(), "kahan_li8", (0, 10), tol=1e-9, dtype="float32")


LOST = {
    "driven": ("p**2/2 + sin(q)**2 - 0.3*q*cos(0.9*t)", {"time": "t"}),
    "damped": ("p**2/2 - cos(q)", {"damping": 0.02}),
    "both": ("p**2/2 - cos(q) - 0.3*q*cos(0.9*t)", {"time": "t", "damping": 0.05}),
}


@pytest.mark.parametrize("w", [1e-20, 1.0, 1e20])
@pytest.mark.parametrize("method", ["rk45", "dop853"])
@pytest.mark.parametrize("t_eval", [None, 50])
@pytest.mark.parametrize("name", LOST)
def test_a_tolerance_that_loses_energy_is_doubted_of_driven_and_damped_systems(name, t_eval, method, w):
    """In units of w of rates, and of s of q and p."""
    H, scene = LOST[name]
    H = re.sub(r"\bt\b", "(w*t)", re.sub(r"\b([qp])\b", r"(\1/s)", H))
    s = w**-0.5
    scene = scene | ({"damping": scene["damping"] * w} if "damping" in scene else {})
    system = HamiltonianSystem.from_sympy(f"w*s**2*({H})", params={"w": w, "s": s}, **scene)
    asked = {} if t_eval is None else {"t_eval": np.linspace(0, 60 / w, t_eval)}

    def run(rtol):
        return solve(system, method, (0, 60 / w), [1.5 * s, 0.0], rtol=rtol, atol=rtol * s, **asked)

    fine = run(1e-8)  # without a warning, which would be an error
    with pytest.warns(RuntimeWarning, match=f"`rtol` is too large for method '{method}': the energy of the run is off"):
        loose = run(0.3)
    energies = [float(system.hamiltonian(sol.y[:, -1], sol.t[-1])) for sol in (loose, fine)]
    assert abs(energies[0] - energies[1]) > 0.01 * w * s**2


KEPLER = "(p1**2 + p2**2)/2 - 1/sqrt(q1**2 + q2**2)", [0.1, 0, 0, 4.3588989435406735]


@pytest.mark.parametrize(
    ("method", "options", "told"),
    [
        (
            "log_leapfrog",
            {"dt": 20.0},
            "`dt` 20 is too long for method 'log_leapfrog': with half of it the final state differs",
        ),
        (
            "log_kahan_li8",
            {"dt": 5.0},
            "`dt` 5 is too long for method 'log_kahan_li8': with half of it the final state differs",
        ),
        ("log_blanes_moan4", {"dt": 20.0}, "`dt` 20 is too long for method 'log_blanes_moan4': the energy"),
        ("rk45", {}, "`rtol` is too large for method 'rk45': the energy of the run is off by .* Take rtol=1e-8"),
        ("dop853", {}, "`rtol` is too large for method 'dop853': the energy of the run is off by"),
    ],
)
def test_every_method_whose_steps_are_too_long_is_doubted(method, options, told):
    H0, y0 = KEPLER if method != "dop853" else ("p**2/2 + q**2/2", [1, 0])
    end = 20 if options else 100 if method == "rk45" else 2000
    with pytest.warns(RuntimeWarning, match=told):
        solve(H(H0, y0=y0), method, (0, end), **options)
    fine = {"rtol": 1e-8, "atol": 1e-10} if not options else {"dt": 0.05}
    solve(H(H0, y0=y0), method, (0, 20), **fine)  # in silence


@pytest.mark.parametrize(
    "run",
    [
        lambda system, y0: sympflow.ensemble(system, "verlet", (0, 100), y0=y0, dt=0.55, reduce="energy_error"),
        lambda system, y0: sympflow.ensemble(system, "rk45", (0, 100), y0=y0, t_eval=[100.0], rtol=0.1, atol=0.1),
        lambda system, y0: sympflow.lyapunov(system, "verlet", (0, 100), y0, dt=0.55),
        lambda system, y0: sympflow.sali(system, "verlet", (0, 100), y0, dt=0.55),
        lambda system, y0: sympflow.poincare_section(system, "verlet", (0, 100), y0, coordinate="p", dt=0.55),
        lambda system, y0: sympflow.escape_times(system, "verlet", (0, 100), y0, outside=5.0, dt=0.55),
        lambda system, y0: sympflow.frequencies(system, "verlet", (0, 100), y0, dt=0.55),
        lambda system, y0: solve(system, "verlet", (0, 100), y0, params={"k": [1.0, 1.1]}, dt=0.55),
    ],
)
def test_orbits_of_which_no_states_are_kept_are_doubted_too(run):
    system = H("p**2/2 + k*(q**2 - 1)**2/4", y0=[1.5, 0], params={"k": 1.0})
    with pytest.warns(RuntimeWarning, match=r"is too l.* for method .*: the energy of the run is off by"):
        run(system, np.array([[1.5, 0.0], [1.6, 0.0]]))


def test_orbits_that_leap_over_a_wall_by_the_default_step_are_told():
    system = H("p**2/2 + 4*(q**-12 - q**-6)", y0=[50, -10])
    with pytest.warns(RuntimeWarning, match=r"`system`: .* passed q1 = 0, where H is infinite"):
        sympflow.ensemble(system, "verlet", (0, 20), y0=[[50, -10], [40, -8]])
    assert solve(system, "verlet", (0, 20)).status == -1


@pytest.mark.parametrize("dt", [0.5, 3.0, 100.0])
def test_a_run_of_few_steps_that_are_far_too_long_is_told(dt):
    system = H("p**2/2 + q**2/2 + 0.3*q**4", y0=[1, 0])
    with pytest.warns(
        RuntimeWarning, match=f"`dt` {dt:g} is too long for method 'verlet': the energy of the run"
    ) as told:
        solve(system, "verlet", (0, 10), dt=dt)
    assert told[0].filename == __file__  # the line of the user


def test_a_time_that_is_no_time_of_the_system_is_told_before_outputs():
    """An electron in a trap of atomic size in SI units, 3e18 rad/s, over the 100 s of no `t_span`."""
    with pytest.raises(ValueError, match=r"^`t_span` \(0, 100\), the system's, is 6\.67e\+18 steps .*: pass a shorter"):
        solve(H("p**2/(2*m) + k*q**2/2", params={"m": 9.1e-31, "k": 10.0}, y0=[1e-10, 0]))


def test_a_close_encounter_is_no_matter_of_outputs():
    text = "(p1**2 + p2**2)/2 - 1/sqrt(q1**2 + q2**2)"
    with pytest.raises(ValueError, match=r"^`tol` 1e-06 needs .*, or 'log_kahan_li8' \(V falls without bound at q = 0"):
        solve(H(text, y0=[1, 0, 0, 1e-3]), "verlet", (0, 100), tol=1e-6)
    assert sympflow.max_energy_error(solve(H(text, y0=[1, 0, 0, 1e-3]), "log_kahan_li8", (0, 100), dt=0.05)) < 1e-6


@pytest.mark.parametrize(("method", "dt"), [("verlet", 0.21), ("verlet", 0.05), ("euler", 0.001)])
def test_a_warning_has_the_energy_error_of_the_run(method, dt):
    with pytest.warns(RuntimeWarning, match="the energy of the run is off by") as told:
        sol = solve(H("p**2/2 + 100*q**2", y0=[1, 0]), method, (0, 1.05), dt=dt)
    off = float(re.search(r"off by (\S+) %", str(told[0].message))[1]) / 100
    assert 0.9 < off / sympflow.max_energy_error(sol) < 1.1


def test_a_pole_of_what_is_not_separable_has_a_remedy_that_works():
    system = H("p1*q2 - p2*q1 + p1**2/2 + p2**2/2 + 1/q1", y0=[1, 0, 0, 1])
    sol = solve(system, "gauss_legendre6", (0, 10))
    assert sol.status == -1
    assert "such as 'dop853'" in sol.message
    assert "log_leapfrog" not in sol.message
    fine = solve(system, "dop853", (0, 10), rtol=1e-10, atol=1e-12)
    assert sympflow.max_energy_error(fine) < 1e-6

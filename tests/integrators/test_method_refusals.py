"""Arguments and systems that methods refuse, and what they say."""

from dataclasses import replace

import numpy as np
import torch
from conftest import refusals
from test_backends import AIRY, PLAIN
from test_counting import Declared
from test_driven_parts import LINEAR, POLAR, TERMS
from test_friction import COUPLED
from test_own_schemes import NOT_A_SCHEME, RUTH3
from test_planets import BENT, DEMOCRATIC, GIANTS

import sympflow
from sympflow import ClockedFit, HamiltonianSystem, Scheme, SympFlow, get, solve, splitting_method, systems
from sympflow.flow.clocked import ClockedFlow
from sympflow.interop.scipy import as_scipy

made = HamiltonianSystem.from_sympy
HH, KEPLER, PENDULUM, PRODUCT = (
    systems.henon_heiles(),
    systems.kepler(0.3),
    systems.pendulum(),
    systems.nonseparable(),
)
SPRING, DAMPED, OSCILLATOR = (
    systems.spring_pendulum(1e4, coordinates="polar"),
    systems.damped_pendulum(0.5),
    systems.damped_oscillator(),
)
RELATIVISTIC = made("sqrt(1 + p**2) - cos(q)", damping=0.1, y0=[1.0, 0.0])
PAIRED = made("(p**2 + 1)*(q**2 + 1)/2 + sin(q*p)", y0=[0.1, 0.2])
KEPT = SympFlow.primed(PENDULUM, 2)
Y = np.array([1.0, 0.5])
FRICTION, NOT_COMPILED = "has friction", "^`backend` 'compiled' does not apply"
NOT_KEPT = "has friction, .*conformal_defect"
followed = torch.tensor(HH.y0, requires_grad=True)


def run(system, method, **options):
    return lambda: solve(system, method, (0, 1), **options)


def of_damped(metric):
    return lambda: metric(solve(DAMPED, "verlet", (0, 2.0)))


test_options = refusals(
    (run(HH, "verlet", tol=0.0), r"^`tol` must be a positive number below 1, .*; got 0\.0"),
    (run(HH, "verlet", tol=1e-6, tol_of="q"), "^`tol_of` must be 'energy' or 'state'; got 'q'"),
    (lambda: sympflow.volume_error(run(HH, "adaptive_heun", rtol=1e-3, atol=1e-3)()), TypeError, "not a one-step map"),
    (run(HH, "rk45", tol=1e-6), TypeError, "^`tol` .* 'rk45' chooses its own: .*`rtol` and `atol`"),
    (run(HH, "verlet", tol=1e-6, dt=0.1), r"^`tol` chooses the step, but `dt` is given, 0\.1"),
    (lambda: solve(HH, "srkn11b", (0, 10), tol=1e-18), "^`tol` 1e-18 is not met .* rounding"),
    (run(HH, None, tolerance=1), TypeError, "^`tolerance` is not an option"),
    (run(HH, "verlet", max_step=0.1), TypeError, "^`max_step` is not an option of method 'verlet'.*`event_step` sam"),
    *(
        (
            run(HH, "verlet", **{name: 0.1}),
            TypeError,
            f"^`{name}` is not an option of .*'verlet'.*: the step .* is `dt`",
        )
        for name in ("h", "step", "step_size")
    ),
    (run(HH, Scheme("own", 1, (1.0,), (1.0,))), TypeError, r"^`method` must be .* got Scheme\. Make one of it by"),
    (run(HH, "rk45", backend="compiled"), "^`backend` 'compiled' does not apply to method 'rk45'"),
    (run(HH, "verlet", backend="compiled", dtype="float32"), f"{NOT_COMPILED}. `y0` is float32"),
    (run(PLAIN, "verlet", backend="compiled"), r"^`backend` .* functions could not be traced: numpy\.median"),
    (run(AIRY, "verlet", backend="compiled"), NOT_COMPILED),
    (run(PLAIN, "verlet", compensated=True), "^`compensated` sums need compiled loops"),
    (run(HH, "verlet", backend="array", compensated=True), "^`compensated` sums need compiled loops"),
    (run(HH, "rk45", y0=followed), TypeError, "^`y0` is a tensor, but method 'rk45' is SciPy's and runs on NumPy"),
    (run(KEPLER, "log_kahan_li8", y0=torch.tensor(KEPLER.y0)), TypeError, r"by root-finding .*: pass y0\.numpy\(\)"),
    (lambda: Declared().tangent(HH, 0.0, HH.y0, np.array(0.1)), TypeError, "so its step cannot be differentiated"),
)

test_triples = refusals(
    (run(KEPLER, "kahan_li8", splitting="linear", clock="logarithmic"), "^`clock` .* needs the splitting"),
    (run(KEPLER, "kahan_li8", splitting="linear"), "^`system` 'kepler' has no"),
    (run(KEPLER, "kahan_li8", splitting="oblique"), "^`splitting` must be one of 'kinetic', .*; got 'obl"),
    (run(KEPLER, "kahan_li8", clock=["physical"]), r"^`clock` must be one of .*; got \['physical'\]"),
    (run(KEPLER, "kahan_li8", shift=1.0), "^`shift` is for the clock 'logarithmic'"),
    (run(KEPLER, "kahan_li8", parts=["p**2/2"]), "^`parts` is for the splitting 'parts'"),
    (run(KEPLER, "kahan_li8", splitting="parts", compensated=True), "^`compensated` sums are for the spl"),
    (run(SPRING, "blanes_moan4", splitting="parts"), "^`splitting` 'parts' composes .* is not made"),
    (run(SPRING, "strang_parts", parts=("p1**2/2", "p2**2")), "do not add up to the Hamiltonian"),
    (
        run(SPRING, "strang_parts", parts=("p1**2/2 + k*(q1 - 1)**2/2 - g*q1*cos(q2)", "p2**2/(2*q1**2)")),
        "is not solved exactly",
    ),
    (run(PAIRED, "strang_parts", dt=0.1), "does not split into parts"),
    (lambda: get("strang_parts")(parts="q**2"), TypeError, "^`parts` must be a sequence of expressions"),
    (run(PRODUCT, "tao4", omega=0.0), "`omega` must be positive"),
    (run(PENDULUM, "verlet", omega=1.0), "`omega` is for the splitting 'copies'"),
    (run(PRODUCT, get("srkn6b")(splitting="copies")), "composes Strang steps"),
    (lambda: as_scipy("tao4", PRODUCT), TypeError, "keeps the second copy of phase space"),
    (lambda: get("tao4")(dt=0.1).inverse(PRODUCT, 0.0, Y, 0.1), TypeError, "cannot be undone"),
    (run(HH, "log_leapfrog", y0=[0.9, -0.4, 0, 0], shift=0.1), "^`shift` 0.1 does not exceed the potential"),
    (run(made("(p**2+1)*(q**2+1)", y0=[0, 1]), "log_leapfrog"), "so its logarithmic Hamiltonian is not"),
    (run(HH, "log_leapfrog", y0=[0.0, -2e154, 0.0, 0.0]), "^`y0` has the energy inf: give a state of a"),
    (lambda: ClockedFlow(3, "chin4a"), "^`scheme` 'chin4a' is not a symmetric one without force gradients"),
    (lambda: ClockedFlow(2, system=KEPLER), "^`system` is not a logarithmic Hamiltonian"),
    (lambda: ClockedFlow(3, terms=0), "^`terms` must be a positive integer"),
    (
        lambda: sympflow.train(made("p**2/2 - 1/sqrt(1 + q**2)", name="plain"), ClockedFit(0.1)),
        "^`domain` is not known for the system 'plain'",
    ),
    (lambda: splitting_method(replace(RUTH3, drifts=(2 / 3, -2 / 3, 0.9))), r"has drifts that add up to 0\.9"),
    (lambda: splitting_method(replace(RUTH3, kicks=(0.5, 0.5, np.nan))), "must have finite coefficients"),
    (lambda: splitting_method(replace(RUTH3, order=0)), "a positive integer or None as `order`"),
    (lambda: splitting_method(replace(RUTH3, name="verlet")), "^`name` 'verlet' is a built-in method of an"),
    (lambda: splitting_method("nonsense"), "^`scheme` 'nonsense' is unknown: choose one of "),
    (
        lambda: splitting_method(NOT_A_SCHEME),
        TypeError,
        "^`scheme` must be a sympflow.Scheme or the name of one; got int",
    ),
    (lambda: splitting_method(RUTH3, "oblique"), "^`splitting` must be one of 'kinetic'"),
    (lambda: splitting_method(RUTH3, "kinetic", "proper"), "^`clock` must be one of 'physical'"),
    (lambda: Scheme("bad", 2, (0.5, 0.5), (1.0,), (0.0, 0.0), ""), "one coefficient per stage"),
)

test_planets = refusals(
    (run(HH, "wisdom_holman"), "`method` 'wisdom_holman' is for planets about a star"),
    (run(systems.three_body(), "kepler_aba864"), "is for planets about a star"),
    (run(GIANTS, "wisdom_holman", corrector=4), "`corrector` must be an order"),
    (run(GIANTS, "kepler_aba864", corrector=17), "`corrector` goes with the steps of 'wisdom_holman'"),
    (run(GIANTS, "leapfrog", corrector=17), "`corrector` is for the splitting 'kepler'"),
    (run(GIANTS, "impulse", compensated=True), "`compensated` sums are for the splittings 'kinetic' and"),
    (run(DEMOCRATIC, BENT), "which the interaction has in Jacobi's coordinates only"),
    (lambda: sympflow.elements(GIANTS.y0), TypeError, "`system` must be given"),
    (lambda: sympflow.elements(GIANTS.y0[:7], GIANTS), "`solution` must be a Solution, or states"),
    (lambda: sympflow.elements(GIANTS.y0, GIANTS, about="sun"), "`about` must be"),
    (lambda: sympflow.elements(np.ones(4), HH), "^`system` .* no planets about"),
    (lambda: sympflow.momentum(np.ones(4), HH), "has no bodies"),
    (lambda: sympflow.states_of_elements({"a": [1.0]}, GIANTS), "`elements` must have a, e"),
    *(
        (lambda names=names: systems.solar_system(names), "`planets` must be")
        for names in (0, 9, "Mars", ("Mars", "Mars"), ("Pluto",), True)
    ),
)

test_driven_and_damped = refusals(
    (run(made("p**2/2 + q**2*cos(t)/2", time="t", y0=[1, 0]), "impulse"), "do not depend on t"),
    (lambda: made("p**2*cos(t) + q**2/2", time="t").linear_part, "do not depend on t"),
    (run(POLAR, "strang_parts", parts=TERMS[1:]), "^`parts` do not add up"),
    (run(LINEAR, "log_kahan_li8"), "'log_kahan_li8' does not take the time"),
    (lambda: SympFlow.split(LINEAR), "is driven, H depends on t, which primed flows take"),
    *(
        (run(DAMPED, name), "^`system` 'damped_pendulum' has friction, .* use a splitting method")
        for name in sympflow.available()
        if not get(name)().takes_friction
    ),
    *(
        (of_damped(metric), NOT_KEPT)
        for metric in (
            *(sympflow.energy_error, sympflow.max_energy_error, sympflow.energy_drift, sympflow.volume_error),
            *(sympflow.symplecticity_defect, sympflow.loop_area_error, sympflow.Solution.energy_error),
        )
    ),
    (lambda: sympflow.conformal_defect(solve(COUPLED, "verlet", (0, 1.0), dt=0.1, backend="array")), "different rates"),
    (run(COUPLED, "gauss_legendre4", dt=0.2, backend="compiled"), "is a matrix"),
    (lambda: SympFlow.split(OSCILLATOR, 0.5), FRICTION),
    (run(DAMPED, "sympflow", flow=KEPT), FRICTION),
    (lambda: sympflow.time_transformed(DAMPED), FRICTION),
    (lambda: OSCILLATOR.linear_part, FRICTION),
    (lambda: sympflow.stability(DAMPED, ["verlet"]), FRICTION),
    (lambda: sympflow.compare(DAMPED, ["verlet"], ["volume"]), FRICTION),
    (lambda: get("verlet")(splitting="copies").step(DAMPED, 0.0, Y, 0.1), FRICTION),
    (lambda: get("strang_parts")().step(OSCILLATOR, 0.0, Y, 0.1), FRICTION),
    (lambda: get("log_leapfrog")().step(DAMPED, 0.0, Y, 0.1), FRICTION),
    (run(DAMPED, "verlet", compensated=True), "^`compensated`"),
    (run(RELATIVISTIC, "verlet"), "kinetic energy is ½ pᵀM⁻¹p"),
)

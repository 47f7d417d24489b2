"""A flow from trajectories: shooting recovers H to rounding, to what the noise allows, and says what it did."""

from dataclasses import replace

import numpy as np
import pytest
import sympy
from conftest import refusals
from scipy.integrate import solve_ivp

import sympflow
from sympflow.learning.families import FAMILIES, Candidate, pruned
from sympflow.learning.fitting import Setting, fitted, judged, left_out, restored
from sympflow.learning.inertia import Inertia
from sympflow.learning.learner import constraints_of
from sympflow.learning.library import Library, Terms
from sympflow.learning.models import Model, drags, friction
from sympflow.learning.orbits import Gauss, Method, first_states
from sympflow.learning.parts import Distances, Drive, Fixed, Network, Polynomial, Waves, kinetic, known_kinetic
from sympflow.learning.search import Replicas, Search, replica, without_growth
from sympflow.learning.shooting import Problem, chosen_method, matched, minimized
from sympflow.learning.trajectories import Trajectories
from sympflow.training import checkpoint as checkpoints
from sympflow.training.session import Session

MASS, STIFF, QUARTIC, RATE = 2.0, 1.5, 0.7, 0.2


def trajectories(n, points, rate=0.0, noise=0.0, span=2.0, seed=0):
    """Trajectories of H = p²/4 + 0.75 q² + 0.175 q⁴ at irregular times, with friction."""
    rng = np.random.default_rng(seed)

    def field(t, y):
        return [y[1] / MASS, -STIFF * y[0] - QUARTIC * y[0] ** 3 - rate * y[1]]

    runs = []
    for _ in range(n):
        t = np.sort(rng.uniform(0, span, points))
        y = solve_ivp(field, (0, span), rng.uniform(-1, 1, 2), t_eval=t, rtol=1e-12, atol=1e-13).y
        runs.append((t, y + noise * rng.standard_normal(y.shape)))
    return runs


def quartic(data, force=None):
    q, p = data.scales
    return Model(1, (kinetic([p]), Polynomial.up_to(4, "q", [q])), force)


def problem(model, data, sigma, **options):
    theta = matched(model, model.start(np.random.default_rng(0)), data, 1 / data.scales)
    return theta, Problem(model, data, chosen_method(model, theta, data, 1e-12 * data.scales), sigma, **options)


# shooting -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("rate", "missing"), [(0.0, 0.0), (RATE, 0.0), (0.0, 0.1)], ids=["H", "friction", "gaps"])
def test_shooting_finds_h_and_friction_to_rounding_where_numbers_are_missing_too(rate, missing):
    runs = trajectories(8, 15, rate)
    rng = np.random.default_rng(1)
    for _, y in runs:
        y[rng.random(y.shape) < missing] = np.nan
    data = Trajectories.read(runs)
    model = quartic(data, friction if rate else None)
    theta, fit = problem(model, data, 1e-9 * data.scales)
    found = minimized(fit, theta, first_states(data))
    kinetic, potential = model.parts
    assert kinetic.coefficients(found.theta[:1]) == pytest.approx([1 / (2 * MASS)], abs=1e-10 if missing else 1e-11)
    assert potential.coefficients(found.theta[1:5]) == pytest.approx(
        [0, STIFF / 2, 0, QUARTIC / 4], abs=1e-9 if missing else 1e-10
    )
    assert found.theta[5:] == pytest.approx([RATE] if rate else [], abs=1e-9)


@pytest.mark.parametrize(
    ("force", "driven"),
    [
        (None, False),
        (friction, False),
        (drags, False),
        (None, True),
        pytest.param(friction, True, marks=pytest.mark.slow),
    ],
)
def test_derivatives_are_those_of_the_orbits(force, driven):
    """A splitting scheme and collocation, by the initial state and by θ, against differences."""
    data = Trajectories.read(trajectories(4, 10))
    model = quartic(data, force)
    if driven:
        model = replace(model, parts=(*model.parts, Drive(Polynomial.up_to(2, "q", [1.0]), 1.3)))
    theta, problem_ = problem(model, data, data.scales)
    theta = theta + 0.05
    batch, states = problem_.batches[0], first_states(data)
    *_, (_, _, X) = problem_._orbits(batch, theta, states, True)

    def end(theta, states):
        *_, (_, x, _) = problem_._orbits(batch, theta, states, False)
        return x

    h = 1e-6
    for i in range(2):
        e = h * np.eye(2)[i]
        assert (end(theta, states + e) - end(theta, states - e)) / (2 * h) == pytest.approx(X[:, i], abs=1e-7)
    for i in range(model.n):
        e = h * np.eye(model.n)[i]
        assert (end(theta + e, states) - end(theta - e, states)) / (2 * h) == pytest.approx(X[:, 2 + i], abs=1e-7)


def test_collocation_is_symplectic():
    model = Model(1, (Polynomial("y", [[2, 0], [0, 2], [2, 2]], [1.0, 1.0]),))
    x, X = np.array([[0.3], [0.8]]), np.eye(2)[..., None]
    _, X = Method(Gauss(3), 0.5).over(model, np.array([0.5, 0.5, 0.4]), x, X, np.array([2.0]), np.zeros(1))
    A, J = X[..., 0], np.array([[0.0, 1.0], [-1.0, 0.0]])
    assert pytest.approx(J, abs=1e-12) == A.T @ J @ A
    exact, tolerance = Method(Gauss(3), 0.5), np.full(2, 1e-3)
    rough = Method(Gauss(3).within(tolerance), 0.5)
    theta, zero = np.array([0.5, 0.5, 0.4]), np.zeros(1)
    ends = [method.over(model, theta, x.copy(), None, zero + 2, zero)[0] for method in (exact, rough)]
    assert 0 < np.abs(ends[1] - ends[0]).max() < 1e-3 * tolerance.max()
    assert rough.stepper == exact.stepper  # by which a checkpoint finds it


def test_noise_and_standard_errors_are_those_of_the_data():
    """Over 6 samples of noise the errors of θ have the size that the covariance tells; σ is found to 5 %."""
    deviations, sigmas = [], []
    for seed in range(6):
        data = Trajectories.read(trajectories(8, 15, noise=0.02, seed=seed))
        model = Model(1, (known_kinetic(np.array([[1 / MASS]])), Polynomial("q", [[2], [4]], [1.0])))
        theta, fit = problem(model, data, np.full(2, 0.02))
        found = minimized(fit, theta, first_states(data))
        deviations.append((found.theta - [STIFF / 2, QUARTIC / 4]) / np.sqrt(np.diag(found.covariance())))
        sigmas.append(found.noise())
    assert 0.6 < np.std(deviations) < 1.5  # of 12 draws of a normal distribution
    assert np.mean(sigmas) == pytest.approx(0.02, rel=0.05)


Q = sympy.symbols("q1:3", real=True)
PARTS = [
    Polynomial.up_to(3, "q", [1.3, 0.9]),
    Waves.up_to(2, 2, "q", np.array([1.3, 0.9]), np.array([2 * np.pi, np.inf])),
    Network("q", 4, [1.0, 2.0], np.array([4.0, np.inf])),
    Distances.between(np.array([[0], [1]]), (-2, 0, 1), 1.3),
    Distances(np.array([[0, 1]]), [(0, None, -1), (0, None, 0), (0, None, 3)], 1.3),
    Inertia(Waves.up_to(1, 1, "q", np.ones(1), np.array([2 * np.pi]), constant=True)),
    Fixed(Terms(Library([sympy.sin(Q[0]) * Q[1] ** 2], 2), "q"), np.ones(1)),
    kinetic([1.3, 0.9]),
    Terms(Library([Q[0] ** 2 * Q[1], sympy.cos(Q[0] - Q[1]), 1 / Q[1]], 2), "q"),
    Terms(Library([Q[0] ** 2, Q[0] * Q[1]], 2), "q"),
]


@pytest.mark.parametrize("part", PARTS, ids=lambda part: type(part).__name__)
def test_parts_of_h_are_what_their_derivatives_say(part):
    """By differences at three states; the expression is the value but for a constant."""
    rng = np.random.default_rng(0)
    x, theta, h = rng.normal(size=(2, 3)) + np.array([[0], [3]]), rng.normal(size=part.n), 1e-6
    found = part.gradient(theta, x, True, True)
    for i, e in enumerate(h * np.eye(2)[:, :, None]):
        assert (part.value(theta, x + e) - part.value(theta, x - e)) / (2 * h) == pytest.approx(
            found.value[i], abs=1e-6
        )
        ahead, behind = (part.gradient(theta, x + s * e, False, False).value for s in (1, -1))
        assert (ahead - behind) / (2 * h) == pytest.approx(np.broadcast_to(found.slope[:, i], (2, 3)), abs=1e-6)
    for i, e in enumerate(h * np.eye(part.n)):
        ahead, behind = (part.gradient(theta + s * e, x, False, False).value for s in (1, -1))
        assert (ahead - behind) / (2 * h) == pytest.approx(found.by_parameters[:, i], abs=1e-6)
    formula = part.expression(theta, Q)
    values = [float(formula.subs(dict(zip(Q, column, strict=True)))) for column in x.T]
    assert np.ptp(values - part.value(theta, x)) < 1e-12


KEPLER = (lambda r: -2 / r**2, lambda r: -2 / r)
LOGARITHM = (lambda r: -1 / r - r, lambda r: np.log(r) + r**2 / 2)


@pytest.mark.parametrize(
    ("force", "V", "observed"),
    [
        (*KEPLER, "qp"),
        pytest.param(*KEPLER, "qv", marks=pytest.mark.slow),
        pytest.param(*KEPLER, "q", marks=pytest.mark.slow),
        pytest.param(*LOGARITHM, "qp", marks=pytest.mark.slow),
        pytest.param(*LOGARITHM, "qv", marks=pytest.mark.slow),
        pytest.param(*LOGARITHM, "q", marks=pytest.mark.slow),
    ],
)
def test_central_fields_are_found(force, V, observed):
    """To 1 % of its spread along the orbits, of a noise of 1e-3."""
    rng, t = np.random.default_rng(0), np.linspace(0, 8, 41 if observed == "qp" else 81)

    def field(_, y):
        r = np.hypot(*y[:2])
        return [*y[2:], *(force(r) * y[:2] / r)]

    starts = [[1.0 + 0.1 * k, 0.0, 0.1 * k - 0.2, 1.1 + 0.03 * k] for k in range(8)]
    orbits = [solve_ivp(field, (0, 8), y0, t_eval=t, rtol=1e-9, atol=1e-10).y for y0 in starts]
    rows = [0, 1] if observed == "q" else [0, 1, 2, 3]
    runs = [(t, y[rows] + 1e-3 * rng.normal(size=(len(rows), len(t)))) for y in orbits]
    data = Trajectories.read(runs, observed=observed)
    constraints = constraints_of(data, None, None, False, None, None)
    candidates = [*FAMILIES["central"].models(constraints)][: 1 if observed == "qp" and force is KEPLER[0] else None]
    found = [fitted(candidate.model, data, Setting()) for candidate in candidates]
    best = min(found, key=lambda one: one.loss(np.full(4, 1e-3)))
    y = np.concatenate(orbits, axis=1)
    H = (y[2:] ** 2).sum(0) / 2 + V(np.hypot(*y[:2]))
    learned = best.model.hamiltonian(best.theta, y)
    assert np.ptp(learned - H) < 0.01 * np.ptp(H)


# learn ----------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def noisy():
    return sympflow.learn(trajectories(8, 15, noise=0.01), dt=0.5, family="polynomial")


def test_a_learned_flow_brings_its_system(noisy, tmp_path):
    noisy.save(tmp_path / "flow.safetensors")
    flow = sympflow.load(tmp_path / "flow.safetensors")
    y = np.array([0.2, 0.3])
    assert flow.system.hamiltonian(y) == pytest.approx(noisy.system.hamiltonian(y), rel=1e-12)
    assert flow.figures == noisy.figures


def test_the_command_reports_what_was_learned(noisy, tmp_path, monkeypatch):
    """From a table in milliseconds to a file, a report and a figure; the fit itself is that of the fixture."""
    from typer.testing import CliRunner

    from sympflow.commands import app

    asked = {}

    def learned(data, **options):
        y = data.runs[0].y
        asked.update(options, span=data.runs[0].span, velocities=data.velocities, missing=np.isnan(y[1]).all())
        return noisy

    monkeypatch.setattr("sympflow.learning.learner.learn", learned)
    rows = ["orbit,t,q,p"]
    for i, (t, y) in enumerate(trajectories(3, 6)):
        rows += [f"{i},{1000 * a},{q},{p}" for a, q, p in zip(t, *y, strict=True)]
    (tmp_path / "data.csv").write_text("\n".join(rows))
    to, plot = tmp_path / "flow.safetensors", tmp_path / "report.png"
    known = ["--mass", "2.5", "--known", "pendulum", "--family", "polynomial", "--drive", "1.5"]
    arguments = ["learn", str(tmp_path / "data.csv"), "--unit", "t=ms", "--out", str(to)]
    found = CliRunner().invoke(app, [*arguments, "--damping", "--separable", *known, "--plot", str(plot)])
    assert found.exit_code == 0, found.output
    assert "3 trajectories, 18 points" in found.output
    assert "noise = 0.0" in found.output
    assert asked["damping"] is True
    assert (asked["separable"], asked["mass"], asked["drive"], asked["family"]) == (True, 2.5, 1.5, "polynomial")
    assert asked["known"].name == "pendulum"
    assert asked["span"] < 2.0  # seconds
    assert sympflow.load(to).figures == noisy.figures
    assert plot.stat().st_size > 10_000
    assert CliRunner().invoke(app, [*arguments, "--mass", "1,2", "--not-separable"]).exit_code == 0
    assert (asked["separable"], asked["mass"]) == (False, [1.0, 2.0])
    for option, message in (
        ("--mass", "`--mass` must be a number, or numbers with commas"),
        ("--known", "`--known` 'nonsense' is unknown"),
        ("--drive", "`--drive` must be an angular frequency, or find"),
    ):
        found = CliRunner().invoke(app, [*arguments, option, "nonsense"])
        assert found.exit_code == 2
        assert message in " ".join(found.output.split())


RELATIVISTIC = sympflow.HamiltonianSystem.from_sympy("sqrt(1 + p**2) + 0*q")
HUGE, STILL = ([(t, factor * y) for t, y in trajectories(4, 12)] for factor in (1e80, np.array([[1], [0]])))

test_data_that_tell_no_h = refusals(
    (lambda: sympflow.learn(HUGE), r"^`trajectories` have q1 up to .*give `units`"),
    (lambda: sympflow.discover(HUGE), r"^`trajectories` have q1 up to .*give `units`"),
    (lambda: sympflow.learn(STILL), "the same p1 at all points"),
    (lambda: sympflow.learn(trajectories(1, 6)), "one trajectory only"),
    (lambda: sympflow.learn(trajectories(2, 2)), "fewer than the simplest model"),
    (lambda: Trajectories.read([(t, y > 0) for t, y in trajectories(4, 12)]), TypeError, "booleans"),
)


def test_a_coordinate_far_from_zero_is_told():
    with pytest.warns(UserWarning, match="q1 about 1e.06, .* subtract that"):
        Trajectories.read([(t, y + np.array([[1e6], [0]])) for t, y in trajectories(4, 12)]).check_moving()


LEARN, DISCOVER, BOTH = (sympflow.learn,), (sympflow.discover,), (sympflow.learn, sympflow.discover)
REFUSED = [
    (BOTH, {"ndof": "1"}, "`ndof` must be a positive integer"),
    (BOTH, {"ndof": 1.5}, "`ndof` must be a positive integer"),
    (BOTH, {"ndof": True}, "`ndof` must be a positive integer"),
    (BOTH, {"noise": "a"}, "`noise` must be made of real numbers"),
    (BOTH, {"noise": np.nan}, "`noise` must be a standard deviation"),
    (BOTH, {"noise": -1.0}, "`noise`"),
    (BOTH, {"loss": "absolute"}, "`loss` must be one of squares, huber"),
    (BOTH, {"seed": -1}, "`seed` must be an integer"),
    (LEARN, {"seed": "x"}, "`seed` must be an integer"),
    (LEARN, {"family": "unknown"}, "`family`"),
    (LEARN, {"damping": 0.1}, "`damping`"),
    (LEARN, {"damping": [1]}, "`damping`"),
    (LEARN, {"drive": -1.0}, "`drive`"),
    (LEARN, {"drive": [1.0, 0.0]}, "`drive`"),
    (LEARN, {"drive": np.nan}, "`drive`"),
    (LEARN, {"drive": 1.0, "separable": False}, "`drive`"),
    (LEARN, {"drive": True, "damping": "quadratic"}, "`drive` .* not beside drag"),
    (LEARN, {"drive": np.float32(1.0), "known": RELATIVISTIC}, "`drive` .* `known`"),
    (LEARN, {"mass": 1.0, "separable": False}, "`mass`"),
    (LEARN, {"dt": -1.0}, "`dt`"),
    (LEARN, {"replicas": 1}, "`replicas`"),
    (DISCOVER, {"terms": 3}, "`terms`"),
    (DISCOVER, {"terms": []}, "`terms` is an empty list: name terms, or some of polynomials, "),
    (DISCOVER, {"terms": ["x**2"]}, r"`terms` has 'x\*\*2': `expression` holds x"),
    (DISCOVER, {"terms": ["q2"]}, r"`terms` has 'q2', which holds q2: write it in q1 … q1"),
    (DISCOVER, {"terms": ["3"]}, "`terms` .* is a constant"),
    (DISCOVER, {"terms": ["sqrt(q - 100)"]}, "`terms` .* not finite at the data"),
    (DISCOVER, {"held_out": "x"}, "`held_out` must be"),
    (DISCOVER, {"held_out": 1.0}, "`held_out` must be"),
    (DISCOVER, {"piece": "x"}, "`piece` must be"),
    (DISCOVER, {"piece": 0.0}, "`piece` must be"),
    (DISCOVER, {"progress": 3}, "`progress`"),
    (DISCOVER, {"degree": 100}, "`degree` must be an integer"),
    (DISCOVER, {"degree": 1.5}, "`degree` must be an integer"),
    (DISCOVER, {"most_terms": 0}, "`most_terms` must be an integer"),
    (DISCOVER, {"degree": 14}, "`data` has 96 values, 88 beside the initial states, and the library"),
]


@pytest.mark.parametrize(("make", "options", "match"), [(make, *rest) for makes, *rest in REFUSED for make in makes])
def test_what_cannot_be_learned_is_refused(make, options, match):
    of_another_type = options in ({"noise": "a"}, {"terms": 3}, {"progress": 3})
    with pytest.raises(TypeError if of_another_type else ValueError, match=f"^{match}"):
        make(trajectories(4, 12), **options)


def test_a_killed_run_goes_on_from_its_checkpoint(tmp_path):
    """The callback ends the run after two models; the second run fits these no more, and finds the same."""
    runs, path = trajectories(6, 12, noise=0.01), tmp_path / "run"
    seen = []

    def interrupt(step, figures):
        seen.append(step)
        if step == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sympflow.learn(runs, dt=0.5, family="polynomial", checkpoint=path, callback=interrupt)
    data = Trajectories.read(runs)
    search = Search(data, data.folds(0.2, 0), constraints_of(data, None, None, False, None, None), Setting(), 0)
    with pytest.raises(ValueError, match="`resume` is a run with another"):
        sympflow.learn(trajectories(6, 12, noise=0.02), dt=0.5, family="polynomial", resume=path)
    state = checkpoints.read(path)
    assert state["step"] == 2
    name, numbers = next(iter(state["optimizer"].items()))
    (candidate,) = [c for c in FAMILIES["polynomial"].models(search.constraints) if c.name == name]
    again = restored(candidate.model, search.data, numbers, Setting())
    assert np.array_equal(again.theta, numbers["theta"].numpy())
    assert again.sigma == pytest.approx(fitted(candidate.model, search.data, Setting()).sigma)


T = np.linspace(0, 10, 51)
CLOCKS = {
    "drive": (lambda t, q, p: [p, -q - q**3 + 0.3 * np.cos(1.7 * t)], r"drive=1\.(69|70)", {"drive": True}),
    "stiffness": (lambda t, q, p: [p, -(1 + 0.3 * np.cos(2.3 * t)) * q], r"drive=2\.(29|30)", {"drive": 2.3}),
    "two drives": (
        lambda t, q, p: [p, -q + 0.3 * np.cos(1.7 * t) + 0.2 * np.sin(2.9 * t)],
        r"drive=\[1\.(69|70)\d*, 2\.(89|90)",
        {"drive": True},
    ),
    "drag": (lambda t, q, p: [p, -q - q**3 - 0.3 * abs(p) * p], 'damping="quadratic"', {"damping": "quadratic"}),
}


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("stiffness", "two drives")]


@pytest.fixture(scope="module", params=["drive", *SLOW, "drag"])
def forced(request):
    """Noisy trajectories of what no H(q, p) explains, with the remedy that a warning names."""
    field, remedy, options = CLOCKS[request.param]
    rng = np.random.default_rng(0)
    y = [
        solve_ivp(lambda t, y: field(t, *y), (0, 10), start, t_eval=T, rtol=1e-9, atol=1e-10).y
        for start in rng.uniform(-1, 1, (8, 2))
    ]
    return np.array(y), Trajectories.read((T, y + 0.005 * rng.normal(size=np.shape(y)))), remedy, options


def test_drives_and_drag_are_named_with_the_remedy(forced):
    _, data, remedy, _ = forced
    search = Search(data, [data.split(0.2, 0)], constraints_of(data, None, None, False, None, None), Setting(), 0)
    search.run(["polynomial"], Session())
    with pytest.warns(UserWarning, match=f"pass {remedy}|Pass {remedy}"):
        search.diagnose(Session())


def test_drives_and_drag_are_learned(forced, tmp_path):
    """The orbits of what was learned, and is read from a file, are those without noise, to a part of it."""
    y, data, _, options = forced
    flow = sympflow.learn(data, family="polynomial", time_budget=None, dt=0.25, **options)
    assert flow.figures["noise"] == pytest.approx(0.005, rel=0.1)
    flow.save(tmp_path / "flow.safetensors")
    flow = sympflow.load(tmp_path / "flow.safetensors")
    starts = flow.system.lift(y[:, :, 0]) if "damping" in options else y[:, :, 0]
    made = sympflow.solve(flow.system, flow, (0, 5), starts, t_eval=T[:26]).y
    made = made[:, [0, 3]] if "damping" in options else made
    assert np.abs(made - y[:, :, :26]).max() < 0.01


def test_replicas_tell_how_certain_a_prediction_is():
    data = Trajectories.read(trajectories(8, 15, noise=0.02))
    model = Model(1, (known_kinetic(np.array([[1 / MASS]])), Polynomial("q", [[2], [4]], [1.0])))
    found = fitted(model, data, Setting())
    thetas = np.stack([replica((model, data, Setting(), found.theta, 0), k) for k in range(6)])
    replicas = Replicas(model, found.method, found.theta, thetas, 8)
    low, high = replicas.bands([0.5, 0.0], np.linspace(0, 4, 5))
    with pytest.raises(ValueError, match="`y0` must be one finite state"):
        replicas.bands([[0.5, 0.0], [0.1, 0.0]], [0, 1])
    assert (low[:, 0] == high[:, 0]).all()
    assert 0 < (high - low)[0, -1] < 0.1
    theta = found.theta
    assert np.std(thetas, axis=0) == pytest.approx(np.sqrt(np.diag(found.fit.covariance())), rel=0.9)
    assert np.abs(thetas.mean(0) - theta).max() < 0.05


def test_friction_below_0_is_0_and_one_that_is_no_chance_is_told():
    growing = Trajectories.read(trajectories(8, 15, rate=-RATE, noise=0.01))
    with pytest.warns(UserWarning, match=r"`damping` is -0.2.* by the data, whose energy grows: it is taken as 0"):
        found = without_growth(fitted(quartic(growing, friction), growing, Setting()))
    assert found.theta[-1] == 0
    rest = Trajectories.read(trajectories(8, 15, noise=0.01))
    fit = fitted(quartic(rest, friction), rest, Setting())
    shifted = replace(fit, theta=fit.theta - [*np.zeros(len(fit.theta) - 1), fit.theta[-1] + 1e-4])
    conservative = [*fitted(quartic(rest), rest, Setting()).theta, 0.0]
    np.testing.assert_allclose(without_growth(shifted).theta, conservative, rtol=0.02, atol=0.02)


def test_chaotic_trajectories_are_followed_in_pieces():
    """Hénon–Heiles at an energy of 0.16, over ten times 1/λ: errors grow by e^10, but not in pieces."""
    system = sympflow.systems.henon_heiles()
    y0 = np.array([[0.0, 0.1, 0.549, 0.0], [0.0, -0.1, 0.52, 0.15]])
    t = np.linspace(0, 100, 251)
    y = sympflow.solve(system, "kahan_li8", (0, 100), y0, t_eval=t, dt=0.05).y
    data = Trajectories.read((t, y + 5e-3 * np.random.default_rng(0).normal(size=y.shape)))
    model = Model(2, (known_kinetic(np.eye(2)), Polynomial("q", [[2, 0], [0, 2], [2, 1], [0, 3]], [1.0, 1.0])))
    found = fitted(model, data, Setting())
    assert 5 < found.span < 50
    errors = np.sqrt(np.diag(found.fit.covariance()))
    assert (np.abs(found.theta - [0.5, 0.5, 1.0, -1 / 3]) < np.minimum(4 * errors, 0.02)).all()
    assert found.sigma == pytest.approx(np.full(4, 5e-3), rel=0.15)


@pytest.mark.parametrize(
    ("n", "span", "points", "held_out"),
    [(100, 2, 11, range(1, 40)), pytest.param(1, 60, 961, [3], marks=pytest.mark.slow)],
    ids=["many", "one"],
)
def test_a_part_of_many_numbers_or_pieces_of_one_run_choose_the_model(monkeypatch, n, span, points, held_out):
    """For H = p²/2 + q²/2 + q⁴/4, all numbers being fitted in the end: to less than 1e-3, the noise of one of them."""
    monkeypatch.setattr("sympflow.learning.learner.MOST_VALUES", 600 if n > 1 else 40_000)
    rng, t = np.random.default_rng(0), np.linspace(0, span, points)
    y0 = rng.uniform(-1, 1, (n, 2)) if n > 1 else np.array([[1.0, 0.0]])
    y = sympflow.solve("p**2/2 + q**2/2 + q**4/4", "kahan_li8", (0, span), y0, dt=0.05, t_eval=t).y
    flow = sympflow.learn((t, y + 1e-3 * rng.normal(size=y.shape)), family="polynomial", time_budget=None, dt=0.25)
    H = sympy.Poly(flow.system.symbols.H, *flow.system.symbols.q, *flow.system.symbols.p)
    found = [float(H.coeff_monomial(powers)) for powers in ((0, 2), (2, 0), (4, 0))]
    assert found == pytest.approx([0.5, 0.5, 0.25], abs=1e-3)
    assert flow.figures["held_out_trajectories"] in held_out


def test_outliers_count_less_by_hubers_loss():
    runs = trajectories(8, 15, noise=0.01)
    for _, y in runs:
        y[1, 7] += 1.0
    data = Trajectories.read(runs)
    errors = []
    for huber in (None, 1.5):
        theta, fit = problem(quartic(data), data, np.full(2, 0.01), huber=huber)
        found = minimized(fit, theta, first_states(data))
        (coefficient,) = quartic(data).parts[0].coefficients(found.theta[:1])
        errors.append(abs(coefficient - 1 / (2 * MASS)) / coefficient)
        deviation = np.sqrt(found.covariance()[0, 0]) / found.theta[0]
    assert errors[1] < 3 * deviation < errors[0]


def test_data_of_no_hamiltonian_are_called_so():
    """A damped oscillator, without a word of friction: the areas shrink at its rate."""
    data = Trajectories.read(trajectories(8, 15, rate=RATE))
    search = Search(data, [data.split(0.2, 0)], constraints_of(data, None, None, False, None, None), Setting(), 0)
    search.run(["polynomial"], Session())
    with pytest.warns(UserWarning, match=r"No symplectic map explains.*rate of -0\.2") as record:
        search.diagnose(Session())
    (freedom,) = search.tested
    assert freedom.share < 1e-3
    assert 0.05 < freedom.defect < 0.2  # of L the friction is a fifth of the frequency, about 1, in one entry of four
    assert "damping" in str(record[0].message)


@pytest.mark.slow
def test_bands_cover_the_truth_as_often_as_they_say():
    """For 20 sets of nine trajectories; quantiles of 20 replicas covered 82 % in place of 90."""
    times = np.linspace(0, 4, 5)
    field = lambda t, y: [y[1] / MASS, -STIFF * y[0] - QUARTIC * y[0] ** 3]  # noqa: E731
    true = solve_ivp(field, (0, 4), [0.5, 0.0], t_eval=times, rtol=1e-12, atol=1e-13).y
    model = Model(1, (known_kinetic(np.array([[1 / MASS]])), Polynomial("q", [[2], [4]], [1.0])))
    inside = []
    for seed in range(20):
        data = Trajectories.read(trajectories(9, 15, noise=0.05, seed=seed))
        found = fitted(model, data, Setting())
        thetas = np.stack([replica((model, data, Setting(), found.theta, seed), k) for k in range(20)])
        low, high = Replicas(model, found.method, found.theta, thetas, 9).bands([0.5, 0.0], times)
        inside.append(((low <= true) & (true <= high))[:, 1:].mean())
    assert np.mean(inside) == pytest.approx(0.9, abs=1.5 * 0.3 / np.sqrt(20))  # values of one set are correlated


@pytest.mark.slow
def test_a_flow_of_data_that_do_not_tell_h_is_of_these_data():
    """Circular orbits of one radius: V may be any function with one slope there."""
    t = np.linspace(0, 6, 31)
    angle = np.linspace(0, 5, 10)[:, None] + t
    y = np.stack([np.cos(angle), np.sin(angle), -np.sin(angle), np.cos(angle)], 1)
    with pytest.warns(UserWarning, match=r"do not determine H elsewhere: .* q1\*\*2 \+ q2\*\*2 is the same"):
        flow = sympflow.learn((t, y), time_budget=120)
    assert flow.domain.contains(y[0].T).all()
    assert not flow.domain.contains(np.zeros((1, 4))).any()


def test_residuals_beyond_the_noise_of_the_data_are_not_explained():
    """Silent residuals of a model that fits nothing, as of pieces too short to tell, count by their size."""
    data = Trajectories.read(trajectories(4, 16, noise=0.01))
    wrong = Model(1, (known_kinetic(np.eye(1)), Polynomial("q", [[2]], [1.0])))
    setting = Setting(seen=data.smooth.sigma)
    held = left_out(fitted(wrong, data, setting), data.folds(), setting)
    assert len(held.losses) == 4
    assert held.excess > 2
    assert not held.explained
    assert "noise that is seen without a model" in held.complaint
    right = left_out(fitted(quartic(data), data, setting), data.folds(), setting)
    assert right.explained


@pytest.mark.slow
def test_noise_alone_and_a_noise_that_is_too_small_are_called_so():
    random, t = np.random.default_rng(0), np.linspace(0, 4, 21)
    data = Trajectories.read((t, random.normal(size=(6, 2, 21))))
    search = Search(data, [data.split(0.2, 0)], constraints_of(data, None, None, False, None, None), Setting(), 0)
    search.run(["polynomial"], Session())
    with pytest.warns(UserWarning, match="explains almost nothing"):
        search.diagnose(Session())
    data = Trajectories.read(trajectories(6, 12, noise=0.02))
    held = judged(fitted(quartic(data), data, Setting(np.full(2, 0.002))), data, Setting(np.full(2, 0.002)))
    assert held.loudness == pytest.approx(10, rel=0.2)  # the initial states take a twelfth of it
    assert not held.explained
    assert "times the noise" in held.complaint


def test_networks_grow_no_steps():
    """A jump of the force by a coarse step of the data is met by a neuron of bounded slope, not by a step."""
    q = np.linspace(-1, 1, 41)
    runs = [(np.linspace(0, 1, 41), np.stack([q, np.sign(q + shift)])) for shift in (0.0, 0.01)]
    data = Trajectories.read(runs)
    model = Model(1, (known_kinetic(np.eye(1)), Network("q", 3, data.scales[:1])))
    theta = matched(model, model.start(np.random.default_rng(0)), data, 1 / data.scales, 60)
    a = np.abs(theta[3:])
    assert a.max() < 40
    fit = Problem(model, data.pieces(10), chosen_method(model, theta, data, data.scales), data.scales)
    states, h = first_states(fit.data), 1e-5
    normal = fit.normal(theta, states)
    for i in (0, 3, 8):  # a weight of the sum, of a coordinate, a bias: their cost is in the normal equations
        e = h * np.eye(model.n)[i]
        assert (fit.cost(theta + e, states) - fit.cost(theta - e, states)) / (-4 * h) == pytest.approx(
            normal.c[i], rel=1e-4, abs=1e-6
        )
    assert normal.cost == pytest.approx(fit.cost(theta, states), rel=1e-12)


def orbits(t):
    rng = np.random.default_rng(0)
    for _ in range(6):
        y = solve_ivp(lambda t, y: [y[1], -y[0] - y[0] ** 3], (0, t[-1]), rng.uniform(-1, 1, 2), t_eval=t, rtol=1e-9).y
        yield t, y + 0.005 * rng.normal(size=y.shape)


def test_units_of_any_size_give_the_same_formula():
    """A step of the fit knows no unit: q in 1e20, p in 1e-20, and all as integers, single numbers or objects."""
    t = np.linspace(0, 6, 31)
    y = np.array([y for _, y in orbits(t)]) * np.ones((1, 2, 1))
    terms = ["p**2", "q**2", "q**3", "q**4", "q*p"]
    found = [sympflow.discover((t, y.astype(kind)), terms).discovery for kind in (float, np.float32)]
    found.append(sympflow.discover((t, y.astype(object) * np.array([[1e20], [1e-20]])), terms).discovery)
    for one in found:
        assert [str(f) for f in one.terms] == ["p1**2", "q1**2", "q1**4"]
    mixed = found[2].coefficients / found[0].coefficients
    assert mixed == pytest.approx([1e40, 1e-40, 1e-80], rel=1e-3)


def test_learn_returns_a_flow_of_what_it_found(noisy):
    """The flow is that of the H that was found, which misses the true one by less than half of the noise."""
    x = np.array([[0.5, -0.4], [-0.7, 0.3]])
    exact = [
        solve_ivp(lambda t, y: [y[1] / MASS, -STIFF * y[0] - QUARTIC * y[0] ** 3], (0, 0.5), row, rtol=1e-10).y[:, -1]
        for row in x
    ]
    import torch

    assert noisy(0.5, torch.tensor(x)).numpy() == pytest.approx(np.array(exact), abs=0.005)
    sol = sympflow.solve(noisy.system, noisy, t_span=(0, 50), y0=x[0], dt=0.5, backend="array")
    assert sympflow.max_energy_error(sol) < 1e-8


@pytest.mark.slow
@pytest.mark.parametrize("damping", [True, "each"])
@pytest.mark.parametrize("seed", [0, 1])
def test_friction_that_chance_makes_negative_is_none(damping, seed):
    """Data without friction: one rate in two is below 0 by chance."""
    data = trajectories(6, 10, noise=0.01, seed=seed)
    found = sympflow.learn(data, damping=damping, family="polynomial", time_budget=None)
    friction = found.system.friction
    assert 0 <= friction.largest < 0.01


def test_terms_without_evidence_are_left_out():
    theta, precision = np.array([1.0, 0.01, 2.0]), np.diag([1e4, 1e4, 1e4])
    model = Model(1, (Polynomial("q", [[2], [3], [4]], [1.0]),))
    left = pruned(Candidate("V", model), theta, precision, values=100)
    assert left.model.parts[0].exponents.tolist() == [[2], [4]]  # 0.01 is one standard error
    assert pruned(Candidate("V", model), np.ones(3), precision, values=100) is None


def test_outliers_do_not_make_a_robust_fit_loud():
    """Held-out residuals are judged without their size, which is 100 σ."""
    runs = trajectories(12, 15, noise=0.01)
    for _, y in runs:
        y[1, 7] += 1.0
    data, held = Trajectories.read(runs).split(0.25)
    found = fitted(quartic(data), data, Setting(huber=1.5))
    assert judged(found, held, Setting(huber=1.5)).loudness < 1.3
    assert judged(found, held, Setting()).loudness > 10

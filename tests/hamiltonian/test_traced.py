"""Python functions, written with NumPy or torch, are traced: every method runs for them as for the same H by text."""

import math
import pickle
import re

import numpy as np
import pytest
import torch
from scipy import special
from scipy.interpolate import make_interp_spline
from torch.nn import functional as F

from sympflow import HamiltonianSystem, solve
from sympflow.compiler.program import gradient
from sympflow.compiler.tracing import Untraceable, trace
from sympflow.schemes import SCHEMES

RNG = np.random.default_rng(3)
A, M = RNG.normal(size=(4, 4)), np.array([1.0, 2.0, 3.0, 4.0])
AT, MT = torch.tensor(A), torch.tensor(M)
FIRST, SECOND = np.triu_indices(4, 1)
Y0 = np.array([0.1, 0.2, 0.3, 0.4])


def over_pairs(library):
    def V(q):
        total = 0.0
        for a in range(4):
            for b in range(a):
                total = total + 1 / library.sqrt((q[..., a] - q[..., b]) ** 2 + 0.1)
        return total

    return V


def accumulated(q):
    V = np.zeros(q.shape[:-1])
    for a in range(4):
        V += q[..., a] ** 2
    return V


def assigned(q):
    V = np.zeros_like(q)
    V[..., 0] = q[..., 0] ** 2
    V[..., 1:] = np.sin(q[..., 1:])
    return V.sum(-1)


def bodies(q):
    x = q.reshape((*q.shape[:-1], 2, 2))
    d = x[..., None, :, :] - x[..., :, None, :]
    return (1 / np.sqrt((d**2).sum(-1) + 0.1)).sum((-1, -2))


def matrix(q, library=np):
    rows = [[1 + q[..., 0] ** 2, q[..., 1]], [q[..., 1], 2 + q[..., 2] ** 2]]
    return library.stack([library.stack(row, -1) for row in rows], -2)


def large_matrix(q):
    return np.eye(4) * (5 + q[..., :1, None] ** 2) + q[..., :, None] * A * q[..., None, :]


def unpacked(a, b, c, d):
    return a * b + c * d


# fmt: off
NUMPY = {
    "a sum and a cosine": lambda q: (q**2).sum(-1) / 2 + np.cos(q[..., 0]),
    "np.sum": lambda q: np.sum(q**4, axis=-1) / 4,
    "einsum": lambda q: np.einsum("...i,ij,...j->...", q, A, q) + np.einsum("...i,...i->...", q, q @ A),
    "matmul": lambda q: ((q @ A) * q).sum(-1) + (A @ q[..., None])[..., 0].sum(-1),
    "norm": lambda q: 1 / np.linalg.norm(q, axis=-1) + np.linalg.norm(q, ord=1, axis=-1),
    "diff and roll": lambda q: (np.diff(q, axis=-1) ** 2).sum(-1) + ((np.roll(q, 1, -1) - q) ** 4).sum(-1),
    "where": lambda q: np.where(q > 0, q**2, q**4).sum(-1) + np.where(q[..., 0] < 0.1, q[..., 0], q[..., 1]),
    "loops": over_pairs(np), "pairs by indices": lambda q: (1 / np.abs(q[..., FIRST] - q[..., SECOND])).sum(-1),
    "stack": lambda q: (np.stack([q[..., 0] * q[..., 1], np.sin(q[..., 2])], -1) ** 2).sum(-1),
    "concatenate": lambda q: (np.concatenate([q[..., :2], q[..., 3:]], -1) ** 2).sum(-1),
    "tensordot and dot": lambda q: np.tensordot(q, M, axes=(-1, 0)) + np.dot(q, M),
    "elementary": lambda q: (np.exp(-(q**2)) + np.log(1 + q**2) + np.sqrt(1 + q * q) + np.tanh(q)).sum(-1),
    "bases": lambda q: (np.log10(2 + q) + np.log2(2 + q) + np.exp2(q) + np.cbrt(q) + np.logaddexp(q, 1)).sum(-1),
    "rounding": lambda q: (np.floor(3 * q) * q + np.mod(q, 0.3) + np.fmod(q, 0.3) + np.trunc(9 * q) * q).sum(-1),
    "nearest image": lambda q: ((q - np.round(q)) ** 2 + (q - np.rint(q)) ** 4 + (3 * q).round(1) + np.fix(q)).sum(-1),
    "order": lambda q: np.sort(q, axis=-1) @ M + np.ptp(q, axis=-1) + np.sort(q[..., :2, None], -2)[..., 0, 0] ** 3,
    "finite": lambda q: np.where(np.isnan(q), 0.0, np.where(np.isfinite(q), q, 1.0) ** 2).sum(-1),
    "maximum": lambda q: np.maximum(q, 0.1).sum(-1) + np.clip(q, -0.2, 0.2).sum(-1) + q.max(-1) + q.min(-1),
    "abs and prod": lambda q: abs(q).sum(-1) + np.abs(q).prod(-1) + np.sign(q[..., 0]) * q[..., 0],
    "arctan2": lambda q: np.arctan2(q[..., 0], q[..., 1]) + np.hypot(q[..., 2], q[..., 3]),
    "powers": lambda q: (np.abs(q) ** 1.5 + np.power(2.0, q) + np.power(np.abs(q), 0.5)).sum(-1),
    "unpacked": lambda q: unpacked(*np.moveaxis(q, -1, 0)),
    "asarray": lambda q: np.asarray(q)[..., 0] ** 2 + np.cos(np.asarray(q)[..., 1]), "bodies": bodies,
    "outer": lambda q: (q[..., :, None] * q[..., None, :] * A).sum((-1, -2)),
    "statistics": lambda q: q.mean(-1) + np.var(q, axis=-1) + np.std(q, axis=-1),
    "cross": lambda q: np.cross(q[..., :3], np.array([0, 0, 1.0]))[..., 0],
    "cumsum": lambda q: (np.cumsum(q, -1) ** 2).sum(-1), "accumulated": accumulated, "assigned": assigned,
    "numbers of NumPy": lambda q: np.float64(2) * q[..., 0] + M[1] * q[..., 1],
    "solve": lambda q: (np.linalg.solve(A, q[..., None])[..., 0] * q).sum(-1),
    "det": lambda q: np.linalg.det(matrix(q)) + np.linalg.det(large_matrix(q)),
    "inv": lambda q: (np.linalg.inv(matrix(q)) @ q[..., :2, None])[..., 0, 0],
    "solve by elimination": lambda q: (np.linalg.solve(large_matrix(q), q[..., None])[..., 0] * q).sum(-1),
    "vectorize": lambda q: np.vectorize(lambda x: x * x)(q).sum(-1),
    "piecewise": lambda q: np.piecewise(q, [q < 0], [lambda x: x**2, lambda x: x]).sum(-1),
    "select": lambda q: np.select([q < 0, q >= 0], [q**2, q]).sum(-1), "polyval": lambda q: np.polyval(M, q).sum(-1),
    "sinc": lambda q: np.sinc(q).sum(-1) + np.heaviside(q, 0.5).sum(-1), "constant": lambda q: 0 * q[..., 0] + 3.0,
}
NETWORK = torch.nn.Sequential(torch.nn.Linear(4, 8), torch.nn.Tanh(), torch.nn.Linear(8, 1)).double()
NETWORK.requires_grad_(False)
TORCH = {
    "a sum and a cosine": lambda q: (q**2).sum(-1) / 2 + torch.cos(q[..., 0]),
    "sum of dim": lambda q: torch.sum(q**2, dim=-1) + q.sum(dim=-1), "network": lambda q: NETWORK(q).squeeze(-1),
    "stack and cat": lambda q: torch.cat([torch.stack([q[..., 0], q[..., 2].sin()], -1), q], dim=-1).prod(-1),
    "einsum": lambda q: torch.einsum("...i,ij,...j->...", q, AT, q), "matmul": lambda q: ((q @ AT) * q).sum(-1),
    "norm": lambda q: 1 / torch.linalg.norm(q, dim=-1) + q.norm(dim=-1) + torch.linalg.vector_norm(q, dim=-1),
    "diff and roll": lambda q: (torch.diff(q, dim=-1) ** 2).sum(-1) + ((torch.roll(q, 1, -1) - q) ** 4).sum(-1),
    "where": lambda q: torch.where(q > 0, q**2, q**4).sum(-1), "loops": over_pairs(torch),
    "elementary": lambda q: (torch.exp(-(q**2)) + torch.log1p(q**2) + torch.sqrt(1 + q * q) + torch.tanh(q)).sum(-1),
    "clamp": lambda q: q.clamp(-0.2, 0.2).sum(-1) + torch.relu(q).sum(-1) + q.clamp(min=0.1).sum(-1),
    "unbind": lambda q: unpacked(*q.unbind(-1)), "tensor": lambda q: (MT * q**2).sum(-1),
    "view": lambda q: (q.view(*q.shape[:-1], 2, 2) ** 2).sum((-1, -2)) + q.size(-1) * q.reshape(-1)[0] * 0,
    "zeros": lambda q: torch.zeros(q.shape[:-1], dtype=q.dtype, device=q.device) + q[..., 0] ** 2,
    "cumsum": lambda q: (torch.cumsum(q, -1) ** 2).sum(-1), "logsumexp": lambda q: torch.logsumexp(q, -1),
    "softmax": lambda q: (torch.softmax(q, -1) * q).sum(-1),
    "activations": lambda q: (F.gelu(q) + F.softplus(q) + q.sigmoid() + F.silu(q)).sum(-1),
    "more activations": lambda q: (F.gelu(q, approximate="tanh") + F.softplus(q, 3.0) + F.mish(q) + F.celu(q, 0.5)
                                   + F.leaky_relu(q, 0.1) + F.softsign(q) + F.logsigmoid(q) + F.tanhshrink(q)
                                   + F.hardtanh(q) + F.elu(q, 0.3) + F.dropout(q, 0.5, False)).sum(-1),
    "order": lambda q: q.sort(-1)[0] @ MT + torch.sort(q, dim=-1).values[..., 0] ** 3 + ((q - q.round()) ** 2).sum(-1),
    "outer": lambda q: (q[..., :, None] * q[..., None, :] * AT).sum((-1, -2)),
    "pairs by indices": lambda q: (1 / (q[..., FIRST] - q[..., SECOND]).abs()).sum(-1),
    "det": lambda q: torch.linalg.det(matrix(q, torch)),
    "max": lambda q: q.max(-1).values + q.amax(-1) + q.min(dim=-1)[0],
    "in place": lambda q: (q * 1).mul(2).sum(-1).pow(2) + q.square().mean(-1),
}
UNTRACEABLE = {
    "if": (lambda q: q[..., 0] ** 2 if q[..., 0] > 0 else q[..., 1], "write np.where"),
    "math": (lambda q: math.cos(q[0]), "write np.cos for math.cos"),
    "float": (lambda q: float(q[0]) ** 2, "float()"),
    "a mask": (lambda q: q[q > 0].sum(-1), "indexes by a condition: write np.where"),
    "median": (lambda q: np.median(q, axis=-1), "numpy.median has no rule"),
    "dropout": (lambda q: F.dropout(q).sum(-1), "call its eval()"),
    "fft": (lambda q: (np.abs(np.fft.rfft(q)) ** 2).sum(-1), "numpy.fft.rfft has no rule"),
    "any": (lambda q: q.sum(-1) if np.any(q > 0) else 0.0 * q.sum(-1), "write np.where"),
    "min": (lambda q: min(q[0], q[1]), "write np.where"),
    "asarray of floats": (lambda q: np.asarray(q, dtype=float).sum(-1), "float()"),
    "out": (lambda q: np.add.reduce(q, axis=-1, out=np.zeros(())), "with `out`"),
    "out of a sum": (lambda q: np.sum(q**2, axis=-1, out=np.zeros(q.shape[:-1])), "with `out`"),
    "a shape": (lambda q: q**2, "returns an array of shape (4,)"),
}
# fmt: on


def checked(program, function, states, convert):
    """Assert that a program has the values of a function, one by one and as a batch, and its derivatives by torch."""
    for x in states:
        np.testing.assert_allclose(program(*x)[0], function(convert(x)), rtol=1e-12)


@pytest.mark.parametrize("name", NUMPY)
def test_functions_of_numpy(name):
    program, states = trace(NUMPY[name], [list("abcd")]), RNG.normal(size=(5, 4)) * 0.7
    checked(program, NUMPY[name], states, np.array)
    system = HamiltonianSystem(potential=NUMPY[name], ndof=4, check=False)
    assert system.untraced == "", system.untraced
    small = 1e-6 * np.eye(4)[:, None]
    differences = (NUMPY[name](states + small) - NUMPY[name](states - small)).T / 2e-6
    smooth = {"rounding": 0.5}.get(name, 1e-6)  # where a floor jumps is left out
    assert np.median(np.abs(differences + system.force(states))) < smooth


@pytest.mark.parametrize("name", TORCH)
def test_functions_of_torch(name):
    program, states = trace(TORCH[name], [list("abcd")], torch=True), RNG.normal(size=(5, 4)) * 0.7
    checked(program, TORCH[name], states, torch.tensor)
    slopes = gradient(program.outputs[0], program.inputs)
    for x in states:
        q = torch.tensor(x, requires_grad=True)
        (exact,) = torch.autograd.grad(TORCH[name](q), q)
        found = type(program)(program.inputs, slopes)(*x)
        np.testing.assert_allclose(np.array(found, dtype=float), exact, rtol=1e-11, atol=1e-13)


@pytest.mark.parametrize("name", UNTRACEABLE)
def test_what_cannot_be_traced_says_why(name):
    function, reason = UNTRACEABLE[name]
    with pytest.raises(Untraceable) as error:
        trace(function, [list("abcd")])
    assert reason in str(error.value)


H2 = "p1**2/2 + p2**2/2 + q1**4/4 + q2**4/4 "
SYSTEMS = {
    "NumPy": (
        {"potential": lambda q: (q**2).sum(-1) / 2 + q[..., 0] ** 2 * q[..., 1] - q[..., 1] ** 3 / 3},
        ("p1**2/2 + p2**2/2 + (q1**2 + q2**2)/2 + q1**2*q2 - q2**3/3", {}),
    ),
    "torch, masses": (
        {"potential": lambda q: torch.cos(q[..., 0] - q[..., 1]) + (q**4).sum(-1) / 4, "mass": [1.0, 2.0]},
        ("p1**2/2 + p2**2/4 + cos(q1 - q2) + q1**4/4 + q2**4/4", {}),
    ),
    "friction": (
        {"potential": lambda q: np.cos(q[..., 0] - q[..., 1]) + (q**4).sum(-1) / 4, "damping": 0.1},
        (H2 + "+ cos(q1 - q2)", {"damping": 0.1}),
    ),
    "driven": (
        {
            "potential": lambda t, q: (1 + np.sin(2 * t) / 3) * np.cos(q[..., 0] - q[..., 1]) + (q**4).sum(-1) / 4,
            "time": True,
        },
        (H2 + "+ (1 + sin(2*t)/3)*cos(q1 - q2)", {"time": "t"}),
    ),
    "general": (
        {"hamiltonian": lambda q, p: (p**2).sum(-1) / 2 * (1 + q[..., 0] ** 2) + (q**4).sum(-1) / 4},
        ("(p1**2 + p2**2)/2*(1 + q1**2) + q1**4/4 + q2**4/4", {}),
    ),
    "general, driven": (
        {
            "hamiltonian": lambda t, q, p: (
                (p**2).sum(-1) / 2 * (1 + q[..., 0] ** 2 * np.sin(t) ** 2) + (q**4).sum(-1) / 4
            ),
            "time": True,
        },
        ("(p1**2 + p2**2)/2*(1 + q1**2*sin(t)**2) + q1**4/4 + q2**4/4", {"time": "t"}),
    ),
}
ANY = ["gauss_legendre4", "implicit_midpoint", "rk4", "tao4"]
METHODS = [*ANY, "verlet", "srkn11b", "chin4a", "kahan_li8", "strang_parts", "linear_kahan_li6", "log_kahan_li8"]


@pytest.mark.parametrize(
    ("kind", "method"),
    [
        pytest.param(kind, m, marks=pytest.mark.slow if (i + k) % 2 else ())
        for i, kind in enumerate(SYSTEMS)
        for k, m in enumerate(ANY if "general" in kind else METHODS)
    ],
)
def test_every_method_runs_as_for_the_same_text(kind, method):
    given, (text, options) = SYSTEMS[kind]
    system = HamiltonianSystem(**given, ndof=2, name="alike")
    same = HamiltonianSystem.from_sympy(text, **options, name="alike")
    try:
        solve(same, method, (0, 0.1), Y0, dt=0.05)
    except ValueError as error:
        with pytest.raises(ValueError, match=re.escape(str(error)[:40])):
            solve(system, method, (0, 0.1), Y0, dt=0.05)
        return
    for y0 in (Y0, Y0 * np.linspace(0.5, 1, 9)[:, None]):
        found, expected = (solve(s, method, (0, 2), y0, dt=0.05) for s in (system, same))
        assert found.stats["backend"] == expected.stats["backend"] == "compiled"
        np.testing.assert_allclose(found.y, expected.y, rtol=1e-12, atol=1e-13)
        assert found.stats["n_steps"] == expected.stats["n_steps"]
        more = abs(found.stats["force_evaluations"] - expected.stats["force_evaluations"])
        if method == "log_kahan_li8":  # steps to outputs are found by secants, whose last trial is a matter of rounding
            assert more % SCHEMES["kahan_li8"].force_evaluations == 0
            assert more <= 0.01 * expected.stats["force_evaluations"]
        else:
            assert more == 0
    states = RNG.normal(size=(3, 4))
    t = () if system.autonomous else (0.7,)
    for name in ("hamiltonian", "gradient", "hessian", "time_derivative"):
        values = [np.asarray(getattr(s, name)(states, *t)) for s in (system, same)]
        np.testing.assert_allclose(*values, rtol=1e-13, atol=1e-13, err_msg=name)
        tensors = getattr(system, name)(torch.tensor(states), *t)
        np.testing.assert_allclose(tensors, values[1], rtol=1e-13, atol=1e-13, err_msg=name)


def changing(q):
    return STATE["k"] * (q**2).sum(-1)


STATE = {"k": 1.0}
SPLINE = make_interp_spline([-1.0, 0.0, 1.0], [1.0, 0.0, 1.0], k=1)


@pytest.mark.parametrize(
    ("function", "error", "message"),
    [
        (lambda q: np.float32(0.1) * q.astype(np.float32).sum(-1), (TypeError, ValueError), "^`potential`"),
        (lambda q: q.detach().numpy().sum(-1), (TypeError, ValueError), "^`potential`"),
        (
            lambda q: np.interp(q[..., 0], [-1.0, 0.0, 1.0], [1.0, 0.0, 1.0]),
            TypeError,
            "interp has no rule.*`gradient`",
        ),
        (lambda q: SPLINE(q[..., 0]), TypeError, "^`potential` could not be traced.*pass `gradient`.* of a spline"),
    ],
)
def test_functions_that_are_none_of_the_state_are_refused(function, error, message):
    with pytest.raises(error, match=message):
        solve(HamiltonianSystem(function, ndof=2), "verlet", (0, 1), Y0, dt=0.1)


def test_a_function_that_has_changed_is_refused():
    system = HamiltonianSystem(changing, ndof=2)
    STATE["k"] = 1.0
    solve(system, "verlet", (0, 1), Y0, dt=0.1)
    STATE["k"] = 2.0
    with pytest.raises(ValueError, match=r"^`potential` has another value than when it was traced"):
        solve(system, "verlet", (0, 1), Y0, dt=0.1)
    assert solve(HamiltonianSystem(changing, ndof=2), "verlet", (0, 1), Y0, dt=0.1).stats["backend"] == "compiled"


CONDITIONS = {
    "product": lambda q: q[..., 0] ** 2 / 2 * (q[..., 0] > 0),
    "and": lambda q: q[..., 0] ** 2 / 2 * ((q[..., 0] > 0) & (q[..., 0] > -1)),
    "not": lambda q: q[..., 0] ** 2 / 2 * ~(q[..., 0] <= 0),
    "choice": lambda q: q[..., 0] ** 2 / 2 * np.where(q[..., 0] > 5, q[..., 0] > 4, q[..., 0] > 0),
    "sum": lambda q: (q**2 / 2 * (q > 0)).sum(-1),
}


@pytest.mark.parametrize("name", CONDITIONS)
@pytest.mark.parametrize("method", ["kahan_li8", "gauss_legendre6", "chin4a"])
def test_conditions_are_calculated_with_as_one_and_zero(method, name):
    """A spring that pulls on one side alone: from 1 to 0 in π/2, then free."""
    system = HamiltonianSystem(CONDITIONS[name], ndof=1, y0=[1.0, 0.0])
    sol = solve(system, method, (0, 3), dt=np.pi / 200)
    assert sol.stats["backend"] == "compiled"
    np.testing.assert_allclose(sol.y[:, -1], [np.pi / 2 - 3, -1], rtol=0, atol=(np.pi / 200) ** 4)


DRIVES = {
    "product": lambda t, q: -q[..., 0] * (t > 1.003),
    "choice": lambda t, q: np.where(t > 1.003, -q[..., 0], 0 * q[..., 0]),
    "sign": lambda t, q: -q[..., 0] * (np.sign(t - 1.003) + 1) / 2,
    "and": lambda t, q: -q[..., 0] * ((t > 1.003) & (t < 100)),
}


@pytest.mark.parametrize("name", DRIVES)
@pytest.mark.parametrize("method", ["verlet", "kahan_li8", "gauss_legendre6", "rk4", "dop853", "dopri5", "bosh3"])
def test_functions_of_the_time_that_jump_are_landed_on(method, name):
    """Under a constant force every one of these methods is exact."""
    system = HamiltonianSystem(DRIVES[name], ndof=1, time=True, y0=[0.0, 0.0])
    options = {} if method in ("dop853", "dopri5", "bosh3") else {"dt": 0.1}
    sol = solve(system, method, (0, 3), **options)
    np.testing.assert_allclose(sol.y[:, -1], [(3 - 1.003) ** 2 / 2, 3 - 1.003], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    "V",
    [
        lambda q: np.sum(q**4, axis=-1),
        lambda q: np.linalg.norm(q, axis=-1) ** 2,
        lambda q: np.where(q[..., 0] > 0, q[..., 0] ** 2, q[..., 0] ** 4),
        lambda q: np.cos(q[..., 0]),
    ],
    ids=["sum", "norm", "where", "cos"],
)
def test_functions_of_numpy_alone_are_given_no_tensors(V):
    """Neither by the first call of H nor where no method is named."""
    system, q = HamiltonianSystem(V, ndof=1), np.array([[0.3], [0.7]])
    y = np.concatenate([q, np.zeros_like(q)], axis=-1)
    np.testing.assert_allclose(system.hamiltonian(y), V(q), rtol=1e-15)
    assert solve(HamiltonianSystem(V, ndof=1), t_span=(0, 1), y0=[1.0, 0.0]).success


def test_programs_can_be_read_and_pickled():
    system = HamiltonianSystem(lambda q: np.cos(q[..., 0]), ndof=1)
    assert str(system.program).startswith("(q1, p1) →\n")
    assert "cos(q1)" in str(system.program)
    assert "cos(q1)" in str(HamiltonianSystem.from_sympy("p**2/2 + cos(q)").program)
    deep = trace(lambda q: sum((q[0] * k for k in range(3000)), q[1]) ** 2, [["a", "b"]])
    again = pickle.loads(pickle.dumps(deep))
    assert str(again) == str(deep)
    assert again(0.1, 0.2) == deep(0.1, 0.2)
    branches = HamiltonianSystem(lambda q: q[..., 0] if q.sum() > 0 else -q[..., 0], ndof=1)
    with pytest.raises(ValueError, match=r"has no program, .*: it branches on a value: write np\.where"):
        _ = branches.program


SPECIAL = {
    "besselj(0, q) + bessely(2, q) + besseli(1, q) + besselk(1, q)": lambda q: (
        special.j0(q) + special.yv(2, q) + special.iv(1, q) + special.k1(q)
    ),
    "gamma(q) + loggamma(q)": lambda q: special.gamma(q) + special.gammaln(q),
    "lowergamma(2.5, q) - uppergamma(2.5, q)": lambda q: (
        special.gamma(2.5) * (special.gammainc(2.5, q) - special.gammaincc(2.5, q))
    ),
    "elliptic_k(q/4) + Ei(q)": lambda q: special.ellipk(q / 4) + special.expi(q),
    "log10(q) + log2(q) + log1p(q) + hypot(q, 2)": lambda q: np.log10(q) + np.log2(q) + np.log1p(q) + np.hypot(q, 2),
    "erf(q) + erfc(q/2)": lambda q: special.erf(q) + special.erfc(q / 2),
}


@pytest.mark.parametrize("text", SPECIAL)
def test_special_functions_are_compiled(text):
    given = HamiltonianSystem(lambda q: SPECIAL[text](q[..., 0]), ndof=1, y0=[1.3, 0.1])
    system = HamiltonianSystem.from_sympy(f"p**2/2 + {text}", y0=[1.3, 0.1])
    q = np.linspace(0.4, 1.7, 9)[:, None]
    np.testing.assert_allclose(given.force(q), system.force(q), rtol=1e-12)
    for method in ("verlet", "srkn11b", "gauss_legendre4"):
        runs = [solve(s, method, (0, 0.4), dt=0.05) for s in (given, system)]
        assert [run.stats["backend"] for run in runs] == ["compiled"] * 2
        reference = solve(system, method, (0, 0.4), dt=0.05, backend="array")
        for run in runs:
            np.testing.assert_allclose(run.y, reference.y, rtol=1e-12)


SUMS = {
    "plain": (lambda q, p: (p**2 / M[:2]).sum(-1) / 2 + (q**4).sum(-1) / 4, "p1**2/2 + p2**2/4 + (q1**4 + q2**4)/4"),
    "joint": (lambda q, p: 0.5 * (p @ np.array([[2.0, 0.5], [0.5, 1.0]]) * p + q**2).sum(-1),
              "p1**2 + p1*p2/2 + p2**2/2 + (q1**2 + q2**2)/2"),
    "relativistic": (lambda q, p: torch.sqrt(1 + (p**2).sum(-1)) + torch.cos(q[..., 0]) + q[..., 1] ** 2,
                     "sqrt(1 + p1**2 + p2**2) + cos(q1) + q2**2"),
    "shifted": (lambda q, p: ((p - 0.3) ** 2).sum(-1) / 2 - (q**2).sum(-1) / 2,
                "((p1 - 0.3)**2 + (p2 - 0.3)**2)/2 - (q1**2 + q2**2)/2"),
    "infinite at rest": (lambda q, p: (p * np.log(p) + q**2).sum(-1), "p1*log(p1) + p2*log(p2) + q1**2 + q2**2"),
    "driven": (lambda t, q, p: (p**2).sum(-1) / 2 + np.sin(t) * q[..., 0] + (q**2).sum(-1),
               "(p1**2 + p2**2)/2 + sin(t)*q1 + q1**2 + q2**2"),
}  # fmt: skip


@pytest.mark.parametrize("name", SUMS)
def test_a_sum_in_one_function_is_separable_as_it_is_by_text(name):
    function, text = SUMS[name]
    driven = name == "driven"
    found = HamiltonianSystem(hamiltonian=function, ndof=2, y0=Y0, time=driven)
    expected = HamiltonianSystem.from_sympy(text, y0=Y0, time="t" if driven else None)
    assert (found.separable, found.quadratic_kinetic) == (True, expected.quadratic_kinetic)
    time = (0.3,) * driven
    np.testing.assert_allclose(found.hamiltonian(Y0, *time), expected.hamiltonian(Y0, *time), rtol=1e-15)
    for method in ("verlet", "kahan_li8", "tao4", "gauss_legendre4"):
        for backend in ("compiled", "array"):
            ends = [solve(s, method, (0, 1), dt=0.1, backend=backend).y[:, -1] for s in (found, expected)]
            np.testing.assert_allclose(*ends, rtol=0, atol=1e-13)


def test_a_mass_within_one_function_that_has_changed_is_refused():
    mass = [1.0]
    system = HamiltonianSystem(hamiltonian=lambda q, p: (p**2).sum(-1) / mass[0] + (q**2).sum(-1), ndof=2, y0=Y0)
    solve(system, "verlet", (0, 1), dt=0.1)
    mass[0] = 2.0
    with pytest.raises(ValueError, match=r"^`hamiltonian` has another value than when it was traced"):
        solve(system, "verlet", (0, 1), dt=0.1)

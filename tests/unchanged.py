"""Record what a user can see of sympflow, results and messages, and compare it later: bit for bit, and word for word.

    python tests/unchanged.py record FILE       # on the tree before a refactoring
    python tests/unchanged.py compare FILE      # on the tree after it; exit status 1 if anything differs
    python tests/unchanged.py --list

A case is a function of this file that calls public names only, and answers with numbers, arrays, solutions, texts, and
containers of these. Most answers are those of expressions in a text, one a line, and are named by that line. Floats are
compared by their bits, NaN being equal to NaN. Differences in results are told apart from those in words, which are
texts with blanks in them. Times, dates, addresses and folders are left out.

`--only PATTERN` runs the cases whose names match a regular expression. Compiled loops are kept in a folder of their
own, unless SYMPFLOW_CACHE_DIR names another. Loops that were compiled in this process may differ by a rounding from the
same loops that were loaded from there; so a run in which any were compiled is made once more, in a new process.
"""

# ruff: noqa: F401  (some names are used by the expressions in texts only)

import argparse
import contextlib
import copy
import csv
import difflib
import gzip
import hashlib
import inspect
import io
import math
import os
import pickle
import re
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1", MPLBACKEND="Agg")
os.environ.update(COLUMNS="120", TERMINAL_WIDTH="120", NO_COLOR="1", TERM="dumb")
os.environ.setdefault("SYMPFLOW_CACHE_DIR", str(Path(tempfile.gettempdir()) / "sympflow-unchanged"))

import numpy as np
import torch
import torchdiffeq
from numba import njit
from scipy.integrate import solve_ivp
from sympflow.integrators.checks import check_integrator
from sympflow.integrators.scheme import Scheme
from sympflow.integrators.schemes import SCHEMES
from torch import Tensor, nn, tensor

import sympflow
from sympflow import (
    Ball,
    Box,
    EnergySublevel,
    HamiltonianSystem,
    MLPFlow,
    Solution,
    SympFlow,
    Tube,
    compare,
    get,
    load,
    poincare_section,
    shipped_flows,
    solve,
    stability,
    systems,
    time_transformed,
    train,
    work_precision,
)
from sympflow.arrays import concatenate, per_state
from sympflow.flow.layers import Drift, Kick
from sympflow.flow.potentials import MLPPotential, Potential
from sympflow.flow.scaling import Scaling
from sympflow.integrators.base import FixedStep, Integrator, Outcome
from sympflow.interop.scipy import as_scipy
from sympflow.interop.systems import from_hamiltonian, from_module
from sympflow.interop.torchdiffeq import odeint, odeint_adjoint, odeint_event
from sympflow.interop.torchdiffeq import register as register_in_torchdiffeq

Leaf = np.ndarray | bytes | str
HERE = Path(sympflow.__file__).resolve().parent
CASES: dict[str, Callable[[], Any]] = {}
KEPT: dict[str, bytes] = {}  # pickles that the recording tree made
TIMES = ("wall_time", "run_time", "run_time_spread", "seconds", "training_seconds", "break_even")
nan, inf = math.nan, math.inf


def case(function: Callable[[], Any]) -> Callable[[], Any]:
    """Register a function as the case of its name."""
    CASES[function.__name__] = function
    return function


def cases(each: Iterable[Any]) -> Callable[[Callable[[Any], Any]], Callable[[Any], Any]]:
    """Register a function of one argument as a case for each name, or for each value of a dict by its key."""

    def register(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
        for name, value in each.items() if isinstance(each, dict) else zip(each, each, strict=True):
            CASES[f"{function.__name__}: {name}"] = partial(function, value)
        return function

    return register


# from calls to leaves ---------------------------------------------------------------------------------------------


def tried(call: Callable[..., Any], *arguments: Any, **options: Any) -> dict[str, Leaf]:
    """The leaves of a call's answer, or of its exception, and its warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            found = dict(leaves(call(*arguments, **options)))
        except (Exception, SystemExit) as error:
            found = dict(leaves({"raises": type(error).__name__, "says": str(error)}))
    ours = (w for w in caught if issubclass(w.category, UserWarning | RuntimeWarning) and "torch" not in w.filename)
    warned = sorted({f"{w.category.__name__}: {w.message}" for w in ours})
    return found | {f"warning {i}": cleaned(text) for i, text in enumerate(warned)}


def lines(text: str) -> list[str]:
    """The lines of a text that hold something."""
    return [line for line in map(str.strip, text.splitlines()) if line]


def answers(code: str, form: str = "{}", **names: Any) -> dict[str, dict[str, Leaf]]:
    """Evaluate expressions, one a line, as they stand in `form`; each line is the name of its answer."""
    return {line: tried(eval, form.format(line), globals() | names) for line in lines(code)}


def cleaned(text: str) -> str:
    """The text without what changes from run to run: times, addresses and folders."""
    text = text.replace(str(HERE), "PACKAGE").replace(tempfile.gettempdir(), "TMP")
    text = re.sub(r"TMP/unchanged-\w+", "FOLDER", re.sub(r" at 0x[0-9a-f]+", " at 0x…", text))
    text = re.sub(r"(wall_time'?( =|:)) [^,}\n]+", r"\1 …", text)
    return re.sub(r"(?m)^.*training seconds .*\n?", "", text)


def untimed(table: str) -> str:
    """A table without run times, and without the widths of columns, which depend on them."""
    table = re.sub(r"[\d.,]+ (ns|µs|ms|s)( ± +\d+ %)?", "…", table)
    return re.sub(r"(?m) +$", "", re.sub("─+", "─", re.sub(" +", " ", table)))


def leaves(x: Any, path: str = "") -> Iterator[tuple[str, Leaf]]:
    """The numbers, names and texts in an answer, each with its path."""
    if isinstance(x, Tensor):
        x = x.detach().cpu().numpy()
    match x:
        case str():
            text = cleaned(x)
            yield path, text if re.search(r"\s", text) else text.encode()
        case bytes():
            yield path, x
        case None | type():
            yield path, getattr(x, "__name__", "None").encode()
        case bool() | int() | float() | complex() | np.generic() | np.ndarray():
            array = np.array(x)  # a copy, for what is seen may be changed later
            yield from leaves(array.tolist(), path) if array.dtype.kind not in "biufc" else [(path, array)]
        case Solution():
            names = ("t", "y", "status", "message", "stats", "success", "nfev", "t_events", "y_events", "t_span", "y0")
            yield from leaves({name: getattr(x, name) for name in (*names, "integrator")}, path)
        case HamiltonianSystem() | Integrator() | nn.Module():
            yield from leaves(repr(x), path)
        case dict():
            for name, value in x.items():
                if name not in TIMES and not isinstance(value, Path):
                    yield from leaves(value, " → ".join(part for part in (path, str(name)) if part))
        case _ if is_dataclass(x):
            yield from leaves({f.name: getattr(x, f.name) for f in fields(x)}, path)
        case set() | frozenset():
            yield from leaves(sorted(x), path)
        case list() | tuple() if x and all(isinstance(v, int | float | np.number) for v in x):
            yield from leaves(np.asarray(x), path)
        case list() | tuple():
            yield from leaves({"size": len(x), **dict(enumerate(x))}, path)
        case _:
            yield path, type(x).__name__.encode()


@contextlib.contextmanager
def folder() -> Iterator[Path]:
    """A temporary folder, whose name no text keeps."""
    with tempfile.TemporaryDirectory(prefix="unchanged-") as name:
        yield Path(name)


def content(path: Path) -> Any:
    """Read a file, without times: columns of numbers, arrays, or the weights of a flow."""
    if path.suffix == ".npz":
        with np.load(path) as arrays:
            return dict(arrays.items())
    if path.suffix == ".safetensors":
        return about(load(path))
    if path.suffix != ".csv":
        return path.suffix
    with path.open(encoding="utf-8", newline="") as file:
        heading, *rows = csv.reader(file)
    found: dict[str, Any] = {"heading": " ".join(heading)}
    for name, *cells in zip(heading, *rows, strict=True):
        try:
            found[name] = np.array([float(cell) if cell else nan for cell in cells])
        except ValueError:
            found[name] = cells
    return found


def written(write: Callable[[Path], Any], name: str = "a.csv") -> Any:
    """The content of a file that something writes."""
    with folder() as place:
        write(place / name)
        return content(place / name)


def saved(flow: Any) -> dict[str, Any]:
    """The bytes of a flow's file by their digest, and the flow that is read from it, saved again."""
    with folder() as place:
        first, second = place / "a.safetensors", place / "b.safetensors"
        flow.save(first)
        again = load(first, system=getattr(flow, "system", None))
        again.save(second)
        digests = [hashlib.sha256(path.read_bytes()).hexdigest() for path in (first, second)]
        return {"digests": digests, "bytes": first.stat().st_size, "loaded": again, "class": type(again)}


def drawn(figure: Any, data: bool = True) -> dict[int, Any]:
    """Read a figure: its texts, and the numbers of its lines and points."""
    return {
        i: {"texts": [ax.get_title(), ax.get_title("left"), ax.get_xlabel(), ax.get_ylabel()]}
        | ({"lines": [np.asarray(line.get_xydata(), dtype=float) for line in ax.lines]} if data else {})
        | ({"points": [np.ma.getdata(points.get_offsets()) for points in ax.collections]} if data else {})
        for i, ax in enumerate(figure.axes)
    }


# the systems ------------------------------------------------------------------------------------------------------


@njit
def chain_potential(q):
    return q[0] ** 2 / 2 + (q[0] - q[1]) ** 2 / 2 + q[1] ** 4 / 4


@njit
def chain_gradient(q, out):
    out[0] = 2 * q[0] - q[1]
    out[1] = q[1] - q[0] + q[1] ** 3


@njit
def chain_hessian_vector(q, v, out):
    out[0] = 2 * v[0] - v[1]
    out[1] = (1 + 3 * q[1] ** 2) * v[1] - v[0]


def plain_potential(q):
    return (q**2).sum(-1) / 2 + q[..., 0] ** 2 * q[..., 1]


def plain_gradient(q):
    a, b = q[..., :1], q[..., 1:]
    return concatenate([a + 2 * a * b, b + a**2])


def plain_hessian_vector(q, v):
    a, b, x, y = q[..., :1], q[..., 1:], v[..., :1], v[..., 1:]
    return concatenate([x + 2 * (a * y + b * x), y + 2 * a * x])


def torch_potential(q):
    return -torch.cos(q[..., 0]) + q[..., 1] ** 4 / 4 + (q[..., 0] * q[..., 1]) ** 2 / 2


def torch_hamiltonian(q, p):
    return torch.sqrt(1 + (p**2).sum(-1)) + (q**2).sum(-1) / 2 + (q * p).sum(-1) / 10


def quartic_hamiltonian(q, p):
    return (p**2).sum(-1) / 4 + (q**4).sum(-1) / 4


def stiff_potential(q):
    return 50 * q[..., 1] ** 2 + (q[..., 0] - q[..., 1]) ** 4 / 4


def stiff_gradient(q):
    cube = (q[..., :1] - q[..., 1:]) ** 3
    return concatenate([cube, 100 * q[..., 1:] - cube])


def stiff_hessian_vector(q, v):
    slope = 3 * (q[..., :1] - q[..., 1:]) ** 2 * (v[..., :1] - v[..., 1:])
    return concatenate([slope, 100 * v[..., 1:] - slope])


symbolic = HamiltonianSystem.from_sympy
Y4 = [0.3, -0.2, 0.1, 0.4]
CHAIN = {"potential": chain_potential, "gradient": chain_gradient, "hessian_vector": chain_hessian_vector}
PLAIN = {"potential": plain_potential, "gradient": plain_gradient, "hessian_vector": plain_hessian_vector}
STIFF = {"potential": stiff_potential, "gradient": stiff_gradient, "hessian_vector": stiff_hessian_vector}
MASSES = "p1**2 + p1*p2/3 + p2**2/2 + a*(q1**2 + q2**2 + q1*q2**3)/2"
BOXED = "(p1**2 + p2**2 + q1**2 + q2**2)/2 + q1**2*q2"


class Systems:
    """The systems, each made when it is first asked for."""

    MADE: ClassVar[dict[str, Callable[[], HamiltonianSystem]]] = {
        "pendulum": systems.pendulum,
        "henon_heiles": systems.henon_heiles,
        "escape": systems.henon_heiles_escape,
        "oscillator": systems.harmonic_oscillator,
        "oscillator_100": partial(systems.harmonic_oscillator, 100.0),
        "kepler": partial(systems.kepler, 0.6),
        "quartic": systems.quartic,
        "fput": partial(systems.fput, 50.0),
        "fput_1000": partial(systems.fput, 1000.0),
        "toda": systems.toda_lattice,
        "nonseparable": systems.nonseparable,
        "spring": systems.spring_pendulum,
        "polar": partial(systems.spring_pendulum, 1e6, coordinates="polar"),
        "planets": systems.outer_solar_system,
        "bare": partial(symbolic, "p**2/2 + q**4/4", name="bare"),
        "boxed": partial(symbolic, BOXED, name="boxed", y0=[0.0, 0.1, 0.3, 0.1], domain=Box([-0.25] * 4, [0.35] * 4)),
        "masses": partial(symbolic, MASSES, params={"a": 1.5}, name="masses", y0=Y4, energy_scale=0.5),
        "relativistic": partial(
            symbolic, "sqrt(1 + p**2) + q**2/2 + q**4/4", name="fast", y0=[0.5, 0.4], domain=Box([-1, -1], [1, 1])
        ),
        "numba": partial(
            HamiltonianSystem, **CHAIN, mass=[[2.0, 0.3], [0.3, 1.0]], ndof=2, y0=Y4, domain=Box([-0.5] * 4, [0.5] * 4)
        ),
        "functions": partial(HamiltonianSystem, **PLAIN, ndof=2, name="functions", y0=Y4),
        "torch": partial(HamiltonianSystem, torch_potential, ndof=2, mass=[1.0, 2.0], name="torch", y0=Y4),
        "whole": partial(HamiltonianSystem, hamiltonian=torch_hamiltonian, ndof=2, name="whole", y0=Y4),
        "stiff": partial(
            HamiltonianSystem,
            **STIFF,
            stiffness_matrix=np.diag([0.0, 100.0]),
            ndof=2,
            y0=[0.5, 0.02, 0.1, 0.1],
            dt=0.02,
        ),
    }

    def __getattr__(self, name: str) -> HamiltonianSystem:
        if name not in self.MADE:
            raise AttributeError(name)
        setattr(self, name, made := self.MADE[name]())
        return made


S = Systems()
WIDE = "pendulum henon_heiles kepler fput toda spring nonseparable polar relativistic masses numba functions torch"
WIDE += " whole stiff bare"  # those that every method is tried on


def states(one: HamiltonianSystem, n: int = 5) -> np.ndarray:
    """A batch of states near a system's own."""
    return one.y0 * np.linspace(0.85, 1.02, n)[:, None]


def between(t0: float, t1: float, n: int = 7) -> np.ndarray:
    """Times from t0 to t1 of which most lie between steps, with one of them twice, and the end."""
    shares = np.sort([*(np.arange(1, n + 1) / math.sqrt(2) % 1), 0.25, 0.25])
    return np.array([*(t0 + (t1 - t0) * shares), t1])


def event(function: Callable[..., Any], **attributes: Any) -> Callable[..., Any]:
    """An event function with `terminal` or `direction`."""

    def g(t, y):
        return function(t, y)

    vars(g).update(attributes)
    return g


def seen(sol: Solution) -> dict[str, Any]:
    """A solution with what its dense output says: between the steps, at its ends, and outside."""
    code = """
        f((2 * t0 + t1) / 3)
        f(t0 + (t1 - t0) * np.array([0.0, 0.1234567, 0.5, 0.70001, 1.0]))
        f(between(t0, t1)[::-1])
        f([])
        f(t0 - (t1 - t0))
        f([t0, t1 + (t1 - t0)])
        f(nan)
    """
    return {"solution": sol, "class": type(sol.sol)} | answers(code, f=sol.sol, t0=sol.t_span[0], t1=sol.t_span[1])


def sloped(run: Callable[..., Solution], y0: Any, dtype: torch.dtype = torch.float64, dense: bool = False) -> Any:
    """A run from a tensor, and the gradient of a sum of its states."""
    x = tensor(y0, dtype=dtype, requires_grad=True)
    sol = run(y0=x, dense_output=dense)
    y = sol.sol(float(np.mean(sol.t_span))) if dense else sol.y
    weights = torch.arange(1, y.numel() + 1, dtype=dtype).reshape(y.shape) / y.numel()
    return {"solution": sol, "gradient": torch.autograd.grad((weights * y).sum(), x)[0]}


# every method -----------------------------------------------------------------------------------------------------

METHODS = sympflow.available()
FLOWS = ("sympflow", "mlp")
SLOW = ("adaptive_heun", "fehlberg2", "bosh3")  # at their usual tolerances


def own(method: str) -> tuple[str, str]:
    """The systems on which a method is looked at more closely."""
    options = get(method).options()
    if method in FLOWS:
        return "henon_heiles", "kepler" if method == "sympflow" else "pendulum"
    if "shift" in options:
        return "kepler", "functions"
    if "parts" in options:
        return "henon_heiles", "polar"
    if method.startswith("linear_") or method in ("impulse", "mollified_impulse", "implicit_explicit"):
        return "stiff", "fput"
    return "henon_heiles", "kepler" if method in SCHEMES else "nonseparable"


@dataclass(frozen=True)
class Run:
    """A run by a method on a system: over so many of its steps, the last of which is shorter."""

    method: str
    name: str
    steps: float = 20.4
    backwards: bool = False

    @property
    def system(self) -> HamiltonianSystem:
        return getattr(S, self.name)

    @property
    def ends(self) -> tuple[float, float]:
        t0, t1 = 0.3, 0.3 + self.steps * self.system.dt * (10 if self.method in FLOWS else 1)
        return (t1, t0) if self.backwards else (t0, t1)

    @property
    def times(self) -> np.ndarray:
        return between(*self.ends)

    @property
    def batch(self) -> np.ndarray:
        return states(self.system)

    def __call__(self, **given: Any) -> Solution:
        loose = {"rtol": 1e-4, "atol": 1e-6} if self.method in SLOW else {}
        return solve(self.system, self.method, self.ends, **loose | given)


RUNS = {f"{method} on {name}": Run(method, name) for method in METHODS for name in own(method)}


@cases(METHODS)
def every_step(method: str) -> Any:
    """Single runs on all kinds of systems, among them those that the method refuses."""
    return {name: tried(Run(method, name)) for name in WIDE.split()}


@cases(RUNS)
def outputs(run: Run) -> Any:
    """Times between the steps, few outputs, none, and the dense output."""
    code = """
        run(t_eval=run.times)
        run(t_eval=np.linspace(*run.ends, 57))
        run(t_eval=[run.ends[0], run.ends[0]])
        run(t_eval=[])
        run(save_every=3)
        seen(run(dense_output=True))
        seen(run(dense_output=True, t_eval=run.times))
        solve(run.system, run.method, (1.5, 1.5), dense_output=True)
    """
    return answers(code, run=run)


@cases(RUNS)
def backwards(run: Run) -> Any:
    """Runs to an end before the start."""
    code = """
        run()
        run(t_eval=run.times)
        seen(run(dense_output=True))
        run(y0=run.batch, t_eval=run.times)
    """
    return answers(code, run=replace(run, backwards=True))


@cases(RUNS)
def batches(run: Run) -> Any:
    """Batches of several shapes."""
    code = """
        run(y0=run.batch)
        run(y0=run.batch[:4].reshape(2, 2, -1), t_eval=run.times)
        seen(run(y0=run.batch[:2], dense_output=True))
        run(y0=run.batch[:1], t_eval=run.times[-1:])
        run(y0=run.batch[1].tolist(), t_eval=run.times[-1:])
        run(y0=np.ones(run.batch.shape[1:], dtype=int), t_eval=run.times[-1:])
    """
    return answers(code, run=run)


@cases(METHODS)
def events(method: str) -> Any:
    """Events that end a run and others, both ways through zero, sampled finely and not at all."""
    run = Run(method, own(method)[0], 30.4 if method in FLOWS else 90.4)
    code = """
        run(events=crosses)
        run(events=event(crosses, direction=1), t_eval=[])
        run(events=event(crosses, direction=-1), t_eval=run.times)
        run(events=event(crosses, terminal=True))
        seen(run(events=event(crosses, terminal=2), dense_output=True))
        run(events=[crosses, late], save_every=10)
        run(events=crosses, event_step=0.3 * run.system.dt, t_eval=[])
        replace(run, backwards=True)(events=[crosses, late])
        run(events=[], t_eval=run.times[-1:])
        run(y0=tensor(run.system.y0), events=late)
    """
    level, (t0, t1) = 0.8 * float(run.system.y0[0]), run.ends
    late = event(lambda t, y: t - t0 - 0.4321 * (t1 - t0), terminal=True)
    return answers(code, run=run, crosses=lambda t, y: y[0] - level, late=late)


@cases(RUNS)
def single_precision(run: Run) -> Any:
    """Runs in float32."""
    code = """
        run(dtype="float32")
        run(dtype="float32", t_eval=run.times)
        run(dtype=np.float32, y0=run.batch, t_eval=run.times[-1:])
        replace(run, backwards=True)(dtype="float32", t_eval=run.times[:1])
    """
    return answers(code, run=run)


@cases(RUNS)
def tensors(run: Run) -> Any:
    """Tensors, with gradients through the run."""
    code = """
        sloped(run, y0)
        sloped(partial(run, t_eval=run.times), y0)
        sloped(partial(run, t_eval=run.times), run.batch[:3])
        sloped(run, y0, dense=True)
        sloped(partial(run, t_eval=run.times), y0, torch.float32)
        run(y0=tensor(y0))
    """
    return answers(code, run=replace(run, steps=6.4), y0=run.system.y0)


@cases(RUNS | {f"{m} on numba": Run(m, "numba") for m in METHODS})
def backends(run: Run) -> Any:
    """Array operations and compiled loops, and compensated sums."""
    code = """
        backend="array"
        backend="compiled"
        backend="array", y0=run.batch, t_eval=run.times
        backend="compiled", y0=run.batch, t_eval=run.times
        backend="compiled", dtype="float32"
    """
    if "compensated" in get(run.method).options() and run.name != "numba":  # for which it would be compiled anew
        code += """
        backend="array", compensated=True
        backend="compiled", compensated=True
        backend="compiled", compensated=True, y0=run.batch, t_eval=run.times
        compensated=True, dense_output=True
        """
    return answers(code, "run({})", run=run)


WRONG_OPTIONS = """
    dt=0
    dt=-0.1
    dt=nan
    dt="a"
    dt=True
    dt=1e-300
    dt=1e200
    dt=np.float32(0.01)
    dt=np.int64(1)
    compensated="yes"
    compensated=1
    rtol=-1
    rtol=nan
    rtol="a"
    rtol=0.0
    rtol=0.0, atol=0.0
    rtol=1e-20
    rtol=0.1
    atol=inf
    atol=[1e-3]
    max_step=0
    max_step="a"
    max_step=0.01
    first_step=-1
    first_step=0.001
    max_num_steps=0
    max_num_steps=1.5
    max_num_steps=2**31
    max_num_steps=3
    max_order=0
    max_order=2
    max_order=10**9
    parts=3
    parts="p**2/2"
    parts=()
    parts=("p1**2/2", "q1")
    parts=("p1**2/2 + nonsense",)
    shift=nan
    shift="a"
    shift=1e300
    shift=-1e9
    shift=2.5
    flow=3
    flow="nonsense"
    flow="henon_heiles-sympflow"
    flow="henon_heiles-mlp"
    flow="pendulum-sympflow"
    tol=nan
    tol="a"
    tol=1e-300
    tol=1e-3
    tol=1e-9
    tol=1e-3, flow="henon_heiles-sympflow"
    nonsense=1
    h=0.1
    max_stepp=0.1
"""


@cases(METHODS)
def options(method: str) -> Any:
    """Options of the method, mostly with values that will not do, and some that it has not."""
    known = (*get(method).options(), "nonsense", "h", "max_stepp")
    code = "\n".join(line for line in lines(WRONG_OPTIONS) if line.partition("=")[0] in known)
    one, end = getattr(S, own(method)[0]), Run(method, own(method)[0], 3.4).ends[1]
    return answers(code, "solve(one, method, (0, end), t_eval=[end], {})", one=one, method=method, end=end)


@cases(METHODS)
def failures(method: str) -> Any:
    """Runs that break down: singular solutions, too long steps, some of a batch, states that leave the domain."""
    code = """
        solve(S.boxed, method, (0, 4), t_eval=np.arange(5.0), on_domain_exit="warn")
        solve(S.boxed, method, (0, 4), t_eval=np.arange(5.0), on_domain_exit="stop")
        solve(S.boxed, method, (0, 4), [0.1 * S.boxed.y0, S.boxed.y0], t_eval=np.arange(5.0), on_domain_exit="stop")
        solve(S.henon_heiles, method, (0, 1), [5.0, 0.0, 0.0, 0.0], on_domain_exit="stop")
        solve(S.escape, method, (0, 9), t_eval=np.arange(10.0), **given)
        solve(S.escape, method, (0, 6), some, t_eval=[1.0, 6.0], **given)
        solve(S.henon_heiles, method, (0, 90), t_eval=[1.0, 50.0, 90.0], **long)
        solve(S.nonseparable, method, (0, 30), t_eval=[1.0, 30.0], **long)
        solve(S.fput, method, (0, 2), dtype="float32", backend="compiled")
    """
    if method in ("verlet", "implicit_midpoint", "rk45", "dopri5", "rk4", "log_leapfrog", "strang_parts", *FLOWS):
        code += """
        seen(solve(S.escape, method, (0, 6), dense_output=True, save_every=20, **given))
        solve(S.escape, method, (0, 6), tensor(S.escape.y0), t_eval=[1.0, 6.0], **given)
        solve(S.escape, method, (0, 6), t_eval=[], events=lambda t, y: y[0] - y[1] - 0.1, **given)
        solve(S.henon_heiles, method, (0, 90), 3 * states(S.henon_heiles), t_eval=[90.0], **long)
        sympflow.max_energy_error(solve(S.escape, method, (0, 6), **given))
        solve(S.escape, method, (0, 6), **given).raise_for_status()
        """
    given = (
        {"rtol": 1e-2, "atol": 1e-3}
        if method in SLOW
        else {"rtol": 1e-3, "atol": 1e-6}
        if "rtol" in get(method).options()
        else {}
    )
    long = {"dt": 3.0} if "dt" in get(method).options() and method not in FLOWS else given
    some = np.array([[0.0, 0.1, 0.1, 0.0], S.escape.y0, [1.5, 1.5, 0.0, 3.0]])
    return answers(code, method=method, given=given, long=long, some=some)


@cases(METHODS)
def anatomy(method: str) -> Any:
    """Integrators by themselves: what they say of themselves, and their steps, inverses, tangents and streams."""
    code = """
        made.step(one, 0.0, y0[0], h)
        made.step(one, 0.0, y0, h * np.array([1.0, -0.5, 0.25]))
        made.step(one, 0.0, tensor(y0), h)
        made.inverse(one, 0.0, y0[0], h)
        made.inverse(one, 0.0, y0, h * np.array([1.0, -0.5, 0.25]))
        made.tangent(one, 0.0, y0[0], np.asarray(h))
        made.tangent(one, 0.0, y0, h * np.array([1.0, -0.5, 0.25]))
        list(made.steps(one, Run(method, own(method)[0], 5.4).ends, one.y0))
        [made == cls(), hash(made) == hash(cls()), get(cls) is cls, get(method) is cls]
        [made, copy.copy(made), copy.deepcopy(made), pickle.loads(pickle.dumps(made))]
        [cls.name, cls.order, cls.symplectic, cls.trained, cls.compiles, cls.finds_events, cls.tangent_holds]
        [cls, cls.__doc__, cls.options(), str(inspect.signature(cls))]
        setattr(made, "dt", 1.0)
    """
    cls, one = get(method), getattr(S, own(method)[0])
    if issubclass(cls, FixedStep):
        code += """
        [made.step_length(one), cls.on_grid, cls.breakdown, getattr(cls, "scheme", None)]
        made.counting(one).evaluations(7, 3, 2, "array")
        """
    h = 0.7 * one.dt * (5 if method in FLOWS else 1)
    checks = {name: tried(cls().check, getattr(S, name)) for name in WIDE.split()}
    return answers(code, made=cls(), cls=cls, one=one, method=method, y0=states(one, 3), h=h) | {"check": checks}


@cases(METHODS)
def measures(method: str) -> Any:
    """Metrics of runs."""
    code = """
        [s.energy(), s.energy_error(), sympflow.energy_error(s, relative=False)]
        [sympflow.max_energy_error(s), sympflow.max_energy_error(m), sympflow.max_energy_error(m, relative=False)]
        sympflow.volume_error(s, over_time=True)
        sympflow.volume_error(m)
        sympflow.symplecticity_defect(m)
        sympflow.symplecticity_defect(s, scale=2.0)
        [sympflow.time_reversal_error(s), sympflow.time_reversal_error(m)]
        sympflow.reference_error(s, solve(run.system, "dop853", run.ends, t_eval=s.t, rtol=1e-9, atol=1e-12))
        sympflow.reference_error(s)
        [s.q, s.p, s.states, s.raise_for_status() is s]
        dict(s.to_scipy())
    """
    run = Run(method, own(method)[0], 4.4)
    return answers(code, run=run, s=run(), m=run(y0=states(run.system, 2)))


# what solve is given ----------------------------------------------------------------------------------------------

WRONG_ARGUMENTS = """
    y0=[nan, 0.0]
    y0=[inf, 0.0]
    y0=[[0.0, 1.0], [0.0, nan]]
    y0=[10**400, 0]
    y0=[1.0]
    y0=[[1.0, 2.0, 3.0]]
    y0=1.0
    y0=[]
    y0=np.empty((0, 2))
    y0=[[1.0], [1.0, 2.0]]
    y0=[1j, 0.0]
    y0=["a", "b"]
    y0=b"ab"
    y0=[None, 0.0]
    y0=[True, False]
    y0={"q": 0.0}
    y0=int
    y0=np.ma.masked_array([1.0, 2.0], mask=[0, 1])
    y0=np.broadcast_to([1.0, 0.0], (10**9, 2))
    y0=tensor([1, 0])
    y0=tensor([1.0, nan])
    y0=tensor([1j, 0.0])
    y0=torch.zeros(2, dtype=torch.float16)
    y0=torch.zeros(2, dtype=torch.bfloat16)
    y0=torch.zeros(2).to_sparse()
    y0=torch.zeros(2, device="meta")
    y0=torch.zeros(2), dtype="float32"
    y0=[1e308, 0.0], dtype="float32"
    dtype="float16"
    dtype="nonsense"
    dtype=complex
    dtype=torch.float64
    t_span=(0, nan)
    t_span=(0, inf)
    t_span=(-1.7e308, 1.7e308)
    t_span=(0, 10**400)
    t_span=3.0
    t_span=(0, 1, 2)
    t_span=(0,)
    t_span=("a", "b")
    t_span="01"
    t_span={0, 1}
    t_span=(None, 1)
    t_span=(0, 1j)
    t_span=(1e17, 1e17 + 64)
    t_span=(0, 5e-324)
    t_span=np.array([0.0, 1.0])
    t_eval=[0.0, 2.0]
    t_eval=[0.0, inf]
    t_eval=[nan]
    t_eval=[0.5, 0.2]
    t_eval=[[0.5]]
    t_eval=0.5
    t_eval="abc"
    t_eval=[1j]
    t_eval=[None]
    t_eval={0.5}
    t_eval=[[0.0], [0.0, 1.0]]
    t_eval=np.ma.masked_array([0.0, 0.5], [0, 1])
    t_eval=tensor([0.25, 0.75])
    t_eval=np.broadcast_to(0.5, 10**10)
    t_eval=np.broadcast_to(0.5, 10**6), y0=np.zeros((1000, 2))
    t_eval=[0.5], save_every=2
    save_every=0
    save_every=1.5
    save_every=nan
    save_every=True
    save_every=np.int64(4)
    save_every=10**20
    dense_output="yes"
    dense_output=None
    dense_output=np.True_
    backend="gpu"
    backend=["array"]
    backend=None
    on_domain_exit="raise"
    on_domain_exit=True
    events=3
    events="y"
    events=[lambda t, y: 1.0, 1]
    events=lambda t, y: None
    events=lambda t, y: y
    events=lambda t, y: "a"
    events=lambda t, y: 1j
    events=lambda t, y: nan
    events=lambda t, y: 1 / 0
    events=lambda: 0.0
    events=event(lambda t, y: y[0], terminal=-1)
    events=event(lambda t, y: y[0], terminal=nan)
    events=event(lambda t, y: y[0], terminal="yes")
    events=event(lambda t, y: y[0], terminal=1.5)
    events=event(lambda t, y: y[0], terminal=3)
    events=event(lambda t, y: y[0], direction="up")
    events=event(lambda t, y: y[0], direction=nan)
    events=event(lambda t, y: y[0], direction=-0.5)
    events=lambda t, y: y[0], y0=np.ones((2, 2))
    event_step=0.1
    events=lambda t, y: y[0], event_step=nan
    events=lambda t, y: y[0], event_step=0
    events=lambda t, y: y[0], event_step=1e-300
    events=lambda t, y: y[0], event_step="a"
    events=lambda t, y: y[0], event_step=0.01
    dt=1e-9
    dt=1e-12, t_eval=[1.0]
    dt=1e-9, t_eval=[1.0], dense_output=True
"""


@cases(["verlet", "rk45", "dopri5", "sympflow", "implicit_midpoint"])
def arguments(method: str) -> Any:
    """Arguments of `solve` that will not do, and some that just do."""
    return answers(WRONG_ARGUMENTS, "call({})", call=lambda **k: solve(S.oscillator, method, **{"t_span": (0, 1), **k}))


@case
def naming_methods() -> Any:
    """The ways to name a method and a system, and what is none."""
    code = """
        solve(S.pendulum, "vertel")
        solve(S.pendulum, "")
        solve(S.pendulum, 3)
        solve(S.pendulum, None)
        solve(S.pendulum, ["verlet"])
        solve(S.pendulum, int)
        solve("pendulum", "verlet")
        solve(None, "verlet")
        solve(lambda t, y: y, "verlet")
        solve(S.pendulum)
        re.sub("wall_time': [^,}]+", "", repr(solve(S.pendulum)))
        solve(S.pendulum, get("verlet"), (0, 1), dt=0.1)
        solve(S.pendulum, get("verlet")(dt=0.1), (0, 1))
        solve(S.pendulum, get("verlet")(dt=0.1), (0, 1), dt=0.2)
        solve(S.pendulum, flow, (0, 5))
        solve(S.pendulum, flow, (0, 5), dt=0.3)
        solve(S.pendulum, flow, (0, 5), dt=30.0)
        solve(S.pendulum, flow, (0, 5), flow=flow)
        solve(S.oscillator, flow)
        solve(S.henon_heiles, flow)
        solve(S.bare, "verlet", (0, 1))
        solve(S.bare, "verlet", (0, 1), y0=[1.0, 0.0])
        get("nonsense")
        get(3)
        sympflow.available()
    """
    return answers(code, flow=shipped_flows(S.pendulum)[0].load(S.pendulum))


@case
def many_steps() -> Any:
    """Runs of many steps, in batches that fill the lanes and the threads."""
    code = """
        "verlet", (0, 200)
        "srkn11b", (0, 200)
        "omelyan4", (0, 200)
        "implicit_midpoint", (0, 200)
        "strang_parts", (0, 200)
        "sympflow", (0, 280)
    """
    y0 = S.henon_heiles.domain.sample(131, seed=3)
    found = {
        n: answers(code, f"solve(S.henon_heiles, {{}}, {n}, t_eval=[50.0, 123.4, 200.0])", y0=y0)
        for n in ("y0", "None")
    }
    log = "solve(S.kepler, method, (0, 60), states(S.kepler, 21), t_eval=[20.0, 60.0])"
    return found | {m: answers(log, method=m) for m in ("log_leapfrog", "log_kahan_li8", "sympflow")}


# systems ----------------------------------------------------------------------------------------------------------


@cases([*(f"S.{name}" for name in Systems.MADE), *(f"systems.SYSTEMS[{name!r}]()" for name in systems.SYSTEMS)])
def definition(made: str) -> Any:
    """H, its derivatives and its scene, of arrays and tensors, single and batched."""
    code = """
        [one, one.name, one.ndof, one.separable, one.quadratic_kinetic, one.params, one.y0, one.dt, one.t_span]
        [one.inverse_mass, one.stiffness_matrix, one.energy_scale, one.fingerprint, one.numba_functions is None]
        one(0.0, y)
        one.potential_hessian(q)
        one.potential_hessian(tensor(q))
        one.kinetic_hessian(p)
        one.kinetic_hessian(tensor(p))
        one.hessian_vector(q, p)
        one.hessian_vector(tensor(q), tensor(p))
        one.curvature(q)
        one.curvature(tensor(q))
        one.curvature_gradient(q)
        one.curvature_gradient(tensor(q))
        [one.linear_part.frequencies, one.linear_part.modes, one.linear_part.inverse_modes, one.linear_part.kinds]
        [one.linear_part.squared_frequencies, one.linear_part.rates, one.linear_part.classes, one.linear_part.stiffness]
        [one.domain.to_dict(), one.domain.width, one.domain.sample(20, seed=1)]
        [one.domain.contains(1.2 * one.domain.sample(20)), one.domain.contains(one.domain.sample(20), slack=0.01)]
        one.domain.contains(q)
        one.domain.sample(-1)
    """
    for f in ("hamiltonian", "gradient", "hessian", "vector_field"):
        code += "".join(f"one.{f}({x})\n" for x in ("y", "y[0]", "tensor(y)", "y.astype('f4')", "q"))
    for f, x in (("potential", "q"), ("force", "q"), ("kinetic", "p"), ("velocity", "p")):
        code += f"one.{f}({x})\none.{f}({x}[0])\none.{f}(tensor({x}))\n"
    code += "one.potential(y)\none.force(y)\n"
    one = eval(made)
    y = states(one, 3) if one.y0 is not None else np.ones((3, 2 * one.ndof))
    return answers(code, one=one, y=y, q=y[:, : one.ndof], p=y[:, one.ndof :])


CONSTRUCTIONS = """
    symbolic("p**2/2 + q^4/4")
    symbolic("p**2/2 +")
    symbolic("q**2/2 + p**2/2 + t*q")
    symbolic("p**2/2 + w*q**2")
    symbolic("p1**2/2 + q1*q3")
    symbolic("")
    symbolic("1")
    symbolic("p**2/2 + foo(q)")
    symbolic("q.__class__")
    symbolic("9**9**9**9")
    symbolic("q/0 + p")
    symbolic("besselj(0, q) + p**2/2").force(tensor([0.3]))
    symbolic("q**1001 + p")
    symbolic("Piecewise((q, q > 0), (0, True)) + p**2").force(np.array([0.3]))
    symbolic(None)
    symbolic(3)
    symbolic(["p"])
    symbolic("p**2/2 + w*q**2", params={"w": "a"})
    symbolic("p**2/2 + w*q**2", params={"w": 2, "v": 1}, name="spring")
    symbolic("p**2/2 + q**2", y0=[1.0])
    symbolic("p**2/2 + q**2", domain="box")
    symbolic("p**2/2 + q**2", domain=Box([-1] * 4, [1] * 4))
    symbolic("p**2/2 + q**2", t_span=3)
    symbolic("p**2/2 + q**2", dt=-1)
    symbolic("p**2/2 + q**2", energy_scale=0)
    symbolic("p**2/2 + q**2", domain=EnergySublevel(-1.0, Box([-1, -1], [1, 1])))
    HamiltonianSystem(plain_potential)
    HamiltonianSystem(plain_potential, ndof=0)
    HamiltonianSystem(plain_potential, ndof=1.5)
    HamiltonianSystem(ndof=2)
    HamiltonianSystem(plain_potential, hamiltonian=torch_hamiltonian, ndof=2)
    HamiltonianSystem(3, ndof=2)
    HamiltonianSystem(hamiltonian=torch_hamiltonian, ndof=2, mass=2.0)
    HamiltonianSystem(hamiltonian=torch_hamiltonian, ndof=2, stiffness_matrix=np.eye(2))
    HamiltonianSystem(plain_potential, ndof=2, mass=-1.0)
    HamiltonianSystem(plain_potential, ndof=2, mass=[1.0])
    HamiltonianSystem(plain_potential, ndof=2, mass=[[1.0, 2.0], [0.0, 1.0]])
    HamiltonianSystem(plain_potential, ndof=2, mass=[[1.0, 2.0], [2.0, 1.0]])
    HamiltonianSystem(plain_potential, ndof=2, mass="a")
    HamiltonianSystem(plain_potential, ndof=2, stiffness_matrix=1.0)
    HamiltonianSystem(plain_potential, ndof=2, stiffness_matrix=[[0, 1], [2, 0]])
    HamiltonianSystem(plain_potential, ndof=2, stiffness_matrix="a")
    HamiltonianSystem(plain_potential, gradient=lambda q: q[..., :1], ndof=2).force(np.ones(2))
    HamiltonianSystem(plain_potential, gradient=lambda q: 1j * q, ndof=2).force(np.ones(2))
    HamiltonianSystem(plain_potential, gradient=lambda q: q.__imul__(2), ndof=2).force(np.ones(2))
    HamiltonianSystem(plain_potential, gradient=plain_gradient, ndof=2).potential_hessian(np.ones(2))
    HamiltonianSystem(chain_potential, gradient=chain_gradient, ndof=2).potential_hessian(np.ones(2))
    HamiltonianSystem(lambda q: np.sin(q), ndof=1).force(np.ones(1))
    HamiltonianSystem(lambda q: q, ndof=1).potential(torch.ones(1))
    HamiltonianSystem(lambda q: None, ndof=1).potential(np.ones(1))
    HamiltonianSystem(hamiltonian=lambda q: q, ndof=1).gradient(np.ones(2))
    Box([0, 0], [1])
    Box([1, 1], [0, 0])
    Box([0, nan], [1, 1])
    Ball(-1.0, [0.0, 0.0])
    Ball([0.0, 0.0], -1.0)
    Ball([0.0, 0.0], 2.0).sample(4, 1)
    EnergySublevel(1.0, 3)
    EnergySublevel(nan, Box([-1, -1], [1, 1]))
    EnergySublevel(1.0, Box([-1, -1], [1, 1])).sample(3)
    EnergySublevel(1.0, Box([-1, -1], [1, 1]), above=2.0)
    Tube([[0.0, 1.0]], 0.1)
    Tube([[0.0, 1.0], [1.0, 0.0]], -0.1)
    Tube(np.eye(4), 0.1, groups=[[0, 1], [1, 2]])
    time_transformed(S.nonseparable)
    time_transformed(S.kepler, "a")
    systems.kepler(1.5)
    systems.fput(-1.0)
    systems.fput(50.0, m=0)
    systems.toda_lattice(1)
    systems.spring_pendulum(k=-1.0)
    systems.spring_pendulum(coordinates="round")
    systems.harmonic_oscillator(0.0)
    systems.nonseparable(-1.0)
    systems.double_well(2.0)
    systems.henon_heiles_escape(0.1)
    systems.pairs.pair_functions(3, np.eye(2), dimension=2)
    sympflow.nonsense
"""


@case
def constructions() -> Any:
    """Systems and domains that cannot be made, and some that can."""
    return answers(CONSTRUCTIONS)


@case
def truths() -> Any:
    """Tubes, logarithmic Hamiltonians, and what is known of the scenes."""
    code = """
        [Tube(orbit, 0.05).sample(30, 2), Tube(orbit, 0.05).contains(1.02 * orbit), Tube(orbit, 0.05).width]
        Tube(orbit, [0.1] * 4, groups=[[0, 2], [1, 3]]).sample(30, 2)
        Tube(orbit, [0.1] * 4, groups=[[0, 2], [1, 3]]).to_dict()
        [time_transformed(S.kepler), time_transformed(S.kepler).params, time_transformed(S.kepler, 0.5).params]
        [time_transformed(S.kepler).hamiltonian(x), time_transformed(S.kepler, 0.5).vector_field(x)]
        [time_transformed(S.functions, 3.0), time_transformed(S.functions, 3.0).hessian(x)]
        systems.oscillatory_energies(S.fput, S.fput.y0)
        systems.lax_eigenvalues(S.toda.y0)
        systems.kepler_ellipse(0.6, np.linspace(0, 6, 5))
    """
    orbit = solve(S.quartic, "kahan_li8", (0, 5), dt=0.05).states
    return answers(code, orbit=orbit, x=np.array([1.0, 0.1, 0.0, 0.1, 0.9, 2.6]))


@cases(SCHEMES)
def table(scheme: Scheme) -> Any:
    """A scheme: its numbers, what it costs, and its inverse."""
    code = """
        s
        [s.substeps, s.symmetric, s.first_same_as_last, s.level, s.force_evaluations, s.hessian_evaluations]
        [s.inverse(), s.inverse().substeps, s == s.inverse().inverse(), repr(s)]
        Scheme(s.name, 1, s.kicks, s.drifts, (), "")
        Scheme(s.name, 1, s.kicks, s.drifts, s.gradients, "", curvatures=(1.0,) * 99)
        Scheme(s.name, 1, s.kicks, s.drifts, s.gradients, "", polynomials=((1.0,),), monomials=((2,),))
    """
    return answers(code, s=scheme)


# flows ------------------------------------------------------------------------------------------------------------


SAID = "kind ndof dt n_parameters system_name fingerprint recipe figures certified history"


def about(flow: Any) -> dict[str, Any]:
    """Note all that a flow says of itself, and its weights."""
    found: dict[str, Any] = {name: getattr(flow, name) for name in SAID.split()} | {"flow": flow, "class": type(flow)}
    found["domain"] = None if flow.domain is None else flow.domain.to_dict()
    found |= {"architecture": flow.architecture(), "weights": dict(flow.state_dict()), "dtype": str(flow.dtype)}
    return found | {"trainable": [w.requires_grad for w in flow.parameters()]}


def as_map(flow: Any, x: Tensor) -> dict[str, Any]:
    """A flow as a map: at all kinds of times, with its inverse, velocity and Hamiltonian, and their gradients."""
    code = """
        flow(torch.zeros(7, dtype=x.dtype), x)
        flow(nan, x)
        flow(tensor(inf), x)
        flow("a", x)
        flow(None, x)
        flow(1j, x)
        flow(dt, x.numpy())
        flow(dt, x[..., 1:])
        flow(dt, x.half())
        flow(dt, None)
        flow(1.2 * dt, x[0])
        flow.velocity(1.5 * dt, x)
        flow.hamiltonian(1.5 * dt, x)
        flow.psi_and_velocity(inside, x)
    """
    for t in ("0.0", "0.37 * dt", "dt", "2.6 * dt", "-1.4 * dt", "anywhere", "inside"):
        code += f"flow({t}, x)\nflow.inverse({t}, x)\n"
    for t in ("0.0", "0.37 * dt", "dt", "inside"):
        code += "".join(f"flow.{f}({t}, x)\n" for f in ("psi", "psi_inverse", "velocity", "hamiltonian"))
    code += "".join(f"slopes(flow.{f})\n" for f in ("psi", "inverse", "velocity", "hamiltonian", "forward"))

    def slopes(function: Callable[..., Tensor]) -> Any:
        t, y = (v.detach().clone().requires_grad_(True) for v in (inside[2], x[:2]))
        value = function(t, y)
        return torch.autograd.grad((value * torch.arange(1, value.numel() + 1).reshape(value.shape)).sum(), (t, y))

    dt = flow.dt
    inside, anywhere = (dt * torch.linspace(a, b, len(x), dtype=x.dtype) for a, b in ((0.0, 1.0), (-1.3, 2.4)))
    return answers(code, flow=flow, x=x, dt=dt, inside=inside, anywhere=anywhere, slopes=slopes)


def as_method(one: HamiltonianSystem, method: Any, step: float, **chosen: Any) -> dict[str, Any]:
    """A system solved with a flow, in the ways that `solve` has."""
    code = """
        run()
        run(t_eval=between(*ends))
        run(t_eval=np.linspace(*ends, 41))
        run(ends[::-1], t_eval=between(*ends[::-1]))
        run(events=event(lambda t, y: t - sum(ends) / 2 + 1e-3 * y[0], terminal=True))
        run(backend="array", t_eval=between(*ends))
        run(dt=0.6 * step)
        sloped(run, one.y0)
        run(dtype="float32", t_eval=between(*ends))
        run(y0=1.5 * one.y0, on_domain_exit="ignore", t_eval=[ends[1]])
        run(y0=1.1 * one.y0, on_domain_exit="stop")
    """
    if one.numba_functions is None:  # which would be compiled anew, in a quarter of a minute
        code += """
        run(y0=y0, t_eval=between(*ends))
        run(compensated=True)
        seen(run(dense_output=True))
        """
    ends, y0 = (0.3, 0.3 + 6.4 * step), one.y0 * np.linspace(0.97, 1.0, 4)[:, None]

    def run(t_span: Any = ends, **given: Any) -> Solution:
        return solve(one, method, t_span, **chosen | given)

    return answers(code, run=run, ends=ends, one=one, step=step, y0=y0)


def frozen(flow: Any) -> dict[str, Any]:
    """The numbers of a primed flow at several times, and its parts as maps."""
    code = """
        flow.evaluations(10, 3, 2, "compiled")
        [flow.prepare(0.4 * flow.dt, x), flow.kernel_step(0.4 * flow.dt, x), flow.finish(0.4 * flow.dt, x)]
    """
    for t in ("", "0.3 * flow.dt", "1.5 * flow.dt", "'a'"):
        code += f"flow.scheme({t})\nflow.kernel_scheme({t})\nflow.processor_scheme({t})\n"
    return answers(code, flow=flow, x=tensor(states(flow.system), dtype=flow.dtype))


HOMES = "henon_heiles pendulum quartic kepler oscillator oscillator_100 fput fput_1000 polar planets"


@cases([flow.name for flow in shipped_flows()])
def shipped(name: str) -> Any:
    """A flow that ships: its record, its certificate, its map, its file, and its system solved with it."""
    homes = (getattr(S, home) for home in HOMES.split())
    one, entry = next((one, f) for one in homes for f in shipped_flows(one) if f.name == name)
    flow = entry.load(one)
    x = one.y0 * np.linspace(0.98, 1.0, 5)[:, None]
    if flow.ndof > one.ndof:  # of a flow in another time, which is a coordinate then
        d, B = one.ndof, entry.shift - one.hamiltonian(x)
        x = np.column_stack([x[:, :d], np.zeros(5), x[:, d:], B])
    code = """
        [entry, repr(entry), str(entry.training_seconds)]
        [str(flow.certified), flow.certified.to_dict(), [flow.certified.bound(t) for t in (0.0, 1.0, -33.3, 1e4)]]
        about(flow)
        as_map(flow, tensor(x))
        saved(flow)
        as_method(one, kind, entry.dt, flow=name)
        solve(one, flow, (0.3, 0.3 + 6.4 * entry.dt))
        entry.load()
        entry.load(S.toda)
    """
    code += "frozen(flow)" if hasattr(flow, "kernel_scheme") else ""
    return answers(code, entry=entry, flow=flow, x=x, one=one, name=name, kind=entry.kind)


@case
def catalogue() -> Any:
    """The flows that ship, as tables, and the choice by accuracy."""
    code = """
        shipped_flows().table()
        repr(shipped_flows(kind="mlp"))
        shipped_flows()[3:5].table()
        [" | ".join(row) for row in shipped_flows().rows()]
        shipped_flows("pendulum")
        shipped_flows(kind="primed")
        shipped_flows()[100]
        solve(S.kepler, "sympflow", (0, 3), tensor(S.kepler.y0), tol=1e-6)
        solve(systems.kepler(0.1), "sympflow", (0, 3), tol=1e-6)
    """
    for name in ("henon_heiles", "pendulum", "quartic", "kepler", "oscillator", "fput", "toda"):
        code += f"shipped_flows(S.{name}).table()\n"
        for tol in ("1e-3", "1e-6", "1e-8", "1e-12"):
            code += f"solve(S.{name}, 'sympflow', (0, 10), t_eval=[3.3, 10.0], tol={tol})\n"
    return answers(code)


class Shear(Potential):
    """V(t, x) = c·sin(t)·|x|²/2: a potential of a user's own."""

    def __init__(self) -> None:
        super().__init__()
        self.ndof, self.c = 1, nn.Parameter(torch.full((), 1.1, dtype=torch.float64))

    def impulse(self, t, x):
        return self.c * torch.sin(torch.as_tensor(t, dtype=x.dtype)) * x

    def impulse_and_rate(self, t, x):
        return self.impulse(t, x), self.c * torch.cos(torch.as_tensor(t, dtype=x.dtype)) * (x * x).sum(0) / 2

    def impulse_and_tangent(self, t, x, dx):
        time = torch.as_tensor(t, dtype=x.dtype)
        return self.impulse(t, x), self.c * (torch.cos(time) * x + torch.sin(time) * dx)

    def to_dict(self):
        return {"kind": "shear"}


def mixed_layers() -> SympFlow:
    """A flow of layers in an order of its own, with potentials of two kinds."""
    first, second = (torch.Generator().manual_seed(seed) for seed in (1, 2))
    layers = [
        Drift(MLPPotential(1, (3,), generator=first)),
        Kick(MLPPotential(1, (4, 5), "softplus", generator=second)),
    ]
    return SympFlow.from_layers([*layers, Kick(Shear()), Drift(Shear())], dt=0.8)


OWN_TABLE = Scheme("own", 2, (0.5, 0.5), (1.0, 0.0), (0.01, 0.01), "a table of one's own")
primed, split = SympFlow.primed, SympFlow.split
FLOWS_OF = """
    henon_heiles: SympFlow(2)
    henon_heiles: SympFlow(2, pairs=2, hidden=(5, 4, 3), activation="sin", dt=0.5, seed=3)
    pendulum: SympFlow(1, 1, (3,), "sigmoid", dt=0.5)
    pendulum: SympFlow(1, 1, (3, 3), "logcosh", dt=0.5)
    henon_heiles: SympFlow(2, hidden=(4,), scale=Scaling((0.1, 2.0), (3.0, 4.0), 0.1, (0.5, 0.0)))
    henon_heiles: SympFlow(2, dtype=torch.float32)
    pendulum: mixed_layers()
    henon_heiles: MLPFlow(2)
    henon_heiles: MLPFlow(2, (5, 6, 7), activation="logcosh", dt=0.5, seed=2)
    pendulum: MLPFlow.matching(SympFlow(1, pairs=2, hidden=(8,), dt=0.7))
    henon_heiles: primed(S.henon_heiles)
    henon_heiles: primed(S.henon_heiles, 3, first="kick", dt=0.5)
    pendulum: primed(S.pendulum, 3, palindromic=False, dt=0.5)
    henon_heiles: primed(S.henon_heiles, 2, processor=3, dt=0.7)
    henon_heiles: primed(S.henon_heiles, 2, processor=2, curvature=True, dt=0.7)
    pendulum: primed(S.pendulum, 2, curvature=True, first="kick", dt=0.5)
    quartic: primed(S.quartic, 3, processor=2, polynomial=4, first="kick", dt=0.5)
    pendulum: primed(S.pendulum, 2, polynomial=6, palindromic=False, dt=0.5)
    henon_heiles: primed(S.henon_heiles, 3, force_gradient=False, degree=3, dt=0.5)
    henon_heiles: primed(S.henon_heiles, scheme="chin4a", dt=0.5)
    kepler: primed(S.kepler, scheme="kahan_li8", force_gradient=False, dt=0.05)
    henon_heiles: primed(S.henon_heiles, scheme=OWN_TABLE, dt=0.4)
    relativistic: primed(S.relativistic, 2, processor=1, dt=0.5)
    masses: primed(S.masses, 2, processor=1, dt=0.3)
    numba: primed(S.numba, 2, processor=1, dt=0.3)
    functions: primed(S.functions, 2, dt=0.3)
    torch: primed(S.torch, 2, dt=0.3)
    henon_heiles: primed(S.henon_heiles, 2, processor=1, dt=0.5, dtype=torch.float32)
    henon_heiles: split(S.henon_heiles, 3, dt=0.7)
    fput: split(S.fput, 2, dt=0.1, terms=4)
    polar: split(S.polar, 2, dt=0.01, terms=3)
    henon_heiles: split(S.henon_heiles, 2, dt=0.7, filters=False, force_gradient=False)
    henon_heiles: split(S.henon_heiles, 3, dt=0.7, linear_outside=False, force_gradient=(1, 2))
    pendulum: split(S.pendulum, 2, dt=0.3, parts=("1 - cos(q1)", "p1**2/2"))
    stiff: split(S.stiff, 2, dt=0.2)
"""


def shaken(flow: Any, by: float = 0.02) -> Any:
    """The flow with its numbers moved a little, so that none is special."""
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for w in flow.parameters():
            w.add_(by * torch.randn(w.shape, generator=generator, dtype=torch.float64).to(w.dtype))
    return flow


@cases(lines(FLOWS_OF))
def made(line: str) -> Any:
    """A flow made by hand: as a map, in its file, in `solve`, in another precision, and with a certificate."""
    name, _, maker = line.partition(": ")
    code = """
        make()
        about(flow)
        as_map(flow, x)
        saved(flow)
        as_method(one, flow.requires_grad_(False), flow.dt)
        copy.deepcopy(flow)(0.3 * flow.dt, x)
        copy.deepcopy(flow).float()(0.3 * flow.dt, x.float())
        [flow.check_system(S.henon_heiles), flow.check_system(S.boxed)]
        [flow.check_system(S.pendulum), flow.check_system(S.oscillator)]
        (c := flow.certificate(one, states=20, times=4, held_out=3, t_end=3 * flow.dt), str(c))
        saved(flow)["digests"]
        saved(shaken(flow))["digests"]
    """
    make, one = partial(eval, maker), getattr(S, name)
    flow = shaken(make())
    code += "frozen(flow)" if hasattr(flow, "kernel_scheme") else ""
    return answers(code, make=make, flow=flow, one=one, x=tensor(states(one), dtype=flow.dtype))


WRONG_FLOWS = """
    SympFlow(0)
    SympFlow(1.5)
    SympFlow("a")
    SympFlow(True)
    SympFlow(1, dt=0)
    SympFlow(1, dt=nan)
    SympFlow(1, dt="a")
    SympFlow(1, dt=1e-30)
    SympFlow(1, dt=True)
    SympFlow(1, pairs=0)
    SympFlow(1, pairs=1.5)
    SympFlow(1, hidden=())
    SympFlow(1, hidden=3)
    SympFlow(1, hidden=(0,))
    SympFlow(1, hidden=(2.5,))
    SympFlow(1, hidden="ab")
    SympFlow(1, activation="step")
    SympFlow(1, dtype="float64")
    SympFlow(1, dtype=torch.int64)
    SympFlow(1, device="nowhere")
    SympFlow(2, scale=Scaling.unit(1))
    Scaling((1.0,), (-1.0,))
    SympFlow.from_layers([], dt=1.0)
    SympFlow.from_layers([Kick(MLPPotential(1)), Drift(MLPPotential(2))], dt=1.0)
    MLPFlow(1, hidden=())
    MLPFlow.matching(SympFlow(1, pairs=1, hidden=(1,)))
    MLPFlow(1)(-0.5, torch.ones(1, 2, dtype=torch.float64))
    MLPFlow(1).inverse(0.5, torch.ones(1, 2, dtype=torch.float64))
    MLPFlow(1).certificate(S.pendulum)
    SympFlow(1).certificate(S.bare)
    SympFlow(1).certificate(S.henon_heiles)
    SympFlow(1).certificate(S.pendulum, states=0)
    SympFlow(1).certificate("pendulum")
    SympFlow(1).save(3)
    SympFlow(1).save("/dev/null/flow.safetensors")
    load(3)
    load("/dev/null/flow.safetensors")
    primed(None, 3)
    primed(S.nonseparable, 3)
    primed(S.henon_heiles, 0)
    primed(S.henon_heiles, 3, scheme="verlet")
    primed(S.henon_heiles, scheme="rk4")
    primed(S.henon_heiles, scheme=3)
    primed(S.henon_heiles, first="p")
    primed(S.henon_heiles, scheme="verlet", first="kick")
    primed(S.henon_heiles, degree=0)
    primed(S.henon_heiles, degree=1, processor=2)
    primed(S.henon_heiles, scheme="chin4a", force_gradient=False)
    primed(S.henon_heiles, dt=-1.0)
    primed(S.henon_heiles, processor=-1)
    primed(S.henon_heiles, polynomial=0)
    primed(S.henon_heiles, polynomial=True)
    primed(S.henon_heiles, polynomial=20)
    primed(S.henon_heiles, polynomial=4, curvature=True)
    primed(S.henon_heiles, polynomial=4, scheme="chin4a")
    primed(S.henon_heiles, palindromic="yes")
    primed(S.henon_heiles, curvature=2)
    primed(S.henon_heiles, force_gradient="x")
    primed(S.henon_heiles, curvature=True, force_gradient=False)
    primed(S.functions, 2, curvature=True)
    primed(S.relativistic, 2, force_gradient=True)
    primed(S.relativistic, scheme="srkn6b")
    split(None)
    split(S.nonseparable)
    split(S.functions)
    split(S.henon_heiles, stages=0)
    split(S.henon_heiles, terms=0)
    split(S.henon_heiles, dt="a")
    split(S.henon_heiles, filters=3)
    split(S.henon_heiles, force_gradient=(7,))
    split(S.henon_heiles, force_gradient=(0,))
    split(S.henon_heiles, parts="p")
    split(S.henon_heiles, parts=("p1**2/2",))
    split(S.henon_heiles, linear_outside=None)
"""


@case
def wrong_flows() -> Any:
    """Flows that cannot be made, saved, or asked for what they have not."""
    return answers(WRONG_FLOWS)


@case
def files_of_flows() -> Any:
    """Files of flows: damaged, and read without a system, with it, and with another."""
    damage = r"""
        b""
        whole[:7]
        whole[:-3]
        whole + b"1"
        b"not a flow at all, but a text of some length"
        whole[:-4] + bytes([whole[-4] ^ 1]) + whole[-3:]
        whole.replace(rb'\"format\":1', rb'\"format\":9')
        whole.replace(rb'\"kind\":\"sympflow\"', rb'\"kind\":\"symp_low\"')
        whole.replace(rb'\"dt\":0.5', rb'\"dt\":0.6')
        whole.replace(rb'\"degree\":7', rb'\"degree\":5')
    """
    code = """
        bare
        bare(0.3, y)
        bare.scheme()
        bare.system
        load(path, system=S.henon_heiles)
        load(path, system="pendulum")
        load(path, device="nowhere")
        load(path.parent)
        bare.bind(S.quartic)
        solve(S.pendulum, load(path), (0, 2))
        solve(S.quartic, load(path), (0, 2))
        bare.bind(S.pendulum)(0.3, y)
        nn.init.constant_(next(flow.parameters()), nan) is None or flow.save(path)
    """
    with folder() as place:
        path, flow = place / "flow.safetensors", primed(S.pendulum, 2, dt=0.5)
        flow.save(path)
        whole = path.read_bytes()
        damaged = answers(damage, "path.write_bytes({}) and load(path)", path=path, whole=whole)
        path.write_bytes(whole)
        names = {"path": path, "flow": flow, "bare": load(path), "y": tensor(S.pendulum.y0)}
        return {"damaged": damaged, "whole": answers(code, **names)}


# training ---------------------------------------------------------------------------------------------------------

QUICK = {"points": 40, "reference_states": 6, "progress": False}
SEARCH = {**QUICK, "restarts": 2, "steps": 6, "label_times": 3}
HELD = {**QUICK, "validation_points": 40}
NET = {**HELD, "pairs": 1, "hidden": (4,)}
NEWTON = {"kind": "sympflow", "optimizer": "gauss-newton"}
TRAININGS = """
    pendulum, flow=primed(S.pendulum, 3, palindromic=False, dt=0.5), **SEARCH
    henon_heiles, flow=primed(S.henon_heiles, 2, processor=3, dt=0.7), **SEARCH
    henon_heiles, flow=primed(S.henon_heiles, 2, processor=2, curvature=True, dt=0.7), energy_weight=0.0, **SEARCH
    quartic, flow=primed(S.quartic, 3, processor=2, polynomial=4, first="kick", dt=0.5), **SEARCH
    pendulum, dt=0.5, **SEARCH
    pendulum, stages=2, processor=1, seed=3, **SEARCH
    kepler, dt=0.05, stages=2, processor=2, **SEARCH
    masses, flow=primed(S.masses, 2, processor=1, dt=0.3), domain=Box([-0.5] * 4, [0.5] * 4), **SEARCH
    numba, flow=primed(S.numba, 2, processor=1, dt=0.3), **SEARCH
    pendulum, flow=primed(S.pendulum, 3, dt=0.5), loss="labels+residual", frozen_weight=2.0, **SEARCH
    pendulum, stages=2, loss="matching+labels", matching_weight=0.3, **SEARCH
    pendulum, stages=2, data=labels(S.pendulum, 0.5), dt=0.5, restarts=2, steps=6, progress=False
    relativistic, flow=primed(S.relativistic, 2, dt=0.5), optimizer="bfgs", steps=2, **HELD
    henon_heiles, flow=split(S.henon_heiles, 3, dt=0.7), **SEARCH
    fput, flow=split(S.fput, 2, dt=0.1, terms=4), **SEARCH
    polar, flow=split(S.polar, 2, dt=0.01, terms=3), **SEARCH
    henon_heiles, flow=split(S.henon_heiles, 2, dt=0.7), optimizer="adam", steps=3, **HELD
    oscillator, steps=8, validate_every=4, **NET
    pendulum, steps=8, schedule="cosine", learning_rate=0.02, clip=0.1, refresh=3, seed=5, **NET
    oscillator, steps=5, dtype=torch.float32, schedule="constant", clip=None, **NET
    nonseparable, dt=0.1, steps=5, activation="sin", matching_weight=0.2, matching_times=4, **NET
    oscillator, steps=5, label_weight=1.0, label_times=3, residual_weight=0.0, **NET
    oscillator, kind="sympflow", steps=2, **HELD
    oscillator, optimizer="lbfgs", steps=2, **NET
    henon_heiles, dt=0.5, optimizer="bfgs", steps=2, **NET
    pendulum, steps=4, **NEWTON, **NET
    oscillator, steps=6, refresh=2, **NEWTON, **NET
    oscillator, steps=3, matching_weight=0.5, loss="residual+matching", **NEWTON, **NET
    oscillator, kind="mlp", steps=5, **NET | {"hidden": (8,)}
    pendulum, kind="mlp", optimizer="gauss-newton", steps=3, **NET | {"hidden": (8,)}
    henon_heiles, flow=SympFlow(2, pairs=2, hidden=(5,), dt=0.5), optimizer="gauss-newton", steps=2, **HELD
    oscillator, data=labels(S.oscillator, 0.5), dt=0.5, steps=5, **NET
    pendulum, data=labels(S.pendulum, 0.5), dt=0.5, steps=3, **NEWTON, **NET
"""
RESUMED = """
    oscillator, steps=12, validate_every=3, checkpoint_every=2, **NET
    oscillator, optimizer="lbfgs", steps=6, validate_every=2, checkpoint_every=2, **NET
    pendulum, steps=6, validate_every=2, checkpoint_every=2, **NEWTON, **NET
    pendulum, stages=2, **SEARCH
    henon_heiles, flow=split(S.henon_heiles, 2, dt=0.7), **SEARCH
"""
WRONG_TRAININGS = """
    dt="1"
    dt=-1.0
    kind="nonsense"
    flow=3
    flow=SympFlow(1), pairs=2
    flow=SympFlow(1), dt=0.5
    flow=SympFlow(2)
    flow=shipped_flows(S.henon_heiles)[0].load()
    domain=3
    domain=Box([-1.0] * 4, [1.0] * 4)
    pairs=0
    hidden=()
    activation="step"
    device="nowhere"
    stages=0
    processor=-1
    optimizer="sgd"
    loss="nonsense"
    loss="labels+labels"
    optimizer="adam", steps=0
    points=0
    optimizer="adam", points=3
    optimizer="adam", residual_weight=-1.0
    optimizer="adam", residual_weight=0.0, matching_weight=0.0
    optimizer="adam", learning_rate=0
    optimizer="adam", schedule="steep"
    optimizer="adam", clip=-1
    optimizer="adam", refresh=0
    seed=-1
    seed=1.5
    restarts=0
    restarts=2, optimizer="adam"
    restarts=2, pairs=2
    label_times=0
    frozen_weight="1", stages=2
    energy_weight="1", stages=2
    time_budget="60"
    time_budget=True
    callback=5
    checkpoint=5
    checkpoint="/dev/null/run.ckpt"
    resume=5
    resume="/dev/null/run.ckpt"
    curvature=True
    polynomial=4
    terms=3
    restart=2
    data=3
    data=([0.1], [[0.0, 0.0]], [[0.0]])
    data=([9.0], [[0.0, 0.0]], [[0.0, 0.0]])
    kind="mlp", stages=2
    kind="primed", pairs=2
    kind="mlp", matching_weight=1.0, steps=1
    learning_rate=1.0, stages=2, steps=1
"""


def labels(one: HamiltonianSystem, dt: float, n: int = 24) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Labels as a user would make them: times, states, and where the flow takes them."""
    x = one.domain.sample(n, seed=4)
    y = solve(one, "kahan_li8", (0, dt), y0=x, dt=dt / 50, t_eval=[dt / 2, dt]).y
    return np.repeat([dt / 2, dt], n), np.tile(x, (2, 1)), np.concatenate([y[..., 0], y[..., 1]])


def learned(one: HamiltonianSystem, **given: Any) -> Any:
    """Train, and note the flow, and what is said on the way."""
    calls: list[Any] = []
    flow = train(one, callback=lambda step, figures: calls.append({"step": step, **figures}), **given)
    return {"flow": about(flow), "calls": calls}


def interrupted(one: HamiltonianSystem, **given: Any) -> Any:
    """A run that is killed at its second validation, and what its checkpoint is good for."""
    calls: list[int] = []

    def kill(step: int, figures: dict[str, float]) -> None:
        calls.append(step)
        if len(calls) == 2:
            raise InterruptedError("enough")

    code = """
        train(one, checkpoint=path, callback=kill, **given)
        calls
        learned(one, resume=path, **given)
        train(one, resume=path, **given | {"seed": 5})
        train(S.quartic, resume=path, **given)
        train(one, resume=path.parent / "none", **given)
    """
    with folder() as place:
        return answers(code, one=one, path=place / "run.ckpt", kill=kill, given=given, calls=calls)


@cases(lines(TRAININGS))
def training(line: str) -> Any:
    """A short training: the numbers that it finds, its figures, history and recipe."""
    return answers(line, "learned(S.{})")


@cases(lines(RESUMED))
def resuming(line: str) -> Any:
    """A training that is killed and resumed."""
    return answers(line, "interrupted(S.{})")


@case
def wrong_trainings() -> Any:
    """Arguments that `train` refuses, and systems."""
    code = """
        train("pendulum")
        train(S.bare, progress=False)
        train(S.nonseparable, kind="primed", progress=False)
        train(S.relativistic, restarts=2, progress=False)
        train(S.whole, stages=2, domain=Box([-1.0] * 4, [1.0] * 4), progress=False)
    """
    return answers(WRONG_TRAININGS, "train(S.pendulum, progress=False, {})") | answers(code)


# studies ----------------------------------------------------------------------------------------------------------

EVERY = ("error", "energy", "drift", "volume", "symplecticity", "reversal")


def compared(one: HamiltonianSystem, *given: Any, **options: Any) -> Any:
    """A comparison: its rows, table, figures and file, without times."""
    r = compare(one, *given, **{"t_span": (0, 10), "n_outputs": 20, "repeats": 1} | options)
    code = """
        [r.rows, r.t, r.title, r.metrics, r.t_span, r.y0]
        [r.reference.y, r.reference.method, r.reference.accuracy]
        untimed(r.table())
        written(r.to_csv)
        sorted(r.to_dict())
        drawn(r.figure("energy"))
        drawn(r.figure("portrait"))
        drawn(r.figure("error"), data=False)
        drawn(r.figure(), data=False)
        r.figure("x")
    """
    return answers(code, r=r)


@case
def comparing() -> Any:
    """Comparisons, of single runs and of a batch, plain and matched, and what they refuse."""
    code = """
        compared(S.pendulum)
        compared(S.henon_heiles, ["sympflow", "mlp", "verlet", "rk4", "dop853", "dopri5"], EVERY)
        compared(S.pendulum, ["verlet", "rk45"], ("drift", "energy"), t_span=(0, 50))
        compared(S.henon_heiles, ["sympflow", "verlet", "rk45"], EVERY, y0=S.henon_heiles.domain.sample(3, 0))
        compared(S.henon_heiles, [("own", get("kahan_li8")(dt=0.5)), "linear_srkn6b", "implicit_midpoint"])
        compared(S.nonseparable, ["verlet", "implicit_midpoint", "rk45", "sympflow"])
        compared(S.escape, ["verlet", "rk45", "dopri5"])
        compared(S.pendulum, ["verlet", "leapfrog", "rk45"], match="evaluations")
        compared(S.pendulum, ["verlet", "rk45", "sympflow"], match="energy_error")
        compared(S.pendulum, ["verlet"], reference=given, dt=0.1)
        compared(S.pendulum, ["verlet", "rk45"], backend="array")
        compared(S.pendulum, [SymplecticEuler(), "verlet"])
        compared(S.pendulum, ["verlet"], "beauty")
        compared(S.pendulum, ["verlet"], 3)
        compared(S.pendulum, ["verlet"], n_outputs=0)
        compared(S.pendulum, ["verlet"], repeats=0)
        compared(S.pendulum, ["verlet"], match="x")
        compared(S.pendulum, ["verlet"], t_span=(1, 1))
        compared(S.pendulum, ["verlet"], reference=3)
        compared(S.pendulum, ["verlet"], reference=np.ones((2, 3)))
        compared(S.pendulum, ["verlet"], reference=given, n_outputs=7)
        compared(S.pendulum, ["verlet"], dt=-1)
        compared(S.pendulum, ["vertel"])
        compared(S.pendulum, [])
        compared(S.pendulum, "verlet")
        compared("pendulum")
    """
    given = solve(S.pendulum, "kahan_li8", (0, 10), dt=0.01, t_eval=np.arange(1, 21) / 2)
    return answers(code, given=given)


def swept(one: HamiltonianSystem, *given: Any, **options: Any) -> Any:
    """A work–precision study, without times."""
    few = {"t_span": (0, 10), "n_outputs": 10, "repeats": 1, "steps": [0.4, 0.2, 0.1], "tolerances": [1e-3, 1e-6]}
    r = work_precision(one, *given, **few | options)
    return [r.rows, r.title, r.sizes, r.t_span, r.references, written(r.to_csv), sorted(r.to_dict())], r


@case
def precision() -> Any:
    """Work and precision, and what it refuses."""
    code = """
        swept(S.pendulum, ["verlet", "kahan_li8", "rk45", "sympflow"])[0]
        swept(S.henon_heiles, ["verlet", "dop853", "sympflow"], batch=3)[0]
        swept(S.pendulum, ["srkn11b"], steps=None)[0]
        swept(S.nonseparable, ["verlet", "implicit_midpoint"])[0]
        swept(S.pendulum, ["verlet", "mlp"], backend="array")[0]
        untimed(swept(S.pendulum, ["verlet", "rk45", ("mine", get("srkn6b")(dt=0.2))], batch=2)[1].table())
        swept(S.pendulum, ["verlet"], steps=[-1])
        swept(S.pendulum, ["verlet"], tolerances=[0])
        swept(S.pendulum, ["verlet"], n_outputs=0)
        swept(S.pendulum, ["verlet"], batch=0)
        swept(S.pendulum, ["verlet"], batch=[[1.0]])
        swept(S.pendulum, ["verlet"], t_span=(0, 0))
        swept(S.pendulum, ["vertel"])
        swept(S.bare, ["verlet"], y0=[1.0, 0.0], batch=3)
        swept("pendulum")
    """
    return answers(code)


def limited(one: Any, *given: Any, **options: Any) -> Any:
    """A study of stability, with what it says on its way."""
    said: list[str] = []
    few = {"steps": [0.5, 1.5, 3.0], "min_steps": 60, "max_steps": 600, "progress": said.append}
    r = stability(one, *given, **few | options)
    return [r.rows, r.limits, r.table(), said, written(r.to_csv), tried(lambda: drawn(r.figure()))]


@case
def stabilities() -> Any:
    """Studies of stability, of one system and of a family, and what they refuse."""
    code = """
        limited(S.oscillator, ["verlet", "leapfrog", "implicit_midpoint", "rk4", "rk45", "sympflow"])
        limited([S.oscillator, S.oscillator_100], ["verlet"], dtypes=("float64", "float32"), metrics=("energy",))
        limited(S.escape, ["verlet", "rk45"], steps=[0.05, 0.5], t_span=(0, 8))
        limited(S.nonseparable, ["verlet", "gauss_legendre4"], steps=[0.05, 0.5, 2.0], limits=False)
        limited(S.pendulum, ["sympflow", "mlp"], limits=False)
        limited(S.oscillator, ["verlet"], steps=[-1])
        limited(S.oscillator, ["verlet"], steps="ab")
        limited(S.oscillator, ["verlet"], metrics="energy")
        limited(S.oscillator, ["verlet"], metrics=["x"])
        limited(S.oscillator, ["verlet"], bound=0)
        limited(S.oscillator, ["verlet"], dtypes="float64")
        limited(S.oscillator, ["verlet"], dtypes=["f2"])
        limited(S.oscillator, ["verlet"], min_steps=0)
        limited(S.oscillator, ["verlet"], y0=torch.ones(2))
        limited(S.oscillator, ["verlet"], y0=np.ones((1, 1, 2)))
        limited(S.oscillator, ["verlet"], t_span=(1, 1))
        limited(S.oscillator, ["verlet"], progress=3)
        limited(S.oscillator, ["vertel"])
        limited("pendulum")
    """
    return answers(code)


def crossed(*given: Any, **options: Any) -> Any:
    """A Poincaré section: its crossings, table, figure and file."""
    code = """
        [r, repr(r), r.success, len(r), r.rows[:2], r.table(5)]
        written(r.to_csv)
        drawn(r.plot())
    """
    return answers(code, r=poincare_section(*given, **options))


@case
def sections() -> Any:
    """Poincaré sections, and what they refuse."""
    code = """
        crossed(S.kepler, "log_leapfrog", (0, 30), level=0.1)
        crossed(S.henon_heiles, "verlet", (0, 30), coordinate="p2", level=0.05, direction=-1, sample=0.02)
        crossed(S.henon_heiles, "verlet", (30, 0), direction=0, dt=0.1)
        crossed(S.henon_heiles, "verlet", (0, 3), level=9.0)
        crossed(S.escape, "verlet", (0, 9), [S.escape.y0, [0.0, 0.1, 0.1, 0.0]])
        crossed(S.pendulum, "verlet", (0, 30))
        crossed(S.nonseparable, "verlet")
        crossed("pendulum")
        crossed(S.pendulum, "verlet", coordinate=9)
        crossed(S.pendulum, "verlet", coordinate="x")
        crossed(S.pendulum, "verlet", direction=2)
        crossed(S.pendulum, "verlet", level=nan)
        crossed(S.pendulum, "verlet", sample=0)
        crossed(S.pendulum, "verlet", y0=torch.ones(2))
        crossed(S.pendulum, "verlet", nonsense=1)
    """
    by = ("kahan_li8", "sympflow", "mlp", "rk45", "dopri5", "implicit_midpoint", "strang_parts", "rk4")
    batch = "crossed(S.henon_heiles, method, (0, 30), S.henon_heiles.domain.sample(3, seed=1))"
    return answers(code) | {method: answers(batch, method=method) for method in by}


@case
def metrics() -> Any:
    """Metrics of long runs, of loops and of failed runs, and what they refuse."""
    code = """
        sympflow.energy_drift(long)
        sympflow.energy_drift(drifting)
        sympflow.energy_drift(batch)
        sympflow.energy_drift(long, blocks=40, relative=False)
        sympflow.energy_drift(long, blocks=1000)
        sympflow.energy_drift(long, blocks="a")
        sympflow.energy_growth(long)
        sympflow.energy_growth(long, first=100.0)
        sympflow.energy_growth(drifting)
        sympflow.energy_growth(escaped)
        sympflow.energy_growth(batch)
        sympflow.loop_area_error(long)
        sympflow.loop_area_error(batch)
        sympflow.energy_error(escaped)
        sympflow.volume_error(escaped)
        sympflow.symplecticity_defect(escaped)
        sympflow.reference_error(escaped)
        sympflow.time_reversal_error(escaped)
        sympflow.reference_error(long, drifting)
        sympflow.reference_error(long, np.ones((2, 3)))
        sympflow.symplecticity_defect(batch, scale=-1.0)
        sympflow.symplecticity_defect(batch, scale=[1.0, 2.0, 3.0])
        batch.to_scipy()
        escaped.raise_for_status()
    """
    code += "".join(
        f"sympflow.loop_area_error(solve(S.pendulum, {m!r}, (0, 8), loop, t_eval=[2.0, 8.0]))\n"
        for m in ("verlet", "rk45", *FLOWS)
    )
    code += "".join(f"sympflow.{m}(3)\n" for m in sympflow.__all__ if re.search("_error|_defect|_drift|_growth", m))
    angle = np.linspace(0, 2 * math.pi, 64, endpoint=False)
    names = {
        "long": solve(S.pendulum, "verlet", (0, 1200), t_eval=np.linspace(0, 1200, 401)),
        "drifting": solve(S.pendulum, "rk45", (0, 200), t_eval=np.linspace(0, 200, 201)),
        "batch": solve(S.henon_heiles, "verlet", (0, 40), S.henon_heiles.domain.sample(3, 0)),
        "escaped": solve(S.escape, "verlet", (0, 9)),
        "loop": np.stack([1 + 0.3 * np.cos(angle), 0.3 * np.sin(angle)], -1),
    }
    return answers(code, **names)


# peers ------------------------------------------------------------------------------------------------------------

DRIVEN = ["verlet", "kahan_li8", "omelyan4", "implicit_midpoint", "mollified_impulse", "strang_parts", "rk4", *FLOWS]


@cases(DRIVEN)
def in_scipy(method: str) -> Any:
    """A method of ours in `solve_ivp`."""
    code = """
        [solver.__name__, solver.__doc__]
        run()
        run(t_eval=np.unique(between(0.2, 7.77)))
        (s := run(dense_output=True)), s.sol(between(0.2, 7.77))
        run(events=[event(lambda t, y: y[0], terminal=2, direction=-1), lambda t, y: y[1] - 0.1], max_step=0.05)
        solve_ivp(one, (3.0, -1.3), one.y0, method=solver, t_eval=[2.0, -1.3])
        solve_ivp(one, (3.0, 3.0), one.y0, method=solver)
        run(rtol=1e-3, dt=0.3)
        solve_ivp(lambda t, y: -y, (0, 1), one.y0, method=solver)
        solve_ivp(lambda t, y: -y, (0, 1), [1.0, 0.0], method=solver)
        solve_ivp(one, (0, 1), [nan] * 4, method=solver)
        run(max_step=-1)
    """
    one = S.henon_heiles
    solver = as_scipy(method, one, **{} if method in FLOWS else {"dt": 0.1})
    return answers(code, solver=solver, one=one, run=partial(solve_ivp, one, (0.2, 7.77), one.y0, method=solver))


@cases(DRIVEN[:-3] + DRIVEN[-2:])
def in_torchdiffeq(method: str) -> Any:
    """A method of ours in `odeint` and `odeint_event`, with gradients."""
    code = """
        run(y0, t)
        run(y0, t.flip(0))
        run(batch, t)
        run((batch[:, :2], batch[:, 2:]), t)
        run(y0.float(), t.float())
        run(y0, t, rtol=1e-3)
        (y := run(a, s)), torch.autograd.grad((y * torch.arange(12).reshape(3, 4)).sum(), (a, s))
        (e := odeint_event(one, a, t[0], event_fn=lambda t, y: y[1], **given)), torch.autograd.grad(e[0], a)
        odeint(lambda t, y: -y, y0, t, method=method, options={**given["options"], "system": one})
        odeint(lambda t, y: -y, y0, t, **given)
        odeint_adjoint(one, y0, t, method=method)
    """
    one, t = S.henon_heiles, tensor([0.2, 0.75, 3.21], dtype=torch.float64)
    given = {"method": method, "options": {} if method in FLOWS else {"dt": 0.1}}
    y0, batch = tensor(one.y0), tensor(states(one, 4))
    a, s = (x.clone().requires_grad_(True) for x in (y0, t))
    names = {"method": method, "given": given, "one": one, "t": t, "y0": y0, "batch": batch, "a": a, "s": s}
    return answers(code, run=partial(odeint, one, **given), **names)


@case
def peers() -> Any:
    """Our systems in the hands of peers, and what is refused to them."""
    code = """
        solve_ivp(S.escape, (0, 9), S.escape.y0, method=as_scipy("verlet", S.escape))
        solve_ivp(one, (0, 3), one.y0, method="RK45", t_eval=[1.0, 3.0])
        solve_ivp(one, (0, 3), one.y0, method="Radau", vectorized=True)
        solve_ivp(lambda t, y: y, (0, 1), one.y0, method=as_scipy("verlet"))
        solve_ivp(one, (0, 1), one.y0, method=as_scipy("verlet"))
        solve_ivp(one, (0, 1), one.y0, method=as_scipy(get("verlet")(dt=0.1)))
        as_scipy("rk45", one)
        as_scipy("dopri5", one)
        as_scipy("log_leapfrog", one)
        as_scipy("explicit_adams", one)
        as_scipy("vertel", one)
        as_scipy("verlet", one, rtol=1)
        as_scipy("verlet", "pendulum")
        as_scipy("verlet", S.nonseparable)
        odeint(one, y0, t)
        odeint(one, y0, t, method="rk4", options={"step_size": 0.1})
        odeint_event(one, y0, t[0], event_fn=lambda t, y: y[1])
        odeint_adjoint(torch_field, y0[:2], t)
        odeint(one, y0, t, method=get("verlet")(dt=0.1))
        odeint(one, y0, t, method=shipped_flows(one)[2].load(one))
        odeint(one, y0, t, method="vertel")
        odeint(one, y0, t, method="rk45")
        odeint(one, y0, t, method="log_leapfrog")
        odeint(one, y0, t, method="verlet", options=3)
        odeint(one, y0, t, method="verlet", options={"nonsense": 1})
        odeint(one, y0, t, method="verlet", options={"dt": 0.1, "step_size": 0.1})
        odeint(one, y0, [0.0, 1.0], method="verlet")
        odeint(one, y0, tensor([0.0, 1.0, 0.5]), method="verlet")
        odeint(one, one.y0, t, method="verlet")
        odeint(one, y0, t, method="verlet", event_fn=lambda t, y: y[0])
        register_in_torchdiffeq("dopri5")
        register_in_torchdiffeq(3)
    """
    t = tensor([0.2, 0.75, 3.21], dtype=torch.float64)
    return answers(code, one=S.henon_heiles, y0=tensor(S.henon_heiles.y0), t=t, torch_field=Field())


@case
def in_torchode() -> Any:
    """Our methods in torchode, where it is installed."""
    try:
        import torchode

        from sympflow.interop.torchode import register, step_method
    except ImportError:
        return "torchode is not installed"
    code = """
        run("verlet", 0.1)
        run("kahan_li8", 0.1)
        run("implicit_midpoint", 0.1)
        run("strang_parts", 0.1)
        run("sympflow", 0.4)
        run("verlet", -0.1)
        run("sympflow", 5.0)
        step_method("rk45", one)
        step_method("verlet", one, dt=0.1)
        step_method("verlet", "pendulum")
    """
    one = S.henon_heiles
    t = tensor([[0.0, 0.55, 2.0], [1.0, 1.3, 4.21], [-0.5, 0.0, 0.25]], dtype=torch.float64)

    def run(method: str, dt: float) -> Any:
        register(method, one)
        given = {"controller": torchode.FixedStepController(), "dt0": torch.full((3,), dt, dtype=torch.float64)}
        sol = torchode.solve_ivp(one, tensor(states(one, 3)), t, method=method, **given)
        return [sol.ys, sol.status, sol.stats["n_steps"]]

    return answers(code, run=run, one=one, step_method=step_method)


class Field(nn.Module):
    """The vector field of a pendulum, as one would write it for torchdiffeq."""

    def forward(self, t, y):
        q, p = y.unbind(-1)
        return torch.stack([p, -torch.sin(q)], dim=-1)


def mixed_field(t, y):
    q, p = y.unbind(-1)
    return torch.stack([p / torch.sqrt(1 + p**2) + q / 10, -(q**3) - p / 10], -1)


@case
def systems_of_peers() -> Any:
    """Functions and modules converted to systems, and those that cannot be."""
    code = """
        shown(from_module(Field(), 1, y0=[1.0, 0.0]))
        shown(from_module(mixed_field, 1, y0=[1.0, 0.5], name="mixed", dt=0.1))
        shown(from_hamiltonian(quartic_hamiltonian, 2, y0=Y4))
        shown(from_hamiltonian(torch_hamiltonian, 2, y0=Y4))
        from_module(lambda t, y: -y, 1)
        from_module(lambda t, y: t * y, 1)
        from_module(lambda t, y: y[..., :1], 1)
        from_module(3, 1)
        from_hamiltonian(lambda q, p: q, 1)
        from_hamiltonian(lambda q, p: np.sin(q), 1)
        from_hamiltonian(quartic_hamiltonian, 0)
        from_hamiltonian(quartic_hamiltonian, 2, y0=[1.0])
    """

    def shown(one: HamiltonianSystem) -> Any:
        y = states(one, 3)
        values = [one, one.hamiltonian(y), one.vector_field(y), one.hessian(y), one.inverse_mass, one.fingerprint]
        methods = ("verlet", "srkn6b", "implicit_midpoint", "rk45")
        return values + [tried(solve, one, m, (0, 2), t_eval=[0.7, 2.0]) for m in methods]

    return answers(code, shown=shown)


# pickles ----------------------------------------------------------------------------------------------------------


def still_works(x: Any) -> Any:
    """Use something that was pickled."""
    match x:
        case HamiltonianSystem():
            code = """
                [x, x.hamiltonian(x.y0), x.fingerprint, x.params, x.domain]
                solve(x, "verlet", (0, 1), t_eval=[0.33, 1.0])
                solve(x, "implicit_midpoint", (0, 1), t_eval=[0.33, 1.0])
                solve(x, "rk45", (0, 1), t_eval=[0.33, 1.0])
            """
        case Solution():
            code = """
                seen(x)
                solve(x.system, x.integrator, x.t_span, x.y0)
                sympflow.max_energy_error(x)
                sympflow.volume_error(x)
            """
        case Integrator():
            code = """
                [x, x == type(x)(), type(x).__name__, type(x).__module__ in sys.modules]
                solve(getattr(S, own(x.name)[0]), x, Run(x.name, own(x.name)[0], 5.4).ends, **{})
            """
        case nn.Module():
            code = """
                about(x)
                x(1.3 * x.dt, torch.full((2 * x.ndof,), 0.3, dtype=x.dtype))
                solve(x.system, x, (0, 4.4 * x.dt), on_domain_exit="ignore")
            """
        case _:
            code = "x"
    return answers(code, x=x)


PICKLES = """
    solve(S.henon_heiles, "verlet", (0, 1)).system
    time_transformed(S.kepler)
    Run("rk45", "henon_heiles")(dense_output=True)
    Run("dop853", "henon_heiles")(dense_output=True)
    Run("dopri5", "henon_heiles")(dense_output=True)
    Run("rk4", "henon_heiles")(dense_output=True)
    Run("explicit_adams", "henon_heiles")(dense_output=True)
    Run("mlp", "henon_heiles")(dense_output=True)
    Run("sympflow", "henon_heiles")(dense_output=True)
    Run("sympflow", "kepler")(dense_output=True)
    Run("sympflow", "henon_heiles")(dense_output=True, flow="henon_heiles-sympflow")
    Run("verlet", "henon_heiles")(dense_output=True, y0=states(S.henon_heiles, 2))
    Run("verlet", "henon_heiles")(dense_output=True, y0=tensor(S.henon_heiles.y0))
    Run("verlet", "functions")(dense_output=True)
    get("kahan_li8")(dt=0.2, compensated=True)
    shaken(SympFlow(2, pairs=1)).requires_grad_(False)
    shaken(MLPFlow(2)).requires_grad_(False)
    shaken(mixed_layers()).requires_grad_(False)
    shaken(primed(S.henon_heiles, 2, processor=3, dt=0.7)).requires_grad_(False)
    shaken(primed(S.henon_heiles, 2, processor=2, curvature=True, dt=0.7)).requires_grad_(False)
    shaken(primed(S.quartic, 3, processor=2, polynomial=4, first="kick", dt=0.5)).requires_grad_(False)
    shaken(split(S.henon_heiles, 3, dt=0.7)).requires_grad_(False)
    shaken(split(S.polar, 2, dt=0.01, terms=3)).requires_grad_(False)
    shipped_flows(S.henon_heiles)[0].load(S.henon_heiles)
    shipped_flows(S.kepler)[0].load(S.kepler)
    shipped_flows(S.henon_heiles)[0].load().certified
    S.henon_heiles.domain
    Tube([[0.0, 1.0], [1.0, 0.0]], 0.1)
    SCHEMES["chin4a"]
    shipped_flows(S.pendulum)[0].load(S.pendulum).scheme(0.4)
    compare(S.pendulum, ["verlet"], t_span=(0, 3), repeats=1).rows
    poincare_section(S.henon_heiles, "verlet", (0, 20))
"""
PICKLED = [f"S.{name}" for name in Systems.MADE if name not in ("planets", "bare", "oscillator_100", "fput_1000")]
PICKLED += [f'Run("{run.method}", "{run.name}")(dense_output=True)' for run in RUNS.values() if run.method in DRIVEN]
PICKLED += [f'get("{method}")()' for method in METHODS]


@cases([*PICKLED, *lines(PICKLES)])
def pickled(code: str) -> Any:
    """Something pickled and read again, now, and from the bytes that the recording tree made of it."""
    thing = eval(code)
    if code not in KEPT:
        with contextlib.suppress(Exception):
            KEPT[code] = pickle.dumps(thing)
    fresh = tried(lambda: still_works(pickle.loads(pickle.dumps(thing))))
    return {"now": fresh, "then": tried(lambda: still_works(pickle.loads(KEPT[code]))) if code in KEPT else "was none"}


# the command line -------------------------------------------------------------------------------------------------

COMMANDS = """
    --help
    --version
    nonsense
    systems
    systems --help
    methods
    methods --help
    flows
    flows kepler
    flows pendulum
    flows nonsense
    flows harmonic-oscillator --omega 100
    flows --help
    solve
    solve --help
    solve pendulum
    solve henon-heiles --t-end 5
    solve pendulum --method verlet --t-end 2
    solve pendulum --method rk45:rtol=1e-8 --y0 1.5,0 --t-end 3
    solve henon_heiles --method kahan_li8:dt=0.2 --t-end 5 --n-outputs 4
    solve kepler --tol 1e-6 --t-end 3
    solve kepler --e 0.3 --method log_leapfrog --t-end 3
    solve harmonic-oscillator:omega=3 --method verlet --t-end 1
    solve henon-heiles-escape --method verlet --t-end 9
    solve pendulum --method verlet --backend array --t-end 1
    solve nonseparable --method verlet
    solve nonseparable --method implicit_midpoint --t-end 1
    solve fput --t-end 1
    solve spring-pendulum --k 1e6 --coordinates polar --t-end 0.1
    solve pendulum --method sympflow:flow=pendulum-sympflow --t-end 3
    solve pendulum --method mlp --t-end 3
    solve henon-heiles --method verlet --t-end 1 --out a/y.csv
    solve pendulum --t-end 5 --out y.npz
    solve pendulum --tol 1e-30
    solve pendulum --dt -1
    solve pendulum --method verlet --y0 1,a
    solve pendulum --method verlet --y0 1
    solve pendulum --method vertel
    solve pendulum --method verlet:rtol=1
    solve pendulum --method verlet:dt
    solve pendulum --method verlet:dt=a
    solve pendulum --method none.safetensors
    solve pendulum --backend gpu
    solve pendulum henon-heiles --method verlet
    solve henon-hiles
    solve pendulum --omega 1
    solve pendulum --t-ned 1
    solve pendulum --n-outputs a
    solve pendulum --out y.txt
    solve pendulum --out /dev/null/at/all/y.csv
    compare
    compare --help
    compare henon-hiles
    compare harmonic-oscillator --omega fast
    compare harmonic-oscillator:mass=2
    compare pendulum --methods vertel
    compare pendulum --methods ,
    compare pendulum --metrics beauty
    compare pendulum --match x --t-end 1
    compare pendulum --out /dev/null/at/all
    compare pendulum --methods verlet,rk45,sympflow --t-end 5 --n-outputs 20 --repeats 1 --out out
    compare harmonic-oscillator pendulum:t_end=3 --methods verlet,kahan_li8:dt=0.5 --t-end 4 --n-outputs 9 --repeats 1
    bench --help
    bench pendulum --methods vertel
    bench pendulum --methods verlet --t-end 5 --n-outputs 5 --repeats 1 --batch 2 --out out
    stability --help
    stability pendulum --steps a
    stability fput --vary omega
    stability fput --vary mass=1,2
    stability pendulum --dtypes float16 --methods verlet
    stability harmonic-oscillator --methods verlet --steps 0.5,3 --t-end 20 --metrics energy --out out
    stability harmonic-oscillator --vary omega=1,10 --methods verlet --steps 0.1 --t-end 5 --metrics energy --no-limits
    train
    train --help
    train pendulum --hidden ten
    train pendulum --out flow.pt
    train pendulum --kind x
    train nonsense
    train pendulum --optimizer sgd
    train pendulum --resume none.ckpt
    train pendulum --stages 0
    train harmonic-oscillator --pairs 1 --hidden 4 --optimizer adam --steps 3 --points 40 --out f.safetensors
    train pendulum --stages 2 --restarts 1 --steps 3 --points 20 --dt 0.5 --checkpoint run.ckpt
"""


@cases(["", *lines(COMMANDS)])
def shell(words: str) -> Any:
    """A command: its exit status, what it prints, and the files that it writes."""
    from sympflow.cli import main as command

    out, err, before = io.StringIO(), io.StringIO(), sys.argv
    with folder() as place, contextlib.chdir(place), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        sys.argv = ["sympflow", *words.split()]
        try:
            command()
            status: Any = 0
        except SystemExit as end:
            status = end.code
        finally:
            sys.argv = before
        prints = untimed(out.getvalue()) if words.startswith(("compare", "bench")) else out.getvalue()
        found = {str(path.relative_to(place)): path for path in sorted(place.rglob("*")) if path.is_file()}
        files = {name: content(path) for name, path in found.items()}
    return {"status": status, "prints": prints, "errors": err.getvalue(), "files": files}


def in_a_process(*words: str) -> Any:
    """Run Python in a process of its own, with this package, in an empty folder."""
    with folder() as place:
        environment = os.environ | {"PYTHONPATH": str(HERE.parent)}
        run = [sys.executable, *words]
        result = subprocess.run(run, capture_output=True, text=True, check=False, env=environment, cwd=place)
    return {"status": result.returncode, "prints": result.stdout, "errors": result.stderr}


HEAVY = "torch scipy matplotlib numba sympy torchdiffeq torchode safetensors typer rich"
LOADED = """
    sympflow.__version__; dir(sympflow)
    sympflow.systems.henon_heiles().force
    sympflow.available()
    sympflow.solve(sympflow.systems.pendulum(), 'verlet', (0, 1))
    sympflow.solve(sympflow.systems.pendulum(), 'rk45', (0, 1))
    sympflow.volume_error(sympflow.solve(sympflow.systems.pendulum(), 'verlet', (0, 1), backend='array'))
"""


@cases(lines(LOADED))
def imports(code: str) -> Any:
    """The heavy modules that a process has loaded after some code."""
    return in_a_process(
        "-c", f"import sympflow, sys; {code}; print('loaded:', *(m for m in '{HEAVY}'.split() if m in sys.modules))"
    )


@cases(["solve pendulum --method verlet --t-end 1"])
def real_shell(words: str) -> Any:
    """A command in a process of its own."""
    return in_a_process("-m", "sympflow.cli", *words.split())


# what there is ----------------------------------------------------------------------------------------------------

CLASSES = (HamiltonianSystem, Solution, Box, Ball, EnergySublevel, Tube, SympFlow, MLPFlow, Potential, MLPPotential)
CLASSES += (Kick, Drift, Scheme, Outcome, Integrator, FixedStep)


@case
def public_names() -> Any:
    """The public names, their signatures and their docstrings."""
    found: dict[str, Any] = {"all": sympflow.__all__, "dir": dir(sympflow)}
    for name in sympflow.__all__:
        thing = getattr(sympflow, name)
        found[name] = [thing.__doc__, f"signature {inspect.signature(thing)}" if callable(thing) else str(type(thing))]
    for cls in CLASSES:
        inherited = set(dir(nn.Module)) if issubclass(cls, nn.Module) else set()
        for name in sorted(n for n in dir(cls) if not n.startswith("_") and n not in inherited):
            member = inspect.getattr_static(cls, name)
            kind = f"signature {inspect.signature(member)}" if inspect.isfunction(member) else type(member).__name__
            found[f"{cls.__name__}.{name}"] = [getattr(member, "__doc__", None), kind]
    return found


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


@dataclass(frozen=True)
class Boastful(SymplecticEuler):
    """The same, with an order that it has not."""

    name: ClassVar[str] = "boastful"
    order: ClassVar[int | None] = 2


def broken(**methods: Any) -> Integrator:
    """A plug-in that is wrong somewhere."""
    return type("Broken", (FixedStep,), {"name": "broken", "order": 1, "symplectic": False, **methods})()


@case
def plug_ins() -> Any:
    """Methods of somebody else's, sound and broken, and the checks of them."""
    code = """
        str(check_integrator(SymplecticEuler))
        str(check_integrator(get("verlet")))
        check_integrator(Boastful)
        check_integrator("verlet")
        check_integrator(get("verlet"), S.nonseparable)
        check_integrator(get("verlet"), "pendulum")
        solve(S.henon_heiles, SymplecticEuler(dt=0.1), (0, 2), t_eval=[0.33, 2.0])
        solve(S.numba, SymplecticEuler, (0, 2), dt=0.1, t_eval=[0.33, 2.0])
        seen(solve(S.henon_heiles, SymplecticEuler(), (0, 1), states(S.henon_heiles), dense_output=True))
        solve(S.oscillator, broken(), (0, 0.5))
        solve(S.oscillator, broken(step=lambda *_: 1 / 0), (0, 0.5))
        solve(S.oscillator, broken(step=lambda self, system, t, y, h: None), (0, 0.5))
        solve(S.oscillator, broken(step=lambda self, system, t, y, h: 1.0), (0, 0.5))
        solve(S.oscillator, broken(step=lambda self, system, t, y, h: y[..., :1]), (0, 0.5))
        solve(S.oscillator, broken(step=lambda self, system, t, y, h: 1j * y), (0, 0.5))
        solve(S.oscillator, broken(step=lambda self, system, t, y, h: y.astype("f4")), (0, 0.5))
        solve(S.oscillator, broken(step=lambda self, system, t, y, h: nan * y), (0, 0.5))
        solve(S.oscillator, broken(step=lambda self, system, t, y, h: (nan if t > 0.2 else 1.0) * y), (0, 0.5))
        solve(S.oscillator, broken(run=lambda *_: None), (0, 0.5))
        solve(S.oscillator, broken(run=lambda *_: Outcome(np.zeros(3), np.zeros((3, 5)), 0, "", {})), (0, 0.5))
        solve(S.oscillator, broken(run=lambda *_: Outcome(np.zeros(3), np.zeros((3, 2)), "ok", "", {})), (0, 0.5))
    """
    return answers(code)


@case
def registering() -> Any:
    """Names for methods of somebody else's: last of all cases, for they stay."""
    code = """
        sympflow.register("verlet", SymplecticEuler)
        sympflow.register("", SymplecticEuler)
        sympflow.register(3, SymplecticEuler)
        sympflow.register("own", int)
        sympflow.register("own", FixedStep)
        sympflow.register("own_euler", SymplecticEuler)
        solve(S.henon_heiles, "own_euler", (0, 1), dt=0.1)
        solve(S.henon_heiles, "own_euler", (0, 1), rtol=0.1)
        sympflow.available()
        compared(S.pendulum, ["own_euler"])
        crossed(S.henon_heiles, "own_euler", (0, 9))
        register_in_torchdiffeq("verlet")
        torchdiffeq.odeint(S.henon_heiles, y0, tensor([0.0, 0.33, 1.0]), method="verlet", options={"dt": 0.1})
    """
    return answers(code, y0=tensor(S.henon_heiles.y0))


# recording and comparing ------------------------------------------------------------------------------------------


def load_loops() -> None:
    """Load what most cases share of the compiled loops, always in one order, on which their last bits depend.

    Loops of one module may each have a copy of a function that they call, compiled with other choices; of all that are
    loaded the first is taken.
    """
    symbolic_ones = (one for one in map(partial(getattr, S), Systems.MADE) if one.symbols and one.y0 is not None)
    for one in symbolic_ones:
        for method in ("verlet", "omelyan4", "implicit_midpoint"):
            run = partial(tried, solve, one, method, (0.0, 2.5 * one.dt), backend="compiled")
            for given in (
                {},
                {"t_eval": [0.7 * one.dt]},
                {"y0": states(one)},
                {"y0": states(one), "t_eval": [one.dt / 3]},
            ):
                run(**given)


def run_cases(names: list[str]) -> dict[str, dict[str, Leaf]]:
    """The leaves of the cases."""
    found, group, since = {}, "", time.perf_counter()
    load_loops()
    print(f"  loops loaded in {time.perf_counter() - since:.0f} s", file=sys.stderr, flush=True)
    for name in names:
        if name.partition(":")[0] != group:
            group = name.partition(":")[0]
            print(f"  {group}", file=sys.stderr, flush=True)
        torch.manual_seed(0)
        found[name] = tried(CASES[name])
    print(f"{len(found)} cases, {sum(map(len, found.values()))} answers, {time.perf_counter() - since:.0f} s")
    return found


def bits(array: np.ndarray) -> np.ndarray:
    """The floats of an array as integers, all NaN being the same."""
    if array.dtype.kind == "c":
        array = np.stack([array.real, array.imag], -1)
    if array.dtype.kind != "f":
        return array
    return np.where(np.isnan(array), np.array(nan, array.dtype), array).view(f"i{array.dtype.itemsize}")


def difference(old: np.ndarray, new: np.ndarray) -> str:
    """Say how two arrays differ; "" if they do not."""
    if old.dtype != new.dtype or old.shape != new.shape:
        return f"{old.dtype} of shape {old.shape} became {new.dtype} of shape {new.shape}"
    old, new = np.atleast_1d(old), np.atleast_1d(new)
    count = np.count_nonzero(bits(old) != bits(new))
    if not count or old.size == 1:
        return f"{old[0]!r} became {new[0]!r}" if count else ""
    with np.errstate(all="ignore"):
        a, b = old.astype(complex), new.astype(complex)
        relative = abs(a - b) / np.maximum(abs(a), abs(b))
    finite = relative[np.isfinite(relative)]
    largest = f", by at most {finite.max():.2g} of their size" if finite.size else ""
    return f"{count} of {old.size} numbers differ{largest}"


def raising(found: dict[str, Leaf]) -> dict[str, str]:
    """The paths of what raised an exception, and the exception."""
    starts = [path.removesuffix("raises") for path in found if path.endswith("raises")]
    return {start: f"{bytes(found[start + 'raises']).decode()}: {found[start + 'says']!s}" for start in starts}


def differences(old: dict[str, Leaf], new: dict[str, Leaf]) -> tuple[list[str], list[str]]:
    """The differences between two sets of leaves: in results, and in words."""
    results, words = [], []
    for here, there, text in ((new, old, "raises"), (old, new, "raised")):
        for start, error in raising(here).items():
            if start + "raises" not in there and any(path.startswith(start) for path in there):
                results.append(f"{start.removesuffix(' → ') or 'it'} {text} {error}")
                old = {path: leaf for path, leaf in old.items() if not path.startswith(start)}
                new = {path: leaf for path, leaf in new.items() if not path.startswith(start)}
    for path in dict.fromkeys((*old, *new)):
        a, b = old.get(path), new.get(path)
        if a is None or b is None:
            there = b if a is None else a
            shown = f"{there.dtype} of shape {there.shape}" if isinstance(there, np.ndarray) else f"{there!r:.200}"
            section = words if isinstance(there, str) else results
            section.append(f"{path}: {'is new' if a is None else 'is missing'}, {shown}")
        elif isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
            if text := difference(a, b):
                results.append(f"{path}: {text}")
        elif isinstance(a, str) and isinstance(b, str):
            if a != b:
                changed = difflib.unified_diff(a.splitlines(), b.splitlines(), n=0, lineterm="")
                kept = (line for line in changed if not line.startswith(("---", "+++", "@@")))
                words.append("\n      ".join([f"{path}:", *kept]))
        elif type(a) is not type(b) or a != b:
            results.append(f"{path}: {a!r:.300} became {b!r:.300}")
    return results, words


def compare_cases(then: dict[str, dict[str, Leaf]], now: dict[str, dict[str, Leaf]]) -> bool:
    """Print all differences, in two sections; True if there is none."""
    found: dict[str, dict[str, list[str]]] = {"results": {}, "words": {}}
    for name in dict.fromkeys((*then, *now)):
        if name not in then or name not in now:
            found["results"][name] = ["is a new case" if name in now else "is a case no more"]
            continue
        for section, texts in zip(found.values(), differences(then[name], now[name]), strict=True):
            if texts:
                section[name] = texts
    for title, section in found.items():
        count = sum(map(len, section.values()))
        print(f"{title}: {f'{count} differences in {len(section)} cases' if count else 'no difference'}")
        for name, texts in section.items():
            print(f"  {name}", *(f"    {text}" for text in texts), sep="\n")
    return not any(found.values())


def kept_loops() -> set[Path]:
    """The files in which compiled loops are kept."""
    return {path for path in Path(os.environ["SYMPFLOW_CACHE_DIR"]).rglob("*.nb?")}


def main() -> int:
    """Record or compare; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("record", "compare"), nargs="?")
    parser.add_argument("file", type=Path, nargs="?")
    parser.add_argument("--only", metavar="PATTERN", default="", help="run the cases whose names match")
    parser.add_argument("--list", action="store_true", help="list the cases")
    given = parser.parse_args()
    names = [name for name in CASES if re.search(given.only, name)]
    if given.list:
        print(*names, sep="\n")
        return 0
    if given.file is None:
        parser.error("say `record FILE` or `compare FILE`")
    print(f"sympflow: {sympflow.__file__}", flush=True)
    torch.set_num_threads(1)
    recorded: dict[str, Any] = {}
    if given.action == "compare":
        with gzip.open(given.file) as file:
            recorded = pickle.load(file)
        KEPT.update(recorded["pickles"])
        print(f"recorded: {recorded['package']}", flush=True)
    loops = kept_loops()
    now = run_cases(names)
    if kept_loops() != loops and "UNCHANGED_AGAIN" not in os.environ:
        print("Some loops had to be compiled: once more, with all of them loaded.", flush=True)
        os.environ["UNCHANGED_AGAIN"] = "1"
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
    if given.action == "record":
        with gzip.open(given.file, "wb", compresslevel=4) as file:
            pickle.dump({"package": sympflow.__file__, "cases": now, "pickles": KEPT}, file)
        return 0
    then = {name: found for name, found in recorded["cases"].items() if re.search(given.only, name)}
    return 0 if compare_cases(then, now) else 1


if __name__ == "__main__":
    sys.exit(main())

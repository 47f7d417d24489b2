"""Record what a user can see of sympflow, results and messages, and compare it later: bit for bit, and word for word.

    python tests/unchanged.py record FILE       # on the tree before a refactoring
    python tests/unchanged.py compare FILE      # on the tree after it; exit status 1 if anything differs
    python tests/unchanged.py --list

A case is a function of this file that calls public names only, and answers with numbers, arrays, solutions, texts, and
containers of these. Most answers are those of expressions in a text, one a line, and are named by that line. Floats are
compared by their bits, NaN being equal to NaN. Differences in results are told apart from those in words, which are
texts with blanks in them. Times, dates, addresses and folders are left out.

`--only PATTERN` runs the cases whose names match a regular expression. `--rounding R` takes arrays for equal whose
numbers differ by at most R of the largest one, where code is compiled in another way. Compiled code is kept in a folder
of its own, unless SYMPFLOW_CACHE_DIR names another.
"""

# ruff: noqa: F401  (some names are used by the expressions in texts only)

import argparse
import contextlib
import copy
import csv
import difflib
import gzip
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
from numba import njit
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
from sympflow.arrays import concatenate
from sympflow.flow.layers import Drift, Kick
from sympflow.flow.potentials import MLPPotential, Potential
from sympflow.integrators.base import FixedStep, Integrator, Outcome

try:
    from sympflow.schemes import SCHEMES, Scheme
except ImportError:  # on older trees
    from sympflow.integrators.scheme import Scheme
    from sympflow.integrators.schemes import SCHEMES


Leaf = np.ndarray | bytes | str
HERE = Path(sympflow.__file__).resolve().parent
CASES: dict[str, Callable[[], Any]] = {}
KEPT: dict[str, bytes] = {}  # pickles that the recording tree made
TIMES = ("wall_time", "run_time", "compile_time", "run_time_spread", "seconds", "training_seconds", "break_even")
nan = math.nan


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
            found = {name: getattr(x, name) for name in names}
            yield from leaves(found | {"method": x.integrator.name}, path)
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
    """The flow that is read from its file."""
    with folder() as place:
        flow.save(place / "a.safetensors")
        again = load(place / "a.safetensors", system=getattr(flow, "system", None))
        return {"loaded": about(again), "class": type(again)}


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
        "nonseparable": systems.nonseparable,
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
    return {"solution": sol} | answers(code, f=sol.sol, t0=sol.t_span[0], t1=sol.t_span[1])


def sloped(run: Callable[..., Solution], y0: Any, dtype: torch.dtype = torch.float64, dense: bool = False) -> Any:
    """A run from a tensor, and the gradient of a sum of its states."""
    x = tensor(y0, dtype=dtype, requires_grad=True)
    sol = run(y0=x, dense_output=dense)
    y = sol.sol(float(np.mean(sol.t_span))) if dense else sol.y
    weights = torch.arange(1, y.numel() + 1, dtype=dtype).reshape(y.shape) / y.numel()
    return {"solution": sol, "gradient": torch.autograd.grad((weights * y).sum(), x)[0]}


# every method -----------------------------------------------------------------------------------------------------


METHODS = [m for m in sympflow.available() if getattr(sympflow.get(m), "splitting", "") != "kepler"]
FLOWS = ("sympflow", "mlp")
SLOW = ("adaptive_heun", "fehlberg2", "bosh3")  # at their usual tolerances


def own(method: str) -> tuple[str, str]:
    """The systems on which a method is looked at more closely."""
    if method in FLOWS:
        return "henon_heiles", "kepler" if method == "sympflow" else "pendulum"
    if method.startswith("log_"):
        return "kepler", "functions"
    if method.endswith("_parts"):
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


KINDS = """
    verlet on kepler
    srkn6b on polar
    omelyan4 on kepler
    implicit_midpoint on nonseparable
    gauss_legendre4 on whole
    mollified_impulse on fput
    linear_srkn6b on fput
    strang_parts on polar
    log_leapfrog on functions
    rk45 on nonseparable
    dopri5 on torch
    rk4 on functions
    explicit_adams on kepler
    implicit_adams on functions
    sympflow on kepler
    mlp on pendulum
    verlet on masses
    verlet on numba
    kahan_li8 on relativistic
"""
RUNS = {line: Run(*line.split(" on ")) for line in lines(KINDS)}


@cases(METHODS)
def method(name: str) -> Any:
    """A method: single, batch, tensor, times between steps, events, dense output, backwards, refusals, failures."""
    code = """
        [cls.name, cls.order, cls.symplectic, cls.trained, cls.options(), str(inspect.signature(cls))]
        run()
        run(t_eval=run.times)
        run(t_eval=[])
        run(save_every=3)
        seen(run(dense_output=True, t_eval=run.times))
        replace(run, backwards=True)(t_eval=run.times)
        run(y0=run.batch, t_eval=run.times)
        run(events=[crosses, late], t_eval=run.times)
        run(dtype="float32", t_eval=run.times)
        run(backend="array", t_eval=run.times)
        sloped(partial(replace(run, steps=6.4), t_eval=run.times[:2]), run.system.y0)
        solve(S.nonseparable, name, (0, 2.6 * S.nonseparable.dt))
        solve(S.functions, name, (0, 2.6 * S.functions.dt))
        solve(S.henon_heiles, name, (0, 90), t_eval=[1.0, 50.0, 90.0], **long)
        run(nonsense=1)
    """
    options, run = get(name).options(), Run(name, own(name)[0])
    given = {"rtol": 1e-2, "atol": 1e-3} if name in SLOW else {"rtol": 1e-3, "atol": 1e-6} if "rtol" in options else {}
    long = {"dt": 3.0} if "dt" in options and name not in FLOWS else given
    level, (t0, t1) = 0.9 * float(run.system.y0[0]), run.ends
    late = event(lambda t, y: t - t0 - 0.4321 * (t1 - t0), terminal=True)
    crosses = event(lambda t, y: y[0] - level, direction=-1)
    names = {"cls": get(name), "name": name, "run": run, "given": given, "long": long}
    return answers(code, late=late, crosses=crosses, **names)


@cases(RUNS)
def kind(run: Run) -> Any:
    """A kind of method on another system, more closely."""
    code = """
        run()
        run(t_eval=[run.ends[0], run.ends[0]])
        seen(run(dense_output=True))
        seen(replace(run, backwards=True)(dense_output=True))
        seen(run(y0=run.batch[:2], dense_output=True))
        solve(run.system, run.method, (1.5, 1.5), dense_output=True)
        run(y0=run.batch[:4].reshape(2, 2, -1), t_eval=run.times)
        replace(run, backwards=True)(y0=run.batch, t_eval=run.times)
        run(events=event(crosses, direction=1), t_eval=[])
        seen(run(events=event(crosses, terminal=2), dense_output=True))
        run(events=crosses, event_step=0.3 * run.system.dt, t_eval=[])
        replace(run, backwards=True)(events=[crosses], save_every=10)
        run(dtype=np.float32, y0=run.batch, t_eval=run.times[-1:])
        sloped(partial(replace(run, steps=6.4), t_eval=run.times[:1]), run.batch[:3])
        sloped(replace(run, steps=6.4), run.system.y0, dense=True)
        run(backend="array", y0=run.batch, t_eval=run.times)
        run(backend="compiled", t_eval=[run.ends[1]])
        [s.energy(), s.energy_error(), sympflow.max_energy_error(s), sympflow.max_energy_error(m, relative=False)]
        [sympflow.volume_error(s, over_time=True), sympflow.volume_error(m), sympflow.symplecticity_defect(s)]
        [sympflow.time_reversal_error(s), sympflow.reference_error(s), s.q, s.p, dict(s.to_scipy())]
    """
    if "compensated" in get(run.method).options() and run.name == "kepler":
        code += """
        run(backend="array", compensated=True)
        run(compensated=True)
        run(compensated=True, y0=run.batch, t_eval=run.times)
        """
    level = 0.8 * float(run.system.y0[0])
    few = replace(run, steps=4.4)
    return answers(code, run=run, crosses=lambda t, y: y[0] - level, s=few(), m=few(y0=run.batch[:2]))


# flows ------------------------------------------------------------------------------------------------------------


SAID = "kind ndof dt n_parameters system_name fingerprint recipe figures certified history"


def about(flow: Any) -> dict[str, Any]:
    """Note all that a flow says of itself, and its weights."""
    found: dict[str, Any] = {name: getattr(flow, name) for name in SAID.split()} | {"flow": flow}
    found["domain"] = None if flow.domain is None else flow.domain.to_dict()
    found |= {"weights": dict(flow.state_dict()), "dtype": str(flow.dtype)}
    return found | {"trainable": [w.requires_grad for w in flow.parameters()]}


def as_map(flow: Any, x: Tensor) -> dict[str, Any]:
    """A flow as a map: at all kinds of times, with its inverse, velocity and Hamiltonian, and their gradients."""
    code = """
        flow(torch.zeros(len(x) + 2, dtype=x.dtype), x)
        flow(nan, x)
        flow("a", x)
        flow(dt, x.numpy())
        flow(dt, x[..., 1:])
        flow(1.2 * dt, x[0])
        flow.velocity(1.5 * dt, x)
        flow.psi_and_velocity(inside, x)
    """
    for t in ("0.0", "0.37 * dt", "2.6 * dt", "-1.4 * dt", "anywhere"):
        code += f"flow({t}, x)\nflow.inverse({t}, x)\n"
    for t in ("0.37 * dt", "dt", "inside"):
        code += "".join(f"flow.{f}({t}, x)\n" for f in ("psi", "psi_inverse", "velocity", "hamiltonian"))
    code += "".join(f"slopes(flow.{f})\n" for f in ("psi", "inverse", "hamiltonian"))

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
        run(t_eval=between(*ends))
        run(ends[::-1], t_eval=between(*ends[::-1]))
        run(events=event(lambda t, y: t - sum(ends) / 2 + 1e-3 * y[0], terminal=True))
        run(backend="array", t_eval=between(*ends))
        run(dt=0.6 * step)
        sloped(run, one.y0)
        run(y0=1.5 * one.y0, on_domain_exit="ignore", t_eval=[ends[1]])
        run(y0=1.1 * one.y0, on_domain_exit="stop")
        run(y0=y0, t_eval=between(*ends))
        seen(run(dense_output=True))
    """
    ends, y0 = (0.3, 0.3 + 6.4 * step), one.y0 * np.linspace(0.97, 1.0, 4)[:, None]

    def run(t_span: Any = ends, **given: Any) -> Solution:
        return solve(one, method, t_span, **chosen | given)

    return answers(code, run=run, ends=ends, one=one, step=step, y0=y0)


HOMES = "henon_heiles pendulum quartic kepler oscillator oscillator_100 fput fput_1000 polar planets"


def home(name: str) -> tuple[HamiltonianSystem, Any]:
    """The system that a shipped flow is of, and its entry in the catalogue."""
    homes = (getattr(S, home) for home in HOMES.split())
    return next((one, f) for one in homes for f in shipped_flows(one) if f.name == name)


@cases([flow.name for flow in shipped_flows()])
def shipped(name: str) -> Any:
    """A flow that ships: its record, its certificate, its weights, and its system solved with it."""
    code = """
        [repr(entry), entry.kind, entry.dt, str(flow.certified)]
        about(flow)
        solve(one, kind, (0.3, 0.3 + 6.4 * entry.dt), flow=name, t_eval=[0.3 + 1.7 * entry.dt, 0.3 + 6.4 * entry.dt])
        solve(one, flow, (0.3, 0.3 + 2.4 * entry.dt), backend="array")
    """
    one, entry = home(name)
    flow = entry.load(one)
    return answers(code, entry=entry, flow=flow, one=one, name=name, kind=entry.kind)


CLOSELY = """
    henon_heiles-primed-3-0.6
    henon_heiles-sympflow
    kepler-log-1
    kepler-primed-2-0.15
    outer_solar_system-primed-3-200
    quartic-polynomial-6-1.04167
    spring_pendulum_1e6-sympflow
    harmonic_oscillator_100-mlp
    fput_50-sympflow
"""


@cases(lines(CLOSELY))
def shipped_map(name: str) -> Any:
    """A flow that ships, one of each kind: its map, its file, and its system solved with it in many ways."""
    one, entry = home(name)
    flow = entry.load(one)
    x = one.y0 * np.linspace(0.98, 1.0, 5)[:, None]
    if flow.ndof > one.ndof:  # of a flow in another time, which is a coordinate then
        d, B = one.ndof, entry.shift - one.hamiltonian(x)
        x = np.column_stack([x[:, :d], np.zeros(5), x[:, d:], B])
    code = """
        [flow.certified.to_dict(), [flow.certified.bound(t) for t in (0.0, 1.0, -33.3, 1e4)]]
        as_map(flow, tensor(x))
        saved(flow)
        as_method(one, kind, entry.dt, flow=name)
        entry.load()
        entry.load(S.masses)
    """
    return answers(code, entry=entry, flow=flow, x=x, one=one, name=name, kind=entry.kind)


OWN_TABLE = Scheme("own", 2, (0.5, 0.5), (1.0, 0.0), (0.01, 0.01), "a table of one's own")
primed, split = SympFlow.primed, SympFlow.split
FLOWS_OF = """
    henon_heiles: SympFlow(2, pairs=2, hidden=(5, 4, 3), activation="sin", dt=0.5, seed=3)
    henon_heiles: SympFlow(2, dtype=torch.float32)
    henon_heiles: MLPFlow(2, (5, 6, 7), activation="logcosh", dt=0.5, seed=2)
    pendulum: MLPFlow.matching(SympFlow(1, pairs=2, hidden=(8,), dt=0.7))
    henon_heiles: primed(S.henon_heiles, 3, first="kick", dt=0.5)
    pendulum: primed(S.pendulum, 3, palindromic=False, dt=0.5)
    henon_heiles: primed(S.henon_heiles, 2, processor=2, curvature=True, dt=0.7)
    quartic: primed(S.quartic, 3, processor=2, polynomial=4, first="kick", dt=0.5)
    henon_heiles: primed(S.henon_heiles, scheme="chin4a", dt=0.5)
    henon_heiles: primed(S.henon_heiles, scheme=OWN_TABLE, dt=0.4)
    masses: primed(S.masses, 2, processor=1, dt=0.3)
    functions: primed(S.functions, 2, dt=0.3)
    henon_heiles: primed(S.henon_heiles, 2, processor=1, dt=0.5, dtype=torch.float32)
    henon_heiles: split(S.henon_heiles, 3, dt=0.7)
    polar: split(S.polar, 2, dt=0.01, terms=3)
    henon_heiles: split(S.henon_heiles, 2, dt=0.7, filters=False, force_gradient=False)
    pendulum: split(S.pendulum, 2, dt=0.3, parts=("1 - cos(q1)", "p1**2/2"))
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
        about(make())
        as_map(flow, x)
        saved(flow)
        as_method(one, flow.requires_grad_(False), flow.dt)
        copy.deepcopy(flow).float()(0.3 * flow.dt, x.float())
        (c := flow.certificate(one, states=20, times=4, held_out=3, t_end=3 * flow.dt), str(c))
        flow.scheme()
        flow.scheme(0.3 * flow.dt)
    """
    make, one = partial(eval, maker), getattr(S, name)
    flow = shaken(make())
    return answers(code, make=make, flow=flow, one=one, x=tensor(states(one), dtype=flow.dtype))


# training ---------------------------------------------------------------------------------------------------------


QUICK = {"points": 40, "reference_states": 6, "progress": False}
SEARCH = {**QUICK, "restarts": 2, "steps": 6, "label_times": 3}
HELD = {**QUICK, "validation_points": 40}
NET = {**HELD, "pairs": 1, "hidden": (4,)}
NEWTON = {"kind": "sympflow", "optimizer": "gauss-newton"}
TRAININGS = """
    pendulum, flow=primed(S.pendulum, 3, palindromic=False, dt=0.5), **SEARCH
    henon_heiles, flow=primed(S.henon_heiles, 2, processor=2, curvature=True, dt=0.7), energy_weight=0.0, **SEARCH
    quartic, flow=primed(S.quartic, 3, processor=2, polynomial=4, first="kick", dt=0.5), **SEARCH
    kepler, dt=0.05, stages=2, processor=2, **SEARCH
    numba, flow=primed(S.numba, 2, processor=1, dt=0.3), **SEARCH
    pendulum, flow=primed(S.pendulum, 3, dt=0.5), loss="labels+residual", frozen_weight=2.0, **SEARCH
    pendulum, stages=2, loss="matching+labels", matching_weight=0.3, **SEARCH
    pendulum, stages=2, data=labels(S.pendulum, 0.5), dt=0.5, restarts=2, steps=6, progress=False
    relativistic, flow=primed(S.relativistic, 2, dt=0.5), optimizer="bfgs", steps=2, **HELD
    henon_heiles, flow=split(S.henon_heiles, 3, dt=0.7), **SEARCH
    fput, flow=split(S.fput, 2, dt=0.1, terms=4), **SEARCH
    pendulum, steps=8, schedule="cosine", learning_rate=0.02, clip=0.1, refresh=3, seed=5, **NET
    oscillator, steps=5, dtype=torch.float32, schedule="constant", clip=None, **NET
    nonseparable, dt=0.1, steps=5, activation="sin", matching_weight=0.2, matching_times=4, **NET
    oscillator, optimizer="lbfgs", steps=2, **NET
    pendulum, steps=4, **NEWTON, **NET
    oscillator, kind="mlp", steps=5, **NET | {"hidden": (8,)}
    pendulum, kind="mlp", optimizer="gauss-newton", steps=3, **NET | {"hidden": (8,)}
    pendulum, data=labels(S.pendulum, 0.5), dt=0.5, steps=3, **NEWTON, **NET
"""
RESUMED = """
    oscillator, steps=12, validate_every=3, checkpoint_every=2, **NET
    oscillator, optimizer="lbfgs", steps=6, validate_every=2, checkpoint_every=2, **NET
    pendulum, steps=6, validate_every=2, checkpoint_every=2, **NEWTON, **NET
    pendulum, stages=2, **SEARCH
    henon_heiles, flow=split(S.henon_heiles, 2, dt=0.7), **SEARCH
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
        compared(S.nonseparable, ["verlet", "implicit_midpoint", "rk45", "sympflow"])
        compared(S.escape, ["verlet", "rk45", "dopri5"])
        compared(S.pendulum, ["verlet", "rk45", "sympflow"], match="energy_error")
        compared(S.pendulum, ["verlet"], reference=given, dt=0.1)
        compared(S.pendulum, ["verlet", "rk45"], backend="array")
        compared(S.pendulum, ["verlet"], "beauty")
        compared(S.pendulum, ["verlet"], n_outputs=0)
        compared(S.pendulum, ["verlet"], match="x")
        compared(S.pendulum, ["verlet"], t_span=(1, 1))
        compared(S.pendulum, ["verlet"], dt=-1)
        compared(S.pendulum, ["vertel"])
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
        swept(S.nonseparable, ["verlet", "implicit_midpoint"])[0]
        swept(S.pendulum, ["verlet", "mlp"], backend="array")[0]
        untimed(swept(S.pendulum, ["verlet", "rk45", ("mine", get("srkn6b")(dt=0.2))], batch=2)[1].table())
        swept(S.pendulum, ["verlet"], steps=[-1])
        swept(S.pendulum, ["verlet"], n_outputs=0)
        swept(S.pendulum, ["verlet"], batch=[[1.0]])
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
        limited(S.oscillator, ["verlet"], bound=0)
        limited(S.oscillator, ["verlet"], dtypes=["f2"])
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
        crossed(S.henon_heiles, "verlet", (30, 0), direction=0, dt=0.1)
        crossed(S.escape, "verlet", (0, 9), [S.escape.y0, [0.0, 0.1, 0.1, 0.0]])
        crossed(S.pendulum, "verlet", (0, 30))
        crossed(S.nonseparable, "verlet")
        crossed("pendulum")
        crossed(S.pendulum, "verlet", coordinate="x")
        crossed(S.pendulum, "verlet", direction=2)
        crossed(S.pendulum, "verlet", nonsense=1)
    """
    by = ("kahan_li8", "sympflow", "mlp", "rk45", "dopri5", "implicit_midpoint", "strang_parts", "rk4")
    batch = "crossed(S.henon_heiles, method, (0, 30), S.henon_heiles.domain.sample(3, seed=1))"
    return answers(code) | {method: answers(batch, method=method) for method in by}


# peers ------------------------------------------------------------------------------------------------------------


DRIVEN = ["verlet", "omelyan4", "implicit_midpoint", "mollified_impulse", "strang_parts", "rk4", *FLOWS]


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
    time_transformed(S.kepler)
    Run("rk45", "henon_heiles")(dense_output=True)
    Run("dopri5", "henon_heiles")(dense_output=True)
    Run("mlp", "henon_heiles")(dense_output=True)
    Run("sympflow", "henon_heiles")(dense_output=True)
    Run("sympflow", "henon_heiles")(dense_output=True, flow="henon_heiles-sympflow")
    Run("verlet", "henon_heiles")(dense_output=True, y0=states(S.henon_heiles, 2))
    Run("verlet", "henon_heiles")(dense_output=True, y0=tensor(S.henon_heiles.y0))
    get("kahan_li8")(dt=0.2, compensated=True)
    shaken(primed(S.quartic, 3, processor=2, polynomial=4, first="kick", dt=0.5)).requires_grad_(False)
    shaken(split(S.henon_heiles, 3, dt=0.7)).requires_grad_(False)
    shaken(split(S.polar, 2, dt=0.01, terms=3)).requires_grad_(False)
    shipped_flows(S.henon_heiles)[0].load(S.henon_heiles)
    shipped_flows(S.henon_heiles)[0].load().certified
    Tube([[0.0, 1.0], [1.0, 0.0]], 0.1)
    compare(S.pendulum, ["verlet"], t_span=(0, 3), repeats=1).rows
    poincare_section(S.henon_heiles, "verlet", (0, 20))
"""
PICKLED = [f"S.{name}" for name in ["pendulum", "masses", "functions", "torch", "nonseparable", "stiff", "boxed"]]
PICKLED += [f'get("{method}")()' for method in (*DRIVEN, "log_leapfrog", "rk45", "dopri5", "explicit_adams")]


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
    systems
    methods
    flows
    flows kepler
    solve
    solve --help
    solve pendulum
    solve henon-heiles --t-end 5
    solve kepler --tol 1e-6 --t-end 3
    solve henon-heiles-escape --method verlet --t-end 9
    solve nonseparable --method verlet
    solve pendulum --method sympflow:flow=pendulum-sympflow --t-end 3
    solve pendulum --t-end 5 --out y.npz
    solve pendulum --method verlet --y0 1,a
    solve pendulum --method vertel
    solve pendulum --method verlet:rtol=1
    solve pendulum --method none.safetensors
    solve henon-hiles
    compare
    compare --help
    compare pendulum --out /dev/null/at/all
    compare pendulum --methods verlet,rk45,sympflow --t-end 5 --n-outputs 20 --repeats 1 --out out
    compare harmonic-oscillator pendulum:t_end=3 --methods verlet,kahan_li8:dt=0.5 --t-end 4 --n-outputs 9 --repeats 1
    bench --help
    bench pendulum --methods verlet --t-end 5 --n-outputs 5 --repeats 1 --batch 2 --out out
    stability --help
    stability harmonic-oscillator --methods verlet --steps 0.5,3 --t-end 20 --metrics energy --out out
    stability harmonic-oscillator --vary omega=1,10 --methods verlet --steps 0.1 --t-end 5 --metrics energy --no-limits
    train
    train --help
    train pendulum --resume none.ckpt
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
    sympflow.solve(sympflow.systems.pendulum(), 'verlet', (0, 1))
    sympflow.volume_error(sympflow.solve(sympflow.systems.pendulum(), 'verlet', (0, 1), backend='array'))
"""


@cases(lines(LOADED))
def imports(code: str) -> Any:
    """The heavy modules that a process has loaded after some code."""
    return in_a_process(
        "-c", f"import sympflow, sys; {code}; print('loaded:', *(m for m in '{HEAVY}'.split() if m in sys.modules))"
    )


# what there is ----------------------------------------------------------------------------------------------------


CLASSES = (HamiltonianSystem, Solution, Box, Ball, EnergySublevel, Tube, SympFlow, MLPFlow, Potential, MLPPotential)
CLASSES += (Kick, Drift, Scheme, Outcome, Integrator, FixedStep)


@case
def public_names() -> Any:
    """The public names, and their signatures."""
    found: dict[str, Any] = {"all": sympflow.__all__, "dir": dir(sympflow)}
    for name in sympflow.__all__:
        thing = getattr(sympflow, name)
        found[name] = f"signature {inspect.signature(thing)}" if callable(thing) else str(type(thing))
    for cls in CLASSES:
        inherited = set(dir(nn.Module)) if issubclass(cls, nn.Module) else set()
        for name in sorted(n for n in dir(cls) if not n.startswith("_") and n not in inherited):
            member = inspect.getattr_static(cls, name)
            kind = f"signature {inspect.signature(member)}" if inspect.isfunction(member) else type(member).__name__
            found[f"{cls.__name__}.{name}"] = kind
    return found


# recording and comparing ------------------------------------------------------------------------------------------


def run_cases(names: list[str]) -> dict[str, dict[str, Leaf]]:
    """The leaves of the cases."""
    found, group, since = {}, "", time.perf_counter()
    for name in names:
        if name.partition(":")[0] != group:
            group = name.partition(":")[0]
            print(f"  {group}, at {time.perf_counter() - since:.0f} s", file=sys.stderr, flush=True)
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


def difference(old: np.ndarray, new: np.ndarray, rounding: float) -> str:
    """Say how two arrays differ; "" if they do not, or by rounding only."""
    if old.dtype != new.dtype or old.shape != new.shape:
        return f"{old.dtype} of shape {old.shape} became {new.dtype} of shape {new.shape}"
    old, new = np.atleast_1d(old), np.atleast_1d(new)
    count = np.count_nonzero(bits(old) != bits(new))
    if count and rounding and old.dtype.kind in "fc":
        size = np.abs(old[np.isfinite(old)]).max(initial=0.0)
        same = np.isclose(old, new, rtol=0.0, atol=rounding * size, equal_nan=True)
        count = np.count_nonzero(~same)
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


def differences(old: dict[str, Leaf], new: dict[str, Leaf], rounding: float) -> tuple[list[str], list[str]]:
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
            if text := difference(a, b, rounding):
                results.append(f"{path}: {text}")
        elif isinstance(a, str) and isinstance(b, str):
            if a != b:
                changed = difflib.unified_diff(a.splitlines(), b.splitlines(), n=0, lineterm="")
                kept = (line for line in changed if not line.startswith(("---", "+++", "@@")))
                words.append("\n      ".join([f"{path}:", *kept]))
        elif type(a) is not type(b) or a != b:
            results.append(f"{path}: {a!r:.300} became {b!r:.300}")
    return results, words


def compare_cases(then: dict[str, dict[str, Leaf]], now: dict[str, dict[str, Leaf]], rounding: float) -> bool:
    """Print all differences, in two sections; True if there is none."""
    found: dict[str, dict[str, list[str]]] = {"results": {}, "words": {}}
    for name in dict.fromkeys((*then, *now)):
        if name not in then or name not in now:
            found["results"][name] = ["is a new case" if name in now else "is a case no more"]
            continue
        for section, texts in zip(found.values(), differences(then[name], now[name], rounding), strict=True):
            if texts:
                section[name] = texts
    for title, section in found.items():
        count = sum(map(len, section.values()))
        print(f"{title}: {f'{count} differences in {len(section)} cases' if count else 'no difference'}")
        for name, texts in section.items():
            print(f"  {name}", *(f"    {text}" for text in texts), sep="\n")
    return not any(found.values())


def main() -> int:
    """Record or compare; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("record", "compare"), nargs="?")
    parser.add_argument("file", type=Path, nargs="?")
    parser.add_argument("--only", metavar="PATTERN", default="", help="run the cases whose names match")
    parser.add_argument("--rounding", type=float, default=0.0, help="part of the largest number that may differ")
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
    now = run_cases(names)
    if given.action == "record":
        with gzip.open(given.file, "wb", compresslevel=4) as file:
            pickle.dump({"package": sympflow.__file__, "cases": now, "pickles": KEPT}, file)
        return 0
    then = {name: found for name, found in recorded["cases"].items() if re.search(given.only, name)}
    return 0 if compare_cases(then, now, given.rounding) else 1


if __name__ == "__main__":
    sys.exit(main())

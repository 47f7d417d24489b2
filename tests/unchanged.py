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
import difflib
import gzip
import inspect
import io
import math
import os
import pickle
import re
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1", MPLBACKEND="Agg")
os.environ.update(COLUMNS="120", TERMINAL_WIDTH="120", NO_COLOR="1", TERM="dumb")
os.environ.setdefault("SYMPFLOW_CACHE_DIR", str(Path(tempfile.gettempdir()) / "sympflow-unchanged"))

import numpy as np
import torch
from torch import Tensor, nn, tensor

import sympflow
from sympflow import Box, HamiltonianSystem, MLPFlow, Solution, SympFlow, Tube, get, load, shipped_flows, solve, systems
from sympflow.arrays import concatenate
from sympflow.integrators.base import Integrator
from sympflow.schemes import SCHEMES, Scheme

Leaf = np.ndarray | bytes | str
HERE = Path(sympflow.__file__).resolve().parent
CASES: dict[str, Callable[[], Any]] = {}
KEPT: dict[str, bytes] = {}  # pickles that the recording tree made
TIMES = ("wall_time", "run_time", "compile_time", "run_time_spread", "seconds", "training_seconds", "break_even")
nan = math.nan


def cases(each: Iterable[str]) -> Callable[[Callable[[str], Any]], Callable[[str], Any]]:
    """Register a function of one argument as a case for each name."""

    def register(function: Callable[[str], Any]) -> Callable[[str], Any]:
        CASES.update({f"{function.__name__}: {name}": partial(function, name) for name in each})
        return function

    return register


# from calls to leaves ---------------------------------------------------------------------------------------------


def tried(call: Callable[..., Any], *arguments: Any) -> dict[str, Leaf]:
    """The leaves of a call's answer, or of its exception, and its warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            found = dict(leaves(call(*arguments)))
        except (Exception, SystemExit) as error:
            found = dict(leaves({"raises": type(error).__name__, "says": str(error)}))
    ours = (w for w in caught if issubclass(w.category, UserWarning | RuntimeWarning) and "torch" not in w.filename)
    warned = sorted({f"{w.category.__name__}: {w.message}" for w in ours})
    return found | {f"warning {i}": cleaned(text) for i, text in enumerate(warned)}


def lines(text: str) -> list[str]:
    """The lines of a text that hold something."""
    return [line for line in map(str.strip, text.splitlines()) if line]


def answers(code: str, **names: Any) -> dict[str, dict[str, Leaf]]:
    """Evaluate expressions, one a line; each line is the name of its answer."""
    return {line: tried(eval, line, globals() | names) for line in lines(code)}


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


# the systems ------------------------------------------------------------------------------------------------------


def plain_potential(q):
    return (q**2).sum(-1) / 2 + q[..., 0] ** 2 * q[..., 1]


def plain_gradient(q):
    a, b = q[..., :1], q[..., 1:]
    return concatenate([a + 2 * a * b, b + a**2])


def torch_potential(q):
    return -torch.cos(q[..., 0]) + q[..., 1] ** 4 / 4 + (q[..., 0] * q[..., 1]) ** 2 / 2


def torch_hamiltonian(q, p):
    return torch.sqrt(1 + (p**2).sum(-1)) + (q**2).sum(-1) / 2 + (q * p).sum(-1) / 10


Y4 = [0.3, -0.2, 0.1, 0.4]
PLAIN = {"potential": plain_potential, "gradient": plain_gradient}
MASSES = "p1**2 + p1*p2/3 + p2**2/2 + a*(q1**2 + q2**2 + q1*q2**3)/2"
SYSTEMS = """
    pendulum = systems.pendulum()
    henon_heiles = systems.henon_heiles()
    escape = systems.henon_heiles_escape()
    oscillator = systems.harmonic_oscillator()
    oscillator_100 = systems.harmonic_oscillator(100.0)
    kepler = systems.kepler(0.6)
    quartic = systems.quartic()
    fput = systems.fput(50.0)
    fput_1000 = systems.fput(1000.0)
    nonseparable = systems.nonseparable()
    polar = systems.spring_pendulum(1e6, coordinates="polar")
    planets = systems.outer_solar_system()
    masses = symbolic(MASSES, params={"a": 1.5}, name="masses", y0=Y4, energy_scale=0.5)
    relativistic = symbolic("sqrt(1 + p**2) + q**2/2 + q**4/4", y0=[0.5, 0.4], domain=Box([-1, -1], [1, 1]))
    stiff = symbolic("(p1**2 + p2**2)/2 + 50*q2**2 + (q1 - q2)**4/4", y0=[0.5, 0.02, 0.1, 0.1], dt=0.02)
    functions = HamiltonianSystem(**PLAIN, ndof=2, name="functions", y0=Y4)
    torch = HamiltonianSystem(torch_potential, ndof=2, mass=[1.0, 2.0], name="torch", y0=Y4)
    whole = HamiltonianSystem(hamiltonian=torch_hamiltonian, ndof=2, name="whole", y0=Y4)
"""
MAKERS = dict(line.split(" = ", 1) for line in lines(SYSTEMS))
symbolic = HamiltonianSystem.from_sympy


class Systems:
    """The systems, each made when it is first asked for."""

    @cache  # noqa: B019
    def __getattr__(self, name: str) -> HamiltonianSystem:
        if name not in MAKERS:
            raise AttributeError(name)
        return eval(MAKERS[name])


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
        f(t0 - (t1 - t0))
        f(nan)
    """
    return {"solution": sol} | answers(code, f=sol.sol, t0=sol.t_span[0], t1=sol.t_span[1])


def sloped(run: Callable[..., Solution], y0: Any, dense: bool = False) -> Any:
    """A run from a tensor, and the gradient of a sum of its states."""
    x = tensor(y0, dtype=torch.float64, requires_grad=True)
    sol = run(y0=x, dense_output=dense)
    y = sol.sol(float(np.mean(sol.t_span))) if dense else sol.y
    weights = torch.arange(1, y.numel() + 1, dtype=y.dtype).reshape(y.shape) / y.numel()
    return {"solution": sol, "gradient": torch.autograd.grad((weights * y).sum(), x)[0]}


# every method -----------------------------------------------------------------------------------------------------


METHODS = [m for m in sympflow.available() if getattr(sympflow.get(m), "splitting", "") != "kepler"]
FLOWS = ("sympflow", "mlp")
SLOW = ("adaptive_heun", "fehlberg2", "bosh3")  # at their usual tolerances


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


def own(method: str) -> Run:
    """The run by which a method is looked at."""
    stiff = method.startswith("linear_") or method in ("impulse", "mollified_impulse", "implicit_explicit")
    return Run(method, "stiff" if stiff else "kepler" if method.startswith("log_") else "henon_heiles")


OF_EACH = """
    [type(m).name, m.order, m.symplectic, m.trained, m.options(), str(inspect.signature(type(m)))]
    run()
    run(t_eval=[])
    run(save_every=3)
    seen(run(dense_output=True, t_eval=run.times))
    replace(run, backwards=True)(t_eval=run.times[::-1])
    run(y0=run.batch, t_eval=run.times)
    run(events=[event(crosses, direction=-1), late], t_eval=run.times)
    run(dtype="float32", t_eval=run.times)
    run(backend="array", t_eval=run.times)
    sloped(partial(replace(run, steps=6.4), t_eval=run.times[:2]), run.system.y0)
    solve(S.nonseparable, m, (0, 2.6 * S.nonseparable.dt))
    solve(S.functions, m, (0, 2.6 * S.functions.dt))
    run(nonsense=1)
"""
OF_KINDS = """
    seen(replace(run, backwards=True)(dense_output=True))
    seen(run(y0=run.batch[:2], dense_output=True))
    solve(run.system, run.method, (1.5, 1.5), dense_output=True)
    run(y0=run.batch[:4].reshape(2, 2, -1), t_eval=run.times)
    replace(run, backwards=True)(y0=run.batch, t_eval=run.times[::-1])
    seen(run(events=event(crosses, terminal=2), dense_output=True))
    run(events=crosses, event_step=0.3 * run.system.dt, t_eval=[])
    run(dtype=np.float32, y0=run.batch, t_eval=run.times[-1:])
    sloped(partial(replace(run, steps=6.4), t_eval=run.times[:1]), run.batch[:3])
    sloped(replace(run, steps=6.4), run.system.y0, dense=True)
    run(backend="array", y0=run.batch, t_eval=run.times)
    run(compensated=True, y0=run.batch, t_eval=run.times)
    [s.energy(), s.energy_error(), sympflow.max_energy_error(s), sympflow.volume_error(s, over_time=True)]
    [sympflow.symplecticity_defect(s), sympflow.time_reversal_error(s), sympflow.reference_error(s), dict(s.to_scipy())]
"""
KINDS = """
    verlet on kepler
    srkn6b on polar
    implicit_midpoint on nonseparable
    gauss_legendre4 on whole
    linear_srkn6b on fput
    log_leapfrog on functions
    rk45 on nonseparable
    dopri5 on torch
    implicit_adams on functions
    sympflow on kepler
    verlet on masses
    kahan_li8 on relativistic
"""


def looked_at(code: str, run: Run) -> Any:
    """A run in the ways that some lines have, with events at a level of q₁ and late."""
    level, (t0, t1) = 0.9 * float(run.system.y0[0]), run.ends
    late = event(lambda t, y: t - t0 - 0.4321 * (t1 - t0), terminal=True)
    s = replace(run, steps=4.4)()
    return answers(code, run=run, m=s.integrator, s=s, late=late, crosses=lambda t, y: y[0] - level)


@cases(METHODS)
def method(name: str) -> Any:
    """A method: single, batch, tensor, times between steps, events, dense output, backwards, refusals."""
    return looked_at(OF_EACH, own(name))


@cases(lines(KINDS))
def kind(line: str) -> Any:
    """A kind of method on another system, more closely."""
    return looked_at(OF_EACH + OF_KINDS, Run(*line.split(" on ")))


# flows ------------------------------------------------------------------------------------------------------------


SAID = "kind ndof dt n_parameters system_name fingerprint recipe figures certified history"


def about(flow: Any) -> dict[str, Any]:
    """Note all that a flow says of itself, and its weights."""
    found: dict[str, Any] = {name: getattr(flow, name) for name in SAID.split()} | {"flow": flow}
    found["domain"] = None if flow.domain is None else flow.domain.to_dict()
    found |= {"weights": dict(flow.state_dict()), "dtype": str(flow.dtype)}
    return found | {"trainable": [w.requires_grad for w in flow.parameters()]}


def saved(flow: Any) -> dict[str, Any]:
    """The flow that is read from its file."""
    with folder() as place:
        flow.save(place / "a.safetensors")
        again = load(place / "a.safetensors", system=getattr(flow, "system", None))
        return {"loaded": about(again), "class": type(again)}


def as_map(flow: Any, x: Tensor) -> dict[str, Any]:
    """A flow as a map: at all kinds of times, with its inverse, velocity and Hamiltonian, and their gradients."""
    code = """
        flow(nan, x)
        flow(dt, x.numpy())
        flow(1.2 * dt, x[0])
        flow.psi_and_velocity(inside, x)
    """
    for t in ("0.0", "0.37 * dt", "2.6 * dt", "-1.4 * dt", "anywhere"):
        code += f"flow({t}, x)\nflow.inverse({t}, x)\n"
    for t in ("0.37 * dt", "inside"):
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
        seen(run(dense_output=True))
    """
    ends = (0.3, 0.3 + 6.4 * step)

    def run(t_span: Any = ends, **given: Any) -> Solution:
        return solve(one, method, t_span, **chosen | given)

    return answers(code, run=run, ends=ends, one=one, step=step)


HOMES = "henon_heiles pendulum quartic kepler oscillator oscillator_100 fput fput_1000 polar planets"
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


@cases([flow.name for flow in shipped_flows()])
def shipped(name: str) -> Any:
    """A flow that ships: its record, its certificate, its weights, and its system solved with it; some more closely."""
    code = """
        [repr(entry), entry.kind, entry.dt, flow.certified, str(flow.certified)]
        about(flow)
        solve(one, kind, (0.3, 0.3 + 6.4 * entry.dt), flow=name, t_eval=[0.3 + 1.7 * entry.dt, 0.3 + 6.4 * entry.dt])
        solve(one, flow, (0.3, 0.3 + 2.4 * entry.dt), backend="array")
    """
    homes = (getattr(S, home) for home in HOMES.split())
    one, entry = next((one, f) for one in homes for f in shipped_flows(one) if f.name == name)
    flow = entry.load(one)
    x = one.y0 * np.linspace(0.98, 1.0, 5)[:, None]
    if flow.ndof > one.ndof:  # of a flow in another time, which is a coordinate then
        d, B = one.ndof, entry.shift - one.hamiltonian(x)
        x = np.column_stack([x[:, :d], np.zeros(5), x[:, d:], B])
    if name in lines(CLOSELY):
        code += "as_map(flow, tensor(x))\nsaved(flow)\nas_method(one, kind, entry.dt, flow=name)\nentry.load(S.masses)"
    return answers(code, entry=entry, flow=flow, x=x, one=one, name=name, kind=entry.kind)


OWN_TABLE = Scheme("own", 2, (0.5, 0.5), (1.0, 0.0), (0.01, 0.01), "a table of one's own")
primed, split = SympFlow.primed, SympFlow.split
FLOWS_OF = """
    henon_heiles: SympFlow(2, pairs=2, hidden=(5, 4, 3), activation="sin", dt=0.5, seed=3)
    henon_heiles: MLPFlow(2, (5, 6, 7), activation="logcosh", dt=0.5, seed=2)
    pendulum: primed(S.pendulum, 3, palindromic=False, dt=0.5)
    henon_heiles: primed(S.henon_heiles, 2, processor=2, curvature=True, dt=0.7)
    quartic: primed(S.quartic, 3, processor=2, polynomial=4, first="kick", dt=0.5)
    henon_heiles: primed(S.henon_heiles, scheme=OWN_TABLE, dt=0.4)
    henon_heiles: primed(S.henon_heiles, 2, processor=1, dt=0.5, dtype=torch.float32)
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
    """
    make, one = partial(eval, maker), getattr(S, name)
    flow = shaken(make())
    return answers(code, make=make, flow=flow, one=one, x=tensor(states(one), dtype=flow.dtype))


# training ---------------------------------------------------------------------------------------------------------


QUICK = {"points": 40, "reference_states": 6, "progress": False}
SEARCH = {**QUICK, "restarts": 2, "steps": 6, "label_times": 3}
NET = {**QUICK, "validation_points": 40, "pairs": 1, "hidden": (4,)}
NEWTON = {"kind": "sympflow", "optimizer": "gauss-newton"}
TRAININGS = """
    learned(S.pendulum, flow=primed(S.pendulum, 3, palindromic=False, dt=0.5), **SEARCH)
    learned(S.henon_heiles, flow=primed(S.henon_heiles, 2, processor=2, dt=0.7), energy_weight=0.0, **SEARCH)
    learned(S.quartic, flow=primed(S.quartic, 3, processor=2, polynomial=4, first="kick", dt=0.5), **SEARCH)
    learned(S.kepler, dt=0.05, stages=2, processor=2, **SEARCH)
    learned(S.pendulum, flow=primed(S.pendulum, 3, dt=0.5), loss="labels+residual", frozen_weight=2.0, **SEARCH)
    learned(S.pendulum, stages=2, data=labels(S.pendulum, 0.5), dt=0.5, restarts=2, steps=6, progress=False)
    learned(S.henon_heiles, flow=split(S.henon_heiles, 3, dt=0.7), **SEARCH)
    learned(S.oscillator, steps=5, dtype=torch.float32, schedule="constant", clip=None, **NET)
    learned(S.nonseparable, dt=0.1, steps=5, activation="sin", matching_weight=0.2, matching_times=4, **NET)
    learned(S.pendulum, kind="mlp", optimizer="gauss-newton", steps=3, **NET | {"hidden": (8,)})
    learned(S.pendulum, data=labels(S.pendulum, 0.5), dt=0.5, steps=3, **NEWTON, **NET)
"""


def labels(one: HamiltonianSystem, dt: float, n: int = 24) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Labels as a user would make them: times, states, and where the flow takes them."""
    x = one.domain.sample(n, seed=4)
    y = solve(one, "kahan_li8", (0, dt), y0=x, dt=dt / 50, t_eval=[dt / 2, dt]).y
    return np.repeat([dt / 2, dt], n), np.tile(x, (2, 1)), np.concatenate([y[..., 0], y[..., 1]])


def learned(one: HamiltonianSystem, **given: Any) -> Any:
    """Train, and note the flow, and what is said on the way."""
    calls: list[Any] = []
    flow = sympflow.train(one, callback=lambda step, figures: calls.append({"step": step, **figures}), **given)
    return {"flow": about(flow), "calls": calls}


# studies ----------------------------------------------------------------------------------------------------------


EVERY = ("error", "energy", "drift", "volume", "symplecticity", "reversal")
STUDIES = """
    compared(S.henon_heiles, ["sympflow", "mlp", "verlet", "rk4", "dop853", "dopri5"], EVERY)
    compared(S.henon_heiles, ["sympflow", "verlet", "rk45"], EVERY, y0=S.henon_heiles.domain.sample(3, 0))
    compared(S.nonseparable, ["verlet", "implicit_midpoint", "rk45", "sympflow"])
    compared(S.escape, ["verlet", "rk45", "dopri5"])
    compared(S.pendulum, ["verlet", "rk45", "sympflow"], match="energy_error")
    compared(S.pendulum, ["verlet", "rk45"], ("drift", "energy"), t_span=(0, 50), backend="array")
    swept(S.pendulum, ["verlet", "kahan_li8", "rk45", "sympflow", ("mine", get("srkn6b")(dt=0.2))])
    swept(S.henon_heiles, ["verlet", "dop853", "sympflow"], batch=3)
    swept(S.nonseparable, ["verlet", "implicit_midpoint"], backend="array")
    limited(S.oscillator, ["verlet", "leapfrog", "implicit_midpoint", "rk4", "rk45", "sympflow"])
    limited([S.oscillator, S.oscillator_100], ["verlet"], dtypes=("float64", "float32"), metrics=("energy",))
    limited(S.escape, ["verlet", "rk45"], steps=[0.05, 0.5], t_span=(0, 8))
    limited(S.nonseparable, ["verlet", "gauss_legendre4"], steps=[0.05, 0.5, 2.0], limits=False)
    crossed(S.kepler, "log_leapfrog", (0, 30), level=0.1)
    crossed(S.henon_heiles, "verlet", (30, 0), direction=0, dt=0.1)
    crossed(S.escape, "verlet", (0, 9), [S.escape.y0, [0.0, 0.1, 0.1, 0.0]])
    crossed(S.henon_heiles, "sympflow", (0, 30), S.henon_heiles.domain.sample(3, seed=1))
    crossed(S.henon_heiles, "rk45", (0, 30), S.henon_heiles.domain.sample(3, seed=1))
"""


def compared(one: HamiltonianSystem, *given: Any, **options: Any) -> Any:
    """A comparison: its rows and table, without times."""
    r = sympflow.compare(one, *given, **{"t_span": (0, 10), "n_outputs": 20, "repeats": 1} | options)
    code = """
        [r.rows, r.t, r.title, r.metrics, r.t_span, r.y0]
        [r.reference.y, r.reference.method, r.reference.accuracy]
        [untimed(r.table()), sorted(r.to_dict())]
    """
    return answers(code, r=r)


def swept(one: HamiltonianSystem, *given: Any, **options: Any) -> Any:
    """A work–precision study, without times."""
    few = {"t_span": (0, 10), "n_outputs": 10, "repeats": 1, "steps": [0.4, 0.2, 0.1], "tolerances": [1e-3, 1e-6]}
    r = sympflow.work_precision(one, *given, **few | options)
    return [r.rows, r.title, r.sizes, r.t_span, r.references, untimed(r.table())]


def limited(one: Any, *given: Any, **options: Any) -> Any:
    """A study of stability, with what it says on its way."""
    said: list[str] = []
    few = {"steps": [0.5, 1.5, 3.0], "min_steps": 60, "max_steps": 600, "progress": said.append}
    r = sympflow.stability(one, *given, **few | options)
    return [r.rows, r.limits, r.table(), said]


def crossed(*given: Any, **options: Any) -> Any:
    """A Poincaré section: its crossings and table."""
    r = sympflow.poincare_section(*given, **options)
    return [r, repr(r), r.success, len(r), r.table(5)]


@cases(lines(TRAININGS + STUDIES))
def study(line: str) -> Any:
    """A short training, a training that is killed and resumed, or a study."""
    return eval(line)


# pickles and the command line -------------------------------------------------------------------------------------


PICKLES = """
    S.masses
    S.functions
    S.torch
    get("verlet")()
    get("log_leapfrog")()
    get("dopri5")()
    get("kahan_li8")(dt=0.2, compensated=True)
    sympflow.time_transformed(S.kepler)
    Run("rk45", "henon_heiles")(dense_output=True)
    Run("sympflow", "henon_heiles")(dense_output=True)
    Run("verlet", "henon_heiles")(dense_output=True, y0=states(S.henon_heiles, 2))
    Run("verlet", "henon_heiles")(dense_output=True, y0=tensor(S.henon_heiles.y0))
    shaken(primed(S.quartic, 3, processor=2, polynomial=4, first="kick", dt=0.5)).requires_grad_(False)
    shipped_flows(S.henon_heiles)[0].load(S.henon_heiles)
    Tube([[0.0, 1.0], [1.0, 0.0]], 0.1)
    sympflow.compare(S.pendulum, ["verlet"], t_span=(0, 3), repeats=1).rows
    sympflow.poincare_section(S.henon_heiles, "verlet", (0, 20))
"""


@cases(lines(PICKLES))
def pickled(code: str) -> Any:
    """Something pickled and read again, now, and from the bytes that the recording tree made of it."""
    now = pickle.dumps(eval(code))
    return {"now": tried(pickle.loads, now), "then": tried(pickle.loads, KEPT.setdefault(code, now))}


COMMANDS = """
    --help
    systems
    methods
    flows kepler
    solve pendulum
    solve kepler --tol 1e-6 --t-end 3
    solve henon-heiles-escape --method verlet --t-end 9
    solve pendulum --method sympflow:flow=pendulum-sympflow --t-end 3
    solve pendulum --t-end 5 --out y.npz
    solve pendulum --method verlet --y0 1,a
    solve pendulum --method verlet:rtol=1
    compare pendulum --methods verlet,rk45,sympflow --t-end 5 --n-outputs 20 --repeats 1 --out out
    compare harmonic-oscillator pendulum:t_end=3 --methods verlet,kahan_li8:dt=0.5 --t-end 4 --n-outputs 9 --repeats 1
    bench pendulum --methods verlet --t-end 5 --n-outputs 5 --repeats 1 --batch 2 --out out
    stability harmonic-oscillator --methods verlet --steps 0.5,3 --t-end 20 --metrics energy --out out
    stability harmonic-oscillator --vary omega=1,10 --methods verlet --steps 0.1 --t-end 5 --metrics energy --no-limits
    train harmonic-oscillator --pairs 1 --hidden 4 --optimizer adam --steps 3 --points 40 --out f.safetensors
    train pendulum --stages 2 --restarts 1 --steps 3 --points 20 --dt 0.5 --checkpoint run.ckpt
"""


@cases(["", *lines(COMMANDS)])
def shell(words: str) -> Any:
    """A command: its exit status, what it prints, and the names of the files that it writes."""
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
        files = sorted(str(path.relative_to(place)) for path in place.rglob("*") if path.is_file())
    return {"status": status, "prints": prints, "errors": err.getvalue(), "files": files}


# recording and comparing ------------------------------------------------------------------------------------------


def run_cases(names: list[str]) -> dict[str, dict[str, Leaf]]:
    """The leaves of the cases."""
    found, since = {}, time.perf_counter()
    for name in names:
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


def difference(old: Leaf | None, new: Leaf | None, rounding: float) -> str:
    """Say how two leaves differ; "" if they do not, or by rounding only."""
    if isinstance(old, str) and isinstance(new, str):
        changed = difflib.unified_diff(old.splitlines(), new.splitlines(), n=0, lineterm="")
        return "\n      ".join(line for line in changed if not line.startswith(("---", "+++", "@@")))
    if not isinstance(old, np.ndarray) or not isinstance(new, np.ndarray):
        return "" if type(old) is type(new) and old == new else f"{old!r:.300} became {new!r:.300}"
    if old.dtype != new.dtype or old.shape != new.shape:
        return f"{old.dtype} of shape {old.shape} became {new.dtype} of shape {new.shape}"
    old, new = np.atleast_1d(old), np.atleast_1d(new)
    count = np.count_nonzero(bits(old) != bits(new))
    if count and rounding and old.dtype.kind in "fc":
        size = np.abs(old[np.isfinite(old)]).max(initial=0.0)
        count = np.count_nonzero(~np.isclose(old, new, rtol=0.0, atol=rounding * size, equal_nan=True))
    if not count or old.size == 1:
        return f"{old[0]!r} became {new[0]!r}" if count else ""
    with np.errstate(all="ignore"):
        a, b = old.astype(complex), new.astype(complex)
        relative = abs(a - b) / np.maximum(abs(a), abs(b))
    largest = relative[np.isfinite(relative)].max(initial=0.0)
    return f"{count} of {old.size} numbers differ, by at most {largest:.2g} of their size"


def compare_cases(then: dict[str, dict[str, Leaf]], now: dict[str, dict[str, Leaf]], rounding: float) -> bool:
    """Print all differences, in results and in words; True if there is none."""
    found: dict[str, list[str]] = {"results": [], "words": []}
    for name in dict.fromkeys((*then, *now)):
        old, new = then.get(name, {}), now.get(name, {})
        for path in dict.fromkeys((*old, *new)):
            if text := difference(old.get(path), new.get(path), rounding):
                section = "words" if isinstance(old.get(path, new.get(path)), str) else "results"
                found[section].append(f"  {name}\n    {path}: {text}")
    for title, texts in found.items():
        print(f"{title}: {len(texts) or 'no'} differences", *texts, sep="\n")
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
    if given.action == "record":
        now = run_cases(names)
        with gzip.open(given.file, "wb", compresslevel=4) as file:
            pickle.dump({"package": sympflow.__file__, "cases": now, "pickles": KEPT}, file)
        return 0
    with gzip.open(given.file) as file:
        recorded = pickle.load(file)
    KEPT.update(recorded["pickles"])
    print(f"recorded: {recorded['package']}", flush=True)
    then = {name: leaves for name, leaves in recorded["cases"].items() if re.search(given.only, name)}
    return 0 if compare_cases(then, run_cases(names), given.rounding) else 1


if __name__ == "__main__":
    sys.exit(main())

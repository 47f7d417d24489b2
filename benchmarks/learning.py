"""Learning from data, by the protocols of published models: `sympflow.learn` and `sympflow.discover`.

    python benchmarks/learning.py [--out docs/measured]         all of them
    python benchmarks/learning.py --only hnn-spring             one protocol
    python benchmarks/learning.py --only discovery              formulas of four systems
    python benchmarks/learning.py --only sweeps                 the authors' sweeps in noise, N and M, with a figure
    python benchmarks/learning.py --only measured --write FOLDER    data as they are measured, and as CSV files

The data are made here, by the descriptions of the authors' generators, from solutions that are exact to 1e-10. "Theirs"
are published figures (`SOURCES`), or, where the protocol asks for it, a baseline by code of this file that gets as much
processor time as the fit and at least `--baseline` seconds. Float64, one thread; seconds are processor time.
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from measuring.machine import pin_to_one_thread

pin_to_one_thread()

import numpy as np
import torch
from contenders import networks
from measuring import fragments
from scipy.signal import savgol_filter

import sympflow
from sympflow import HamiltonianSystem, SympFlow, discover, solve, systems

SOURCES = {
    "authors": "the paper's supervised experiment: N = 100 states, M = 50 irregular times in [0, 1], noise on targets",
    "ghnn": "GHNN (AELITTEN/GHNN): exact labels in place of the authors', which err by 1e-4 to 1e-3",
    "hnn": "HNN (greydanus/hamiltonian-nn): 50 trajectories, half for training, σ = 0.1",
    "d-hnn": "D-HNN (greydanus/dissipative_hnns): damped spring, γ = 0.1, σ = 0.01",
    "measured": "M. Schmidt, H. Lipson, Science 324 (2009) 81–85: the kinds of systems and of data, made by a seed",
}
PENDULUM = systems.pendulum()
SPRING = HamiltonianSystem.from_sympy("p**2 + q**2", name="spring")
HNN_PENDULUM = HamiltonianSystem.from_sympy("p**2 + 2*(1 - cos(q))", name="hnn_pendulum")
DAMPED = HamiltonianSystem.from_sympy("(p**2 + q**2)/2", damping=0.1, name="damped_spring")
CHAIN = HamiltonianSystem.from_sympy(
    "(p1**2 + p2**2 + p3**2 + p4**2)/2 + (q1**2 + q2**2 + q3**2 + q4**2)/2"
    " + ((q1 - q2)**4 + (q2 - q3)**4 + (q3 - q4)**4)/4"
)
KEPLER = HamiltonianSystem.from_sympy("(p1**2 + p2**2)/2 - 1/sqrt(q1**2 + q2**2)")


@dataclass(frozen=True)
class Row:
    """A line of the table; figures are text, for some are pairs; baselines have no target."""

    protocol: str
    metric: str
    theirs: str
    target: float | None
    ours: float
    seconds: float
    remark: str = ""

    def cells(self) -> list[str]:
        reached = "" if self.target is None else "yes" if self.ours <= self.target else "no"
        figures = [self.theirs, fragments.number(self.target), fragments.number(self.ours), reached]
        return [self.protocol, self.metric, *figures, f"{self.seconds:.0f}", self.remark]


def exact(system: HamiltonianSystem, y0: np.ndarray, t: np.ndarray) -> np.ndarray:
    """States (N, 2d, n) at times t, which start at 0."""
    span = (0.0, float(t[-1]))
    if system.conservative:
        method = "kahan_li8" if system.separable else "gauss_legendre8"
        return solve(system, method, span, y0, t_eval=t, dt=0.01).raise_for_status().y
    made = [solve(system, "dop853", span, start, t_eval=t, rtol=1e-11, atol=1e-12) for start in y0]
    return np.array([sol.raise_for_status().y for sol in made])


def timed(f: Callable[[], Any]) -> tuple[Any, float]:
    start = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        found = f()
    return found, time.process_time() - start


def predicted(flow: Any, y0: np.ndarray, t: np.ndarray) -> np.ndarray:
    """States (N, 2d, n) by a learned flow."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return solve(flow.system, flow, (0.0, float(t[-1])), y0, t_eval=t).y


def by_scheme(system: HamiltonianSystem, y0: np.ndarray, t: np.ndarray) -> np.ndarray:
    """States (N, 2d, n) by a scheme of order 8, with steps whose error is far below those of what was learned."""
    method = "kahan_li8" if system.separable else "gauss_legendre8"
    return solve(system, method, (0.0, float(t[-1])), y0, t_eval=t, dt=0.05).y


def energy_mse(system: HamiltonianSystem, found: np.ndarray, true: np.ndarray) -> float:
    """Mean square of the true H along predictions, less that along the true solutions."""
    H = [system.hamiltonian(np.moveaxis(y, -1, -2)) for y in (found, true)]
    return float(np.mean((H[0] - H[1]) ** 2))


# baselines of our own -------------------------------------------------------------------------------------------------


def adam(x: np.ndarray, t: np.ndarray, y: np.ndarray, dt: float, seconds: float) -> SympFlow:
    """A SympFlow of 5 pairs of layers of 10 by Adam on labels y (n, 2d), a time t (n,) after x, in processor time."""
    torch.manual_seed(0)
    inputs, times, targets = (torch.tensor(a) for a in (x, t, y))
    flow = SympFlow(x.shape[1] // 2, 5, [10], dt=dt, seed=0)
    optimizer = torch.optim.Adam(flow.parameters(), 5e-3)
    start, generator = time.process_time(), torch.Generator().manual_seed(0)
    while time.process_time() - start < seconds:
        for group in optimizer.param_groups:
            group["lr"] = 5e-3 * (1 - 0.98 * (time.process_time() - start) / seconds)
        i = torch.randint(len(times), (500,), generator=generator)
        optimizer.zero_grad()
        loss = ((flow.psi(times[i], inputs[i]) - targets[i]) ** 2).sum(-1).mean()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(flow.parameters(), 1.0)
        optimizer.step()
    return flow


def adam_on_steps(t: np.ndarray, y: np.ndarray, dt: float, seconds: float) -> SympFlow:
    """The same on all steps of trajectories y (N, 2d, n) from one point to the next."""
    x, target = (part.transpose(0, 2, 1).reshape(-1, y.shape[1]) for part in (y[..., :-1], y[..., 1:]))
    return adam(x, np.tile(np.diff(t), len(y)), target, dt, seconds)


def stepped(flow: SympFlow, y0: np.ndarray, dt: float, n: int) -> np.ndarray:
    """States (N, 2d, n + 1) after 0 to n steps."""
    made, x = [y0], torch.tensor(y0)
    with torch.no_grad():
        for _ in range(n):
            x = flow.psi(dt, x)
            made.append(x.numpy())
    return np.stack(made, axis=-1)


# the authors' experiment ----------------------------------------------------------------------------------------------


def authors_data(
    system: HamiltonianSystem, width: float, eps: float, n: int, m: int, seed: int
) -> tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray]:
    """N trajectories of M irregular times in [0, 1] and their start, without noise; and held-out states."""
    random = np.random.default_rng(seed)
    states = random.uniform(-width, width, (n + 100, 2 * system.ndof))
    data = []
    for start in states[:n]:
        t = np.concatenate([[0.0], np.sort(random.uniform(0.0, 1.0, m))])
        y = exact(system, start[None], t)[0]
        y[:, 1:] += eps * random.normal(size=(len(y), m))
        data.append((t, y))
    return data, states[n:]


def authors_adam(data: list[tuple[np.ndarray, np.ndarray]], seconds: float) -> SympFlow:
    """The paper's mode: a SympFlow on the labels."""
    x = np.concatenate([np.repeat(y[:, :1].T, y.shape[1] - 1, 0) for _, y in data])
    t = np.concatenate([one[1:] for one, _ in data])
    return adam(x, t, np.concatenate([y[:, 1:].T for _, y in data]), 1.0, seconds)


def one_step_error(flow: Any, system: HamiltonianSystem, held: np.ndarray) -> float:
    """The mean distance after Δt = 1 of a flow that was learned, or of one by Adam, which belongs to no system."""
    t = np.array([0.0, 1.0])
    truth = exact(system, held, t)[:, :, -1]
    made = stepped(flow, held, 1.0, 1) if flow.system is None else predicted(flow, held, t)
    return float(np.linalg.norm(made[:, :, -1] - truth, axis=1).mean())


def authors(system: HamiltonianSystem, width: float, eps: float, options: argparse.Namespace) -> list[Row]:
    """The model that `learn` chooses, which must meet the target, and beside it networks fitted to the same data."""
    data, held = authors_data(system, width, eps, 100, 50, 0)
    flow, seconds = timed(lambda: sympflow.learn(data, dt=1.0))
    budget = max(seconds, options.baseline)
    theirs, ours = (one_step_error(f, system, held) for f in (authors_adam(data, budget), flow))
    name, metric = f"{system.name}, ε = {eps:g}", "one-step error at Δt = 1"
    baseline = f"{fragments.number(theirs)} (Adam, {budget:.0f} s)"
    networks, longer = timed(lambda: sympflow.learn(data, dt=1.0, family="sympflow", time_budget=options.flow_budget))
    return [
        Row(name, metric, baseline, theirs / 10 if eps == 0 else 5e-3, ours, seconds, _model(flow)),
        Row(name, metric, baseline, None, one_step_error(networks, system, held), longer, _model(networks)),
    ]


def authors_rows(system: HamiltonianSystem, width: float, options: argparse.Namespace) -> list[Row]:
    return [row for eps in (0.0, 0.05) for row in authors(system, width, eps, options)]


def _model(flow: Any) -> str:
    return flow.recipe["learned"]["model"]


# GHNN -----------------------------------------------------------------------------------------------------------------


def ghnn_pendulum(options: argparse.Namespace) -> list[Row]:
    """Trained on the first quarter of a period, from rest; judged at one period."""
    from scipy.special import ellipk

    random = np.random.default_rng(0)
    q0 = random.uniform(-0.95 * np.pi, 0.95 * np.pi, 500)
    periods = 4 * ellipk(np.sin(q0 / 2) ** 2)
    y0 = np.stack([q0, np.zeros(500)], 1)
    t = np.arange(0.0, periods.max() + 0.1, 0.1)
    y = exact(PENDULUM, y0, t)
    at = np.minimum(np.round(periods / 0.1).astype(int), len(t) - 1)[400:]
    truth = y[400 + np.arange(100), :, at]
    rows = []
    for sigma in (0.0, 1e-4):
        labels = y + sigma * random.normal(size=y.shape)
        data = [(t[:n], labels[i, :, :n]) for i in range(400) if (n := int(periods[i] / 4 / 0.1) + 1) > 1]
        fits: dict[str, Callable[[], Any]] = {
            "learn": lambda data=data: sympflow.learn(data[: options.runs], dt=0.5),  # type: ignore[misc]
            "discover": lambda data=data: discover(data[: options.runs]),  # type: ignore[misc]
        }
        for name, fit in fits.items():
            found, seconds = timed(fit)
            remark = _model(found) if name == "learn" else found.discovery.formula()
            made = predicted(found, y0[400:], t) if name == "learn" else by_scheme(found, y0[400:], t)
            error = float(np.abs(made[np.arange(100), :, at] - truth).mean())
            rows.append(
                Row(f"`{name}`{labelled(sigma)}", "MAE at 1 T", "1.3e-3 … 1.1e-2", 1e-3, error, seconds, remark)
            )
    flow, seconds = timed(lambda: adam_on_runs(data[: options.runs], 0.1, options.baseline))
    error = float(np.abs(stepped(flow, y0[400:], 0.1, int(at.max()))[np.arange(100), :, at] - truth).mean())
    rows.append(Row("SympFlow by Adam" + labelled(1e-4), "MAE at 1 T", "0.39 (SympNet)", None, error, seconds))
    return rows


def adam_on_runs(data: list[tuple[np.ndarray, np.ndarray]], dt: float, seconds: float) -> SympFlow:
    """A SympFlow on the steps of trajectories of several lengths."""
    x, y = (np.concatenate([one[:, part].T for _, one in data]) for part in (slice(None, -1), slice(1, None)))
    return adam(x, np.concatenate([np.diff(t) for t, _ in data]), y, dt, seconds)


def labelled(sigma: float) -> str:
    return ", exact labels" if sigma == 0 else f", labels with errors of {sigma:g}"


RATIONAL = "(1 + sin(q1 - q2)**2)"
TERMS = [f"{f}/{RATIONAL}" for f in ("p1**2", "p2**2", "p1*p2", "p1*p2*cos(q1 - q2)", "p1*p2*sin(q1 - q2)")]
"""Terms of a double pendulum's kinetic energy, beside which `discover` has polynomials and trigonometric functions."""


def ghnn_double_pendulum(options: argparse.Namespace) -> list[Row]:
    """From rest at angles within ±π/2, steps of 0.1, trained to t = 5; H is not separable."""
    system, n = systems.double_pendulum(), options.pendulums
    random = np.random.default_rng(0)
    y0 = np.concatenate([random.uniform(-np.pi / 2, np.pi / 2, (n + 100, 2)), np.zeros((n + 100, 2))], 1)
    t = np.linspace(0.0, 10.0, 101)
    y = exact(system, y0, t)
    rows: list[Row] = []

    def judge(name: str, made: np.ndarray, seconds: float, remark: str = "", baseline: bool = False) -> None:
        for at, theirs, target in ((50, "6.3e-3", 4e-3), (100, "2.5e-2", 1.5e-2)):
            error = float(np.abs(made[:, :, at] - y[:100, :, at]).mean())
            print(f"{name}: {error:.2e}, {seconds:.0f} s {remark}", flush=True)
            rows.append(
                Row(name, f"MAE at t = {t[at]:g}", theirs, None if baseline else target, error, seconds, remark)
            )

    for sigma in (0.0, 1e-3):
        data = t[:51], y[100:, :, :51] + sigma * random.normal(size=(n, 4, 51))
        flow, seconds = timed(lambda data=data: sympflow.learn(data, dt=0.1, separable=False, period=2 * np.pi))  # type: ignore[misc]
        judge(f"`learn`, its H{labelled(sigma)}", by_scheme(flow.system, y0[:100], t), seconds, _model(flow))
        judge(f"`learn`, its flow{labelled(sigma)}", predicted(flow, y0[:100], t), seconds)
    found, seconds = timed(lambda: discover(data, [*TERMS, "trigonometric", "polynomials"], degree=2))
    remark = found.discovery.formula()
    judge(f"`discover`{labelled(1e-3)}", by_scheme(found, y0[:100], t), seconds, remark)
    flow, seconds = timed(lambda: adam_on_steps(*data, 0.1, options.baseline))
    judge("SympFlow by Adam" + labelled(1e-3), stepped(flow, y0[:100], 0.1, 100), seconds, baseline=True)
    return rows


BODIES = HamiltonianSystem.from_sympy(
    "(p1**2 + p2**2 + p3**2 + p4**2 + p5**2 + p6**2)/2 - 1/sqrt((q1 - q3)**2 + (q2 - q4)**2)"
    " - 1/sqrt((q3 - q5)**2 + (q4 - q6)**2) - 1/sqrt((q1 - q5)**2 + (q2 - q6)**2)",
    name="three_bodies",
)


def circular_bodies(random: np.random.Generator, n: int) -> np.ndarray:
    """States (n, 12) of three bodies on circles of radii of 0.9 to 1.2, their velocities up to a fifth off.

    By the authors' generator the factor of each velocity is drawn once, for all runs.
    """

    def turned(x: np.ndarray, angle: float) -> np.ndarray:
        return x @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])

    first = random.uniform(-1.0, 1.0, (n, 2))
    radius = random.uniform(0.9, 1.2, (n, 1))
    first *= radius / np.linalg.norm(first, axis=1, keepdims=True)
    places = [turned(first, k * 2 * np.pi / 3) for k in range(3)]
    speed = radius**-1.5 * np.sqrt(np.sin(np.pi / 3) / (2 * np.cos(np.pi / 6) ** 2))
    velocities = [turned(x, np.pi / 2) * speed * random.uniform(0.8, 1.2, 2) for x in places]
    return np.concatenate(places + velocities, axis=1)


def ghnn_three_bodies(options: argparse.Namespace) -> list[Row]:
    """Three bodies near a circle, steps of 0.5, trained to t = 5 and judged there."""
    random = np.random.default_rng(0)
    n = options.runs
    y0 = circular_bodies(random, n + 100)
    t = np.linspace(0.0, 5.0, 11)
    y = exact(BODIES, y0, t)
    rows = []

    def judge(name: str, made: np.ndarray, seconds: float, remark: str = "", baseline: bool = False) -> None:
        error = float(np.abs(made[:, :, -1] - y[:100, :, -1]).mean())
        print(f"{name}: {error:.2e}, {seconds:.0f} s {remark}", flush=True)
        rows.append(Row(name, "MAE at t = 5", "1.2e-3", None if baseline else 1e-3, error, seconds, remark))

    for sigma in (0.0, 1e-3):
        data = t, y[100:] + sigma * random.normal(size=(n, 12, 11))
        flow, seconds = timed(lambda data=data: sympflow.learn(data, dt=0.5, time_budget=options.budget))  # type: ignore[misc]
        judge(f"`learn`, its flow{labelled(sigma)}", predicted(flow, y0[:100], t), seconds, _model(flow))
        judge(f"`learn`, its H{labelled(sigma)}", by_scheme(flow.system, y0[:100], t), seconds)
    flow, seconds = timed(lambda: adam_on_steps(*data, 0.5, options.baseline))
    judge("SympFlow by Adam" + labelled(1e-3), stepped(flow, y0[:100], 0.5, 10), seconds, baseline=True)
    return rows


# HNN ------------------------------------------------------------------------------------------------------------------

TWO_BODIES = HamiltonianSystem.from_sympy(
    "(p1**2 + p2**2 + p3**2 + p4**2)/2 - 1/sqrt((q1 - q2)**2 + (q3 - q4)**2)", name="two_bodies"
)
"""Masses of 1 at (q1, q3) and (q2, q4): the authors' order of coordinates."""


def circles(random: np.random.Generator, radii: tuple[float, float]) -> np.ndarray:
    """50 states on circles of random radii."""
    y0 = random.uniform(-1.0, 1.0, (50, 2))
    return y0 * random.uniform(*radii, (50, 1)) / np.linalg.norm(y0, axis=1, keepdims=True)


def two_circles(random: np.random.Generator) -> np.ndarray:
    """50 states of two bodies on nearly circular orbits about their centre."""
    x = random.uniform(0.5, 1.5, (50, 2))
    r = np.linalg.norm(x, axis=1, keepdims=True)
    v = np.stack([-x[:, 1], x[:, 0]], axis=1) / (2 * r**1.5) * (1 + 0.05 * random.normal(size=(50, 1)))
    return np.stack([x[:, 0], -x[:, 0], x[:, 1], -x[:, 1], v[:, 0], -v[:, 0], v[:, 1], -v[:, 1]], axis=1)


@dataclass(frozen=True)
class Task:
    """One of the tasks of HNN and D-HNN: 25 noisy trajectories of 50 to learn from, the others to be judged by.

    Attributes
    ----------
    start : callable
        start(random): states (50, 2d).
    t, judged : ndarray
        Times of the data, and of the predictions.
    theirs : dict of str to float
        Published mean squares of the energy's error, of each kind of network; the smallest is to be beaten tenfold.
    """

    system: HamiltonianSystem
    start: Callable[[np.random.Generator], np.ndarray]
    t: np.ndarray
    judged: np.ndarray
    theirs: dict[str, float]
    sigma: float = 0.1


def tasks() -> dict[str, Task]:
    far = np.linspace(0.0, 20.0, 201)
    return {
        "spring": Task(
            SPRING, lambda r: circles(r, (0.1, 1.0)), np.linspace(0.0, 3.0, 30), far, {"MLP": 0.17, "HNN": 3.8e-4}
        ),
        "pendulum": Task(
            HNN_PENDULUM,
            lambda r: circles(r, (0.2, 2.0)),
            np.linspace(0.0, 3.0, 45),
            far,
            {"MLP": 4.2e-2, "HNN": 2.5e-2},
        ),
        "two-bodies": Task(
            TWO_BODIES, two_circles, np.linspace(0.0, 20.0, 50), far, {"MLP": 6.3e-2, "HNN": 3.9e-5}
        ),
        "damped": Task(
            DAMPED,
            lambda r: r.uniform(-1.0, 1.0, (50, 2)),
            np.linspace(0.0, 6.0, 61),
            np.linspace(0.0, 6.0, 61),
            {"MLP": 6.0e-6, "HNN": 0.29, "D-HNN": 3.6e-6},
            0.01,
        ),
    }  # fmt: skip


def hnn(name: str, options: argparse.Namespace) -> list[Row]:
    """`learn`, `discover`, and networks on exact derivatives at the noisy states, judged by the energy."""
    task = tasks()[name]
    system, damped = task.system, not task.system.conservative
    random = np.random.default_rng(0)
    y0 = task.start(random)
    clean = exact(system, y0[:25], task.t)
    data = task.t, clean + task.sigma * random.normal(size=clean.shape)
    held, t = y0[25:], task.judged
    truth = exact(system, held, t)
    metric, least = f"energy MSE to t = {t[-1]:g}", min(task.theirs.values())
    rows = []

    def judge(
        name: str, published: float, made: np.ndarray, seconds: float, remark: str = "", ours: bool = True
    ) -> None:
        error = energy_mse(system, made, truth)
        print(f"{name}: {error:.2e}, {seconds:.0f} s {remark}", flush=True)
        rows.append(Row(name, metric, f"{published:.1e}", least / 10 if ours else None, error, seconds, remark))

    flow, seconds = timed(lambda: sympflow.learn(data, damping=damped))
    judge("`learn`", least, predicted(flow, held, t), seconds, _model(flow))
    if damped:
        gamma = float(np.mean(flow.system.damping))
        rows.append(Row("`learn`", "relative error of γ", "", 0.01, abs(gamma / 0.1 - 1), seconds, f"γ = {gamma:.5f}"))
    if system.ndof == 1 and not damped:  # momenta of two bodies that add up to 0 do not tell their masses apart
        found, seconds = timed(lambda: discover(data))
        judge("`discover`", least, by_scheme(found, held, t), seconds, found.discovery.formula())
    x = data[1].transpose(0, 2, 1).reshape(-1, 2 * system.ndof)
    v = system.vector_field(clean.transpose(0, 2, 1).reshape(-1, 2 * system.ndof))
    for kind, theirs in task.theirs.items() if options.networks else ():
        field, seconds = timed(lambda kind=kind: networks.learned_field(kind, x, v, options.networks))  # type: ignore[misc]
        judge(f"{kind}, ours, exact derivatives", theirs, networks.followed(field, held, t), seconds, ours=False)
    return rows


# as measured ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Measured:
    """A system whose positions are filmed, with a friction of 1 %; velocities are slopes of smoothed positions.

    Attributes
    ----------
    start : float
        The size of the positions at the start, at random, at rest.
    dt, judged : float
        The time from one picture to the next, and that of the predictions.
    angles : bool
    """

    system: HamiltonianSystem
    start: float
    dt: float
    judged: float
    angles: bool

    def states(self, n: int, seed: int) -> np.ndarray:
        q = np.random.default_rng(seed).uniform(-self.start, self.start, (n, self.system.ndof))
        return np.concatenate([q, np.zeros_like(q)], axis=1)

    def observed(self, y: np.ndarray) -> np.ndarray:
        """Positions and velocities (N, 2d, n) of states."""
        d = self.system.ndof
        v = np.moveaxis(self.system.vector_field(np.moveaxis(y, -1, -2)), -1, -2)[:, :d]
        return np.concatenate([y[:, :d], v], axis=1)


PICTURES, FILMS, WINDOW = 200, 6, 11
"""Points of a trajectory, trajectories, and points of the cubics by which positions are smoothed."""
BLUR = 0.01
"""Error of a position, in the spread of all."""
MEASURED = {
    "pendulum": Measured(
        HamiltonianSystem.from_sympy("p**2/2 - cos(q)", damping=0.01, name="pendulum"), 2.5, 0.1, 20.0, True
    ),
    "spring": Measured(
        HamiltonianSystem.from_sympy("(p**2 + q**2)/2", damping=0.01, name="spring"), 1.0, 0.1, 20.0, False
    ),
    "double pendulum": Measured(
        HamiltonianSystem.from_sympy(systems.double_pendulum().symbols.H, damping=0.01, name="double_pendulum"),
        1.2, 0.05, 10.0, True,
    ),
    "two carts": Measured(
        HamiltonianSystem.from_sympy(
            "p1**2/2 + p2**2/1.4 + q1**2/2 + (q2 - q1)**2/2 + q2**2/2", damping=0.01, name="two_carts"
        ),
        1.0, 0.1, 20.0, False,
    ),
}  # fmt: skip


def filmed(of: Measured, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, positions with velocities (N, 2d, n), and their slopes, all by cubics through noisy positions."""
    t = of.dt * np.arange(PICTURES)
    q = exact(of.system, of.states(FILMS, seed), t)[:, : of.system.ndof]
    q = q + BLUR * q.std() * np.random.default_rng([seed, 1]).normal(size=q.shape)
    smooth = [savgol_filter(q, WINDOW, 3, deriv=k, delta=of.dt, axis=-1) for k in range(3)]
    return t, np.concatenate(smooth[:2], axis=1), np.concatenate(smooth[1:], axis=1)


def measured_rows(options: argparse.Namespace) -> list[Row]:
    """`learn` by velocities, and what learns from smoothed derivatives, judged by positions from states never seen."""
    rows = []
    for name, of in MEASURED.items():
        t, y, slopes = filmed(of)
        d = of.system.ndof
        if options.write is not None:
            write_films(options.write / f"{of.system.name}.csv", t, y)
        x, v = (part.transpose(0, 2, 1).reshape(-1, 2 * d) for part in (y, slopes))
        y0 = of.states(20, 1000)
        judged = np.arange(0.0, of.judged + of.dt / 2, of.dt)
        truth = exact(of.system, y0, judged)[:, :d]
        start = of.observed(y0[..., None])[..., 0]

        def error(made: np.ndarray, truth: np.ndarray = truth) -> float:
            far = np.clip(np.nan_to_num(made - truth, nan=np.inf), -2 * truth.std(), 2 * truth.std())
            return float(np.sqrt(np.mean(far**2)) / truth.std())

        theirs: dict[str, tuple[float, float]] = {}
        for kind in ("HNN", "MLP", "SINDy"):
            if kind == "SINDy":
                field, seconds = timed(lambda x=x, v=v, of=of: networks.sparse_field(x, v, of.angles))  # type: ignore[misc]
            else:
                steps = 4 * options.networks  # beyond which neither is better
                field, seconds = timed(
                    lambda kind=kind, x=x, v=v, steps=steps: networks.learned_field(kind, x, v, steps)
                )  # type: ignore[misc]
            theirs[kind] = error(networks.followed(field, start, judged)[:, :d]), seconds
        period = 2 * np.pi if of.angles else None
        flow, seconds = timed(
            lambda t=t, y=y, period=period: sympflow.learn((t, y), observed="qv", damping=True, period=period)  # type: ignore[misc]
        )
        with_momenta = np.concatenate([start[:, :d], flow.system.momenta(start[:, :d], start[:, d:])], axis=1)
        ours = error(predicted(flow, with_momenta, judged)[:, :d])
        kind = min(theirs, key=lambda kind: theirs[kind][0])
        metric, best = f"error of q to t = {of.judged:g}, in their spread", theirs[kind][0]
        rows.append(Row(name, metric, f"{fragments.number(best)} ({kind})", best / 2, ours, seconds, _model(flow)))
        print(*rows[-1].cells(), sep=" | ", flush=True)
        rows += [Row(f"{name}, {kind}", metric, "", None, *figures) for kind, figures in theirs.items()]
    return rows


def write_films(path: Path, t: np.ndarray, y: np.ndarray) -> None:
    """A CSV file that `learn` reads: columns run, t, q1 …, v1 …"""
    path.parent.mkdir(parents=True, exist_ok=True)
    d = y.shape[1] // 2
    names = ["run", "t", *(f"{letter}{i + 1}" for letter in "qv" for i in range(d))]
    runs = np.repeat(np.arange(len(y)), len(t))
    table = np.column_stack([runs, np.tile(t, len(y)), y.transpose(0, 2, 1).reshape(-1, 2 * d)])
    np.savetxt(path, table, fmt=["%d", *["%.9g"] * (1 + 2 * d)], delimiter=",", header=",".join(names), comments="")


# discovery ------------------------------------------------------------------------------------------------------------


def discoveries() -> dict[str, tuple[HamiltonianSystem, np.ndarray, np.ndarray, dict[str, float]]]:
    """Systems with initial states, times, and the true coefficients of H."""
    random = np.random.default_rng(0)
    angle, a, e = random.uniform(0, 2 * np.pi, 50), random.uniform(0.8, 1.5, 50), random.uniform(0, 0.5, 50)
    r, v = a * (1 - e), np.sqrt((1 + e) / (1 - e) / a)
    orbits = np.stack([r * np.cos(angle), r * np.sin(angle), -v * np.sin(angle), v * np.cos(angle)], 1)
    wells = systems.henon_heiles()
    squares = {f"{x}{i}**2": 0.5 for x in "pq" for i in range(1, 5)}
    bonds = {f"(q{i} - q{i + 1})**4": 0.25 for i in range(1, 4)}
    plane = {"p1**2": 0.5, "p2**2": 0.5}
    hh = {"q1**2": 0.5, "q2**2": 0.5, "q1**2*q2": 1.0, "q2**3": -1 / 3}
    t = np.linspace(0.0, 10.0, 101)
    return {
        "Hénon–Heiles": (wells, wells.domain.sample(50, 0), t, plane | hh),
        "pendulum": (PENDULUM, PENDULUM.domain.sample(50, 0), t, {"p1**2": 0.5, "cos(q1)": -1.0}),
        "quartic chain of 4": (CHAIN, random.uniform(-1.2, 1.2, (25, 8)), t, squares | bonds),
        "Kepler": (KEPLER, orbits, np.linspace(0, 10, 201), plane | {"1/sqrt(q1**2 + q2**2)": -1.0}),
    }


def discovered(names: list[str], folder: Path | None, sigma: float = 0.01) -> list[list[str]]:
    """For each system the formula and the largest relative error of a coefficient; of the first the path, drawn."""
    rows = []
    for name, (system, y0, t, truth) in discoveries().items():
        if names and name not in names:
            continue
        noise = sigma * np.random.default_rng(1).normal(size=(len(y0), 2 * system.ndof, len(t)))
        y = solve(system, "kahan_li8", (0.0, float(t[-1])), y0, t_eval=t, dt=0.02).y
        found, seconds = timed(lambda y=y, t=t, noise=noise: discover((t, y + noise)))  # type: ignore[misc]
        record = found.discovery
        made = {str(f): c for f, c in zip(record.terms, record.coefficients, strict=True)}
        right = made.keys() == truth.keys()
        error = max((abs(made[f] / c - 1) for f, c in truth.items() if f in made), default=np.inf)
        counts = [f"{len(truth)} of {len(record.library)}", str(len(made)), "yes" if right else "no"]
        rows.append([name, *counts, f"{100 * error:.2g} %", f"{seconds:.0f}", f"`{record.formula()}`"])
        print(*rows[-1], sep=" | ", flush=True)
        print(record.table(), flush=True)
        if folder is not None and name == "Hénon–Heiles":
            record.figure().savefig(folder / "discovery_path.png", dpi=110)
    return rows


# sweeps ---------------------------------------------------------------------------------------------------------------

SWEEPS = {
    "noise ε": [(eps, 100, 50) for eps in (0.0, 0.005, 0.01, 0.02, 0.05)],
    "trajectories N": [(0.01, n, 50) for n in (10, 20, 50, 100)],
    "times M": [(0.01, 100, m) for m in (5, 10, 20, 50)],
}


def sweeps(folder: Path | None, options: argparse.Namespace) -> list[list[str]]:
    """One-step errors on the authors' oscillator against noise, trajectories and times, of `learn` and of Adam."""
    system = systems.harmonic_oscillator()
    rows = []
    for label, cases in SWEEPS.items():
        for eps, n, m in cases:
            data, held = authors_data(system, 1.2, eps, n, m, 0)
            flow, seconds = timed(lambda data=data: sympflow.learn(data, dt=1.0))  # type: ignore[misc]
            theirs = one_step_error(authors_adam(data, max(seconds, options.swept)), system, held)
            error = one_step_error(flow, system, held)
            numbers = [fragments.number(error), f"{seconds:.0f}", fragments.number(theirs)]
            rows.append([label, f"{eps:g}", str(n), str(m), *numbers])
            print(*rows[-1], sep=" | ", flush=True)
    if folder is not None:
        sweeps_figure(rows).savefig(folder / "learning_sweeps.svg")
    return rows


def sweeps_figure(rows: list[list[str]]) -> Any:
    """The errors of the rows of `sweeps` against what is swept, one panel each."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 3.0), layout="constrained", facecolor="white")
    for ax, label in zip(figure.subplots(1, 3, sharey=True), SWEEPS, strict=True):
        swept = 1 + "εNM".index(label[-1])
        x, ours, adams = np.array([[row[swept], row[4], row[6]] for row in rows if row[0] == label], dtype=float).T
        ax.plot(x, adams, "s--", color="#0072B2", label="SympFlow by Adam")
        ax.plot(x, ours, "o-", color="#D55E00", label="learn")
        ax.set(xlabel=label, yscale="log")
        if label[-1] != "ε":
            ax.set_xscale("log")
            ax.set_xticks(x, [f"{value:g}" for value in x])
            ax.set_xticks([], minor=True)
        ax.grid(alpha=0.3, which="both")
    figure.axes[0].set_ylabel("one-step error at Δt = 1")
    figure.axes[0].legend(frameon=False)
    return figure


# all of them ----------------------------------------------------------------------------------------------------------

PROTOCOLS: dict[str, Callable[[argparse.Namespace], list[Row]]] = {
    "authors-oscillator": partial(authors_rows, systems.harmonic_oscillator(), 1.2),
    "authors-henon-heiles": partial(authors_rows, systems.henon_heiles(), 1.0),
    "ghnn-pendulum": ghnn_pendulum,
    "ghnn-double-pendulum": ghnn_double_pendulum,
    "ghnn-three-bodies": ghnn_three_bodies,
    "hnn-spring": lambda o: hnn("spring", o),
    "hnn-pendulum": lambda o: hnn("pendulum", o),
    "hnn-two-bodies": lambda o: hnn("two-bodies", o),
    "d-hnn": lambda o: hnn("damped", o),
    "measured": measured_rows,
}
FRAGMENTS = {
    "authors-oscillator": "learning-authors-oscillator",
    "authors-henon-heiles": "learning-authors-henon-heiles",
    "ghnn-pendulum": "learning-ghnn-pendulum",
    "ghnn-double-pendulum": "learning-ghnn-double-pendulum",
    "ghnn-three-bodies": "learning-ghnn-three-bodies",
    "hnn-spring": "learning-hnn-spring",
    "hnn-pendulum": "learning-hnn-pendulum",
    "hnn-two-bodies": "learning-hnn-two-bodies",
    "d-hnn": "learning-d-hnn",
    "measured": "learning-measured",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=[*PROTOCOLS, "discovery", "sweeps"], default=None)
    parser.add_argument("--systems", nargs="+", default=[], help="of the discovery; all of them by default")
    parser.add_argument("--runs", type=int, default=100, help="training trajectories of the GHNN protocols")
    parser.add_argument("--pendulums", type=int, default=30, help="training trajectories of the double pendulum")
    parser.add_argument("--baseline", type=float, default=20.0, help="least processor time of Adam, in seconds")
    parser.add_argument("--write", type=Path, help="a folder for the data of the protocol `measured`")
    parser.add_argument("--networks", type=int, default=1000, help="steps of the networks' training, 0 for none")
    parser.add_argument("--budget", type=float, default=540.0, help="seconds for each fit of the three bodies")
    parser.add_argument("--flow-budget", type=float, default=120.0, help="seconds for each fit of a flow with networks")
    parser.add_argument("--swept", type=float, default=5.0, help="the same in the sweeps")
    fragments.add_out(parser)
    options = parser.parse_args()
    wanted = options.only or [*PROTOCOLS, "discovery", "sweeps"]
    figures = None if options.out is None else options.out.parent / "figures"
    titles = ["method", "metric", "theirs", "target", "got", "reached", "s", "model"]
    for name, protocol in PROTOCOLS.items():
        if name in wanted:
            rows = [row.cells() for row in protocol(options)]
            for row in rows:
                print(name, *row, sep=" | ", flush=True)
            fragments.write(options.out, FRAGMENTS[name], fragments.table(titles, rows), f"--only {name}")
    if "discovery" in wanted:
        titles = ["system", "true terms, of a library", "found", "these and no other", "largest error", "s", "H"]
        table = fragments.table(titles, discovered(options.systems, figures))
        fragments.write(options.out, "learning-discovery", table, "--only discovery")
    if "sweeps" in wanted:
        titles = ["sweep", "ε", "N", "M", "one-step error", "s", "Adam"]
        fragments.write(
            options.out, "learning-sweeps", fragments.table(titles, sweeps(figures, options)), "--only sweeps"
        )


if __name__ == "__main__":
    main()

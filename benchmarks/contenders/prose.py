"""The words of docs/benchmarks.md."""

from __future__ import annotations

from contenders.goals import find
from contenders.measurement import Results, Row

TARGETS = (1e-3, 1e-6, 1e-9, 1e-12)

HEAD = """\
# Benchmarks: sympflow and its peers

*Written by `python benchmarks/peers.py --out docs/benchmarks.md` (extra `bench`); do not edit by hand.*

How long does it take to follow a Hénon–Heiles orbit to T = 1000, from q₀ = (0.3, −0.3), p₀ = (0.3, 0.15), with a
relative energy error of at most 1e-3, 1e-6, 1e-9 or 1e-12? Each method gets the largest step or tolerance that meets
the target, found by bracketing on the logarithms, and is then timed at it. The batch is a thousand orbits that start
within ±0.01 of that one; its error is the median over 64 of them.

- **Energy error**: the largest |H − H₀|/|H₀| at 1000 equally spaced instants, on states that the method stepped on (of
  an adaptive method the first at or after each instant): torchdiffeq's dopri8, for one, interpolates by a quartic,
  which is far less accurate than its steps and shows in its state error.
- **State error**: ‖y − y_ref‖ at T, against Kahan–Li 8 with a step halved until it converged to rounding.
- **Run time**: seconds for one trajectory, from the call to the state at T, no other output kept; the median of
  interleaved rounds. Whatever the call costs is in it, `solve`'s own overhead too; compiling is not (see *First
  calls*).
- **xV**: run time in units of that of a hand-written Numba loop of Störmer–Verlet, one trajectory, that reaches the
  same target in the same run. At 1e-12 Verlet would drown in rounding; the methods that step in Python are not asked.
- **F, G**: evaluations of the force and of the force gradient (a Hessian–vector product) for one trajectory. None of
  these schemes needs G. A Taylor series evaluates neither.
- **~**: a run that would take longer than about 0.3 s is timed over a part of the interval and scaled by the time
  covered (exact for fixed steps; adaptive ones run over a twentieth of the interval at least). torchdiffeq's dopri5
  at 1e-9 is calibrated over a tenth of it too, its energy error growing linearly.

The hand-written loops are as fast as we could make them: neighbouring kicks merged, multiply-adds contracted, the batch
in blocks of 64 side by side, which the compiler turns into vector instructions. The NumPy and torch loops are what one
writes first. SciPy gets two right-hand sides: the one generated from the symbolic Hamiltonian, which takes whole
batches, and one in plain scalars; the other packages get theirs hand-written. diffrax has no Verlet, but its
semi-implicit Euler between two half kicks is one. heyoka's batch is twice the width that it recommends, which was the
fastest. The time of the hand-written batch loop differs by up to a third from process to process, probably with where
its buffers land in memory, and so do the ratios to it. Every loop is checked to take the same steps as our `verlet`.
"""

NOTES = """\
## First calls

What the first call takes beyond the second, in one process: compiling (diffrax, the Numba loops, heyoka), or loading
code that an earlier process compiled and left on disk (sympflow). It is paid once a process, by heyoka once for every
tolerance.
"""

NOT_SHOWN = """\
**What one scene cannot show.** Hénon–Heiles is polynomial, of two degrees of freedom and not stiff: Taylor series are
at their best, and a force costs a few nanoseconds, so loops and calls weigh as much as arithmetic. With an expensive
force the evaluations decide, whichever package steps. Orbits that need ever-changing steps (close encounters) favour
adaptive methods; here every orbit is smooth. All runs are on one thread. A GPU, where diffrax and torch would have
their day with far larger batches, and gradients through the solve, which diffrax, torchdiffeq and torch give, are not
part of this comparison."""


def discussion(results: Results) -> str:
    """Who wins where, with the numbers of this run."""
    batch = max(row.trajectories for row in results.rows)
    paragraphs = [
        "## Reading the tables",
        order_matters(results),
        standings(results, batch),
        call_costs(results),
        state_errors(results),
        same_scheme(results, batch),
        NOT_SHOWN,
    ]
    return "\n\n".join(p for p in paragraphs if p)


def order_matters(results: Results) -> str:
    parts = []
    for target in TARGETS:
        verlet, best = pick(results, "sympflow", "verlet", 1, target), fastest(results, 1, target, ["sympflow"])
        if verlet and best:
            parts.append(f"{verlet.seconds / best.seconds:.3g} times at {power(target)} ({best.label})")
    return (
        "**Order matters more than the speed of a step.** For one trajectory our fastest scheme is faster than our own "
        f"Verlet {', '.join(parts)}. A low-order loop in a fast language stays a low-order loop."
    )


def standings(results: Results, batch: int) -> str:
    """Our fastest scheme against the fastest of the other packages, and where they win."""
    lines, wins = [], []
    packages = sorted({row.package for row in results.rows} - {"sympflow", "Numba"})
    for n in (1, batch):
        scope = "one trajectory" if n == 1 else f"batch of {n}"
        for target in TARGETS:
            mine, peer = fastest(results, n, target, ["sympflow"]), fastest(results, n, target, packages)
            if not (mine and peer):
                continue
            ratio = peer.seconds / mine.seconds
            lines.append(
                f"- {scope}, {power(target)}: {mine.label}; {peer.package} ({peer.label}) takes {ratio:.2f} times"
            )
            if ratio < 1:
                wins.append(f"{peer.package} at {power(target)}, {scope}")
    verdict = f"Peers win here: {'; '.join(wins)}." if wins else "No peer is ahead in this run."
    head = (
        f"**Where peers win.** {verdict} Our fastest scheme, and the time of the fastest other package relative to it:"
    )
    return "\n".join([head, "", *lines])


def call_costs(results: Results) -> str:
    verlet, loop = pick(results, "sympflow", "verlet", 1, 1e-3), pick(results, "Numba", "Verlet loop", 1, 1e-3)
    if not (verlet and loop):
        return ""
    return (
        f"**Short runs are mostly call.** At 1e-3 a Verlet run through `solve` takes {1e6 * verlet.seconds:.0f} µs, "
        f"the hand-written loop {1e6 * loop.seconds:.0f} µs: the difference is checks, the time grid and the Solution. "
        "One trajectory by a scheme that needs a thousand steps is dominated by it, so there the xV of our methods is "
        "above that of their kernels; a batch spreads it. Who needs many short runs should batch them."
    )


def state_errors(results: Results) -> str:
    mine, taylor = fastest(results, 1, 1e-9, ["sympflow"]), fastest(results, 1, 1e-9, ["heyoka"])
    if not (mine and taylor and mine.state_error and taylor.state_error):
        return ""
    return (
        "**Equal energy error is not equal accuracy.** A symplectic method keeps the energy better than the phase: at "
        f"the energy target 1e-9, {mine.label} ends {mine.state_error:.1e} away from the true state, heyoka "
        f"{taylor.state_error:.1e}, partly because its accuracy comes in whole orders and overshoots the target. "
        "Judged by the state at T = 1000, the adaptive methods stand better than the run times show. Over longer times "
        "their energy error goes on growing, while that of a symplectic method stays where it is."
    )


def same_scheme(results: Results, batch: int) -> str:
    ratios, wins = [], []
    for n in (1, batch):
        for target in TARGETS:
            verlet = pick(results, "sympflow", "verlet", n, target)
            leapfrog = find(
                results,
                lambda r, n=n, t=target: (r.package, r.control, r.trajectories, r.target) == ("diffrax", "dt", n, t),
            )
            if verlet and leapfrog:
                scope = f"{'one trajectory' if n == 1 else f'batch of {n}'}, {power(target)}"
                ratios.append(f"{leapfrog.seconds / verlet.seconds:.2f} ({scope})")
                if leapfrog.seconds < verlet.seconds:
                    wins.append(scope)
    if not ratios:
        return ""
    ahead = (
        f" diffrax is ahead for {'; '.join(wins)}, where both are mostly call and its call is cheaper." if wins else ""
    )
    return (
        "**The same scheme elsewhere.** diffrax's leapfrog takes, in units of our `verlet` at the same step, "
        f"{', '.join(ratios)}.{ahead} In long runs it pays for a general driver around each step."
    )


def pick(results: Results, package: str, label: str, n: int, target: float) -> Row | None:
    key = (package, label, n, target)
    return find(results, lambda r: (r.package, r.label, r.trajectories, r.target) == key)


def fastest(results: Results, n: int, target: float, packages: list[str]) -> Row | None:
    rows = [r for r in results.rows if r.trajectories == n and r.target == target and r.package in packages]
    return min(rows, key=lambda r: r.seconds, default=None)


def power(target: float) -> str:
    return f"{target:.0e}".replace("e-0", "e-")

"""The words of docs/stability.md, around the tables that benchmarks/stability.py measures."""
# ruff: noqa: E501 (lines of the page)

from __future__ import annotations

from collections.abc import Mapping

HEAD = """# Stability

How long a step each method bears, what happens beyond, and why: stiff oscillations beside slow motion, close encounters, escape, separatrices, many steps.
Every table and figure here is written by `python benchmarks/stability.py --out docs/stability.md`; energy errors are the largest over the run, relative, and of the
worst of the initial states where there are several. ∞ means that the run became non-finite or could not go on.

## Finding the limit

`stability` runs every method with a range of steps, finds the longest stable one by bisection, and says how the longer ones end:

```python
import sympflow
from sympflow import systems

report = sympflow.stability(systems.harmonic_oscillator(1000.0), ["verlet", "implicit_midpoint"], steps=[1e-3, 3e-3])
print(report.table())  # also .rows, .limits, .to_csv(path), .plot(path)
```

A run counts as unstable if it becomes non-finite, cannot go on, or its energy error exceeds `bound` (1e3). It starts from four states along one orbit, for a single one can
hide an instability: at exactly dt·ω = 2 Verlet's energy error from q = 1, p = 0 is 0, while every other state grows without bound. A run that ends is looked at by `solve` itself: where an accurate
reference becomes infinite too, the solution is singular, at that time; else the method was unstable. Two more states are told apart from "stable": a run of a flow that left its domain is "outside", whatever its
energy error, for the flow says nothing there; and one whose energy error exceeds 1 without growing beyond the bound is "bounded": its step counts for the longest stable one, its result for nothing. A family of systems gives a map of step against stiffness:
`sympflow stability fput --vary omega=10,100,1000 --out out/`.
"""

LINEAR = """## The linear limit

On the harmonic oscillator everything depends on z = dt·ω alone. From q = 1, p = 0 and over 100,000 steps the energy error of Verlet (kick–drift–kick) is bounded by z²/4,
that of leapfrog (drift–kick–drift) by (z²/4)/(1 − z²/4). The bounds are never exceeded, at any ω, and approached within 1 %, except where the orbit of the discrete map has a short period and meets
few points of its ellipse: a step turns it by θ with cos θ = 1 − z²/2, so at z = 1 the period is 6 and the error 0.75 of the bound. The limit is 2:

{linear_limit}

**Explicit splittings** are the exact flow of a nearby quadratic Hamiltonian as long as z < 2 a force (less for most schemes of high order, whose limit is per step, not per force);
its ellipses are the longer the nearer z is to 2, so a bounded error is no small one. Beyond, the nearby Hamiltonian is a hyperbola's, and the state grows by a constant factor a step: 1.22 at
z = 2.01. **Implicit midpoint and Gauss–Legendre 4** conserve quadratic Hamiltonians exactly, whatever z is: no step is unstable, but at z ≫ 1 the phase is wrong, and stability says nothing of accuracy.
**Exact linear flows** (`impulse` and its kin) have no error at all here.

![Step against ω, harmonic oscillator](figures/stability_harmonic_oscillator.png)
"""

FPUT = """## Stiff springs: Fermi–Pasta–Ulam–Tsingou

Three stiff springs of frequency ω between soft quartic ones, T = 200 [HLW, I.5 and XIII]. The stiff springs' energies I₁, I₂, I₃ are exchanged slowly, I₂ reaching 0.519 at ω = 50, while their sum I
stays near 1: a method must get H, I *and* the exchange right.

{fput}

![Step against ω, FPUT](figures/stability_fput.png)

- **Verlet** must resolve the fast oscillation though it carries nothing: its limit is hω = 2, and near it I is wrong by tens of percent.
- **Implicit midpoint** takes any step and conserves H and I fairly, yet at hω = 5 the exchange is wrong (see I₂): it is the method with its fast frequency slowed to (2/h) arctan(hω/2), and the exchange
  happens on a time scale proportional to ω. Energy error does not show it.
- **The impulse method** is exact for the stiff part, and fails where hω is near a multiple of π: the kicks hit the oscillation always in the same phase. **The mollified impulse** filters the kicks
  (φ = sinc), which repairs the resonances and, at hω = 5, wrecks the exchange. **The implicit–explicit split** has a good exchange and an error of 1 % in H.
- **Nyström splittings with the exact linear flow** are accurate as long as the soft force is resolved within a stage, and pay 14 forces a step. Their order conditions presume small hω, so at
  ω = 1000, hω = 20 they are no better than the implicit–explicit split.
- **Runge–Kutta methods** resolve every oscillation: explicit ones by stability, Radau for its accuracy, for oscillations are no transients that an L-stable method may damp.
"""

SPRING = """## A stiff direction that turns: the spring pendulum

k = 1e6, T = 20. The stiff direction is radial and turns with the pendulum, so no constant linear part describes it; `system.linear_part` says so with a ValueError. In polar coordinates
the radial oscillator is a part by itself, and three parts are solved exactly in turn (`strang_parts`). Errors are relative to g·length.

{spring}

![Step against k, spring pendulum](figures/stability_spring_pendulum.png)

On the slow manifold the fast mode is asleep, and the three-term splitting and implicit midpoint step over it. Excited, it is another matter: its energy is exchanged with the rotation through the parts that the splitting takes
apart, a hundred times a fast period too seldom, and the error is of the first order in that energy; `suzuki4_parts` has more substeps, one of them backwards, and at h√k = 10 no order to profit from. Implicit midpoint is good in polar
coordinates, in which the stiff force is linear, and loses four digits in Cartesian ones, in which its direction turns within a step. Verlet is bound to h√k < 2 whether the mode is excited or not.
"""

KEPLER = """## Close encounters: Kepler

100 periods of 1000 steps each, from the pericentre.

{kepler}

At the pericentre the orbit turns within a time (1 − e)^{{3/2}} of the period's 1/2π: with e = 0.99 a thousandth, with e = 0.999 a thirty-thousandth, so that a fixed step of a thousandth of the period jumps over the encounter,
and the body is thrown out, whatever the order of the method. rk45 at SciPy's default tolerances loses energy with each passage, spirals into the centre, and its step underflows there: status −1.

**Time transformation.** The methods `log_…` split the logarithmic Hamiltonian Λ = log(T(p) + B) − log(c − V(q)), B = c − H(y0), whose flow is that of H in a time s with dt/ds = 1/(c − V) [Mikkola and Tanikawa
1999; Preto and Tremaine 1999]: equal steps in s are short where the force is strong. The leapfrog then follows a Kepler ellipse exactly, with an error in time alone (see the state error: it is late or early on the right
ellipse); higher orders trade a little energy for the time. Outputs are at the physical times asked for, each by a shorter step whose length is found by root-finding to rounding; events, dense output and batches work as ever:

```python
import numpy as np
from sympflow import solve, systems

kepler = systems.kepler(0.99)
sol = solve(kepler, "log_kahan_li8", t_eval=2 * np.pi * np.arange(101))  # physical times
assert np.abs(sol.y - kepler.y0[:, None]).max() < 1e-5  # back at the start after every period
```

c, the option `shift`, must exceed V along the orbit, which any number above the energy does; 0 serves a bound system whose V vanishes far out, and the default is E + |E|. `dt` is the length of a step where T = B, the mean along a Kepler orbit. A collision is an end: where time hardly advances any more the status is −1.

**A SympFlow in the transformed time.** `time_transformed(system)` is a separable HamiltonianSystem like any other, with states [q, t, p, B]: flows are primed and trained on it, and `LogSympFlow` runs them in physical time.

```python
from sympflow import SympFlow, time_transformed
from sympflow.integrators.log_sympflow import LogSympFlow

flow = SympFlow.primed(time_transformed(kepler), scheme="blanes_moan4", dt=0.02)  # untrained: the scheme itself
sol = solve(kepler, LogSympFlow(flow=flow), (0.0, 20.0))
```

Trained for a minute in a tube around one orbit (bfgs on the residual; the faster Gauss–Newton fit needs a kinetic energy quadratic in p, which Λ has not), 50 steps a period, outputs just after each pericentre:

{log_flow}

Training gains three digits at no cost in forces, but Kepler in the transformed time is so smooth that a scheme of order 8 gains more.
"""

THREE_BODY = """## Close encounters: the Pythagorean three-body problem

Three bodies from rest, T = 70, with an approach to 4.1e-4 at t = 15.83. The state at t = 70 is compared with a computation in 128-bit arithmetic, good to 5e-7.

{three_body}

Energy alone misleads: rk45 at 1e-9 has an energy error of 2e-6 and an entirely wrong state, and the log leapfrog ends with a good energy on a wrong orbit: an error in time at one encounter is an error in
the geometry of the next. Energy errors peak in the encounters and come back after them. With compensated sums the fourth-order splitting agrees with the reference to the digits that it has. Fixed steps in t are hopeless at any order.
"""

ESCAPE = """## Escape and blow-up: Hénon–Heiles above 1/6

From q = 0, p = (0, 0.7) the solution is infinite at t* = 5.450984210235402. Every method ends with status −1 and keeps what it had; an explicit step leaps over the singularity and overflows a few steps later,
an implicit one fails in Newton's iteration before it. The last finite state is therefore not the singularity. So after a failure, and only then, `solve` follows the solution again by Dormand and Prince's method of
order 8 at a tolerance of 1e-10: from y0, or where that takes more than 500 steps from a state of the run 200 to 400 steps before its end, if it still has the energy of y0. If the steps become too short to move t while the
state grows without bound, the solution is singular there: the message says so, and `stats["blow_up_time"]` is the time, an estimate. If it goes on instead, the step was too long, and the message says that:

{escape}

Just below 1/6 orbits stay; above, they leave. **A SympFlow knows nothing of the escape**: its kicks were fitted in the well, and outside they do what they do. It may stay finite and wrong by any factor with
status 0: the note that it left Ω is the only sign, which is why `solve` looks, and `on_domain_exit="stop"` makes it an end.
"""

SCENES = """## The well: Hénon–Heiles

{henon_heiles}

All splittings are bounded as long as the fastest curvature that the orbit meets is resolved; past it the orbit is kicked over the saddle and escapes, so that here instability *is* blow-up. The explicit
Runge–Kutta methods drift at every step: rk4's error is small and grows.

## Separatrices: double well and pendulum

Double well, from its separatrix:

{double_well}

Pendulum, from its separatrix:

{pendulum_separatrix}

On a separatrix every error grows like exp(t), the rounding of y0 included, so after about ln(1/error) the numerical orbit turns back or goes over at random, with a small energy error all the while: the state is
unpredictable and the energy is not. The nearby Hamiltonian of a symplectic method has a separatrix of its own, with a chaotic layer as thin as exp(−const/dt) around it [HLW, IX]; a flow trained below the separatrix has none there, and
may be anywhere.

## Toda lattice

{toda}

The exponential springs stiffen as particles meet, so the limit depends on the energy: a step that is stable at rest is not at the turning point.

## Where H does not split

{nonseparable}

Splittings do not apply. The Gauss methods do, and conserve quadratic invariants; A-stable though they are, a long step of a nonlinear system may have no solution near y, or Newton's iteration may not find it:
then the status is −1 with the time. rk4 and rk45 run, and drift.

## Lennard-Jones atoms

{lennard_jones}

The wall r⁻¹² is as stiff as the collision is hard: the longest step depends on the temperature, and beyond it one close pair gains enough energy in a single kick to blow up the crystal.
"""

PRECISION = """## Precision

{precision}

float32 runs by array operations, and its rounding, 6e-8, is the energy error of every accurate method. The volume error and the symplecticity defect are rounding too, in either precision: of the first 256 steps, by differentiating the steps that ran.

## Round-off

Over 1e6 to 1e8 steps the truncation error of an accurate method is below its rounding. From eight states of Hénon–Heiles:

{round_off}

![Growth of the rounding error](figures/stability_round_off.png)

Independent rounding errors make the energy a random walk, rms|ΔH| ~ √n [Brouwer 1937]; a systematic error would grow like n. No drift is seen: the slope, its error taken from the scatter between the trajectories, is 0 within three of its standard errors.
Compensated summation (`compensated=True`: splittings, Gauss methods, `log_…` and primed SympFlows, compiled) keeps the part of each update that is lost, and gains a factor of 20 to 50. Newton's iteration runs to
rounding, not to a tolerance, and the Gauss coefficients satisfy the symplecticity condition exactly, else the Gauss methods would drift [Hairer, McLachlan, Razakarivony 2008]. Where the truncation error is above the rounding the exponent is 0, or, with the long steps of trained flows (last rows), that of a slow diffusion on chaotic orbits: at such steps no nearby Hamiltonian is conserved to better than that. To measure your own:

```python
system = systems.henon_heiles()
sol = solve(system, "kahan_li8", (0, 5000), system.domain.sample(8, seed=3), dt=0.05, save_every=10)
growth = sympflow.energy_growth(sol)
print(growth.exponent, growth.drift, growth.drift_error)
```

## Where a SympFlow fails

- **Beyond Δt.** ψ̄ was trained on [0, Δt] and means nothing beyond: a longer `dt` is a ValueError. A shorter one composes ψ̄_dt, which is another map, at most as good as its training at that t.
- **Outside Ω.** It was fitted to H there. It stays symplectic, so volume is kept and nothing need diverge to warn you; `solve` warns (`on_domain_exit`).
- **At long Δt.** It is the exact flow of a nearby Hamiltonian only where that exists: with a Δt near a multiple of half a period of the system, small errors meet a resonance, as for any splitting.
- **At low precision.** A flow in float32 has its trained error or 1e-6, whichever is larger.
- **On another system.** Weights are bound to H by a fingerprint: another ω is a ValueError.
"""

GUARDS = """## What `solve` does when it goes wrong

| what | result |
| --- | --- |
| the state becomes infinite or NaN | status −1; the message and `stats["failed_at"]` say after which t; everything before is kept |
| Newton's iteration finds no solution of an implicit step | the same |
| T + B or c − V ceases to be positive, or time hardly advances, in the methods `log_…` | the same |
| one trajectory of a batch fails | its own status is −1, with NaN after its last finite output; the others go on; `failed_at` is an array |
| the solution itself becomes infinite | the message says about when, and `stats["blow_up_time"]`, in a batch an array; no step leads beyond that |
| a singularity is approached by an adaptive method | status −1 when its step underflows |
| an adaptive method of torchdiffeq takes more than `max_num_steps` steps, 10,000 by default | status −1 with what it has, and that option as the remedy |
| a step so short that more than 1e11 of them are needed | a ValueError before anything runs |
| an adaptive method would need years | status −1 after ten thousand steps, with the pace in the message |
| the state leaves the domain of a flow | a note in the message and `stats["domain_exit"]`; status −1 with `on_domain_exit="stop"` |
| `dt` is longer than the flow's Δt | a ValueError that names Δt |
| the arguments make no sense | a ValueError or TypeError at once |

## References

- [HLW] E. Hairer, C. Lubich, G. Wanner, *Geometric Numerical Integration*, 2nd ed., Springer 2006.
- D. Brouwer, "On the accumulation of errors in numerical integration", Astron. J. 46 (1937) 149–153.
- E. Hairer, R. I. McLachlan, A. Razakarivony, "Achieving Brouwer's law with implicit Runge–Kutta methods", BIT 48 (2008) 231–243.
- S. Mikkola, K. Tanikawa, "Explicit symplectic algorithms for time-transformed Hamiltonians", Celest. Mech. Dyn. Astron. 74 (1999) 287–295.
- M. Preto, S. Tremaine, "A class of symplectic integrators with adaptive time step for separable Hamiltonian systems", Astron. J. 118 (1999) 2532–2541.
"""


def page(parts: Mapping[str, str]) -> str:
    """The page, with the tables by the names of their sections."""
    sections = (HEAD, LINEAR, FPUT, SPRING, KEPLER, THREE_BODY, ESCAPE, SCENES, PRECISION, GUARDS)
    braces = "\n".join(s if s in (HEAD, GUARDS) else s.format(**parts) for s in sections)
    return braces.rstrip() + "\n"

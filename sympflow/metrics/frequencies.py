"""frequencies(): the lines of quasi-periodic orbits, by numerical analysis of fundamental frequencies."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arguments import check_counts, warn
from sympflow.hamiltonian.scales import natural_scale
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.grid import Grid
from sympflow.metrics.orbits import OfOrbits, Orbits, checked_orbits
from sympflow.show.pictures import curves_figure
from sympflow.solver import solve
from sympflow.systems.given import GivenSystem, given_system

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_SAMPLES = 1 << 16  # samples of an orbit, unless more are asked for: at every step, or at every few of a longer run
FEWEST_SAMPLES = 16
OF_OTHER_METHODS = 4096  # samples, where steps are of no fixed length
MOST_VALUES = 1 << 21  # numbers that are held at a time
MOST_NEWTON = 30
FAINTEST = 1e-13
STRAIGHT = 0.98  # correlation of a coordinate with the time from which on it is a ramp
"""Lines fainter than this, relative to the first one, are rounding: they are NaN."""

Signal = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, repr=False)
class Frequencies(OfOrbits):
    """The lines Σ_k a_k exp(iω_k (t − t0)) of signals along orbits.

    Attributes
    ----------
    frequencies : ndarray of shape (..., c, n)
        ω_k, in radians per unit of time, of c signals, the strongest line first; NaN of orbits that failed, and of
        lines that are not above rounding.
    amplitudes : complex ndarray of shape (..., c, n)
        a_k.
    status : int, or ndarray of shape (...)
        0, or −1 of orbits that failed.
    message : str
    """

    caption: ClassVar[str] = "Frequencies"
    facts: ClassVar[tuple[str, ...]] = ("frequencies", "amplitudes", "status")
    frequencies: np.ndarray
    amplitudes: np.ndarray = field(repr=False)
    status: Any
    message: str

    def drawn(self) -> Figure:
        n = self.frequencies.shape[-1]
        lines, sizes = self.frequencies.reshape(-1, n), np.abs(self.amplitudes).reshape(-1, n)
        if not np.isfinite(lines).any():
            raise ValueError("`plot` has nothing to draw, because no line was found: `message` says why.")
        return curves_figure(lines, sizes, ("angular frequency", "amplitude"), self.caption, bars=True)


def frequencies(
    system: GivenSystem,
    method: Any = None,
    t_span: tuple[float, float] | None = None,
    y0: ArrayLike | None = None,
    *,
    n: int = 1,
    signal: Signal | None = None,
    samples: int | None = None,
    backend: str = "auto",
    **options: Any,
) -> Frequencies:
    """The n strongest lines of each orbit, by Laskar's numerical analysis of fundamental frequencies [1]_ [2]_.

    A line starts at the maximum of the Fourier transform of the signal, times a Hann window; there the frequency is
    refined until |⟨z, exp(iωt)⟩| is largest. The lines are made orthogonal one after another as by Gram and Schmidt,
    and each is refined again after the others are subtracted. Over a time T the error falls like T⁻⁴, where that of the
    Fourier transform falls like T⁻¹. The difference of the frequencies of two halves of an orbit measures its
    diffusion: on a torus it is 0 [2]_.

    Parameters
    ----------
    system : HamiltonianSystem
    method : str, Integrator or trained flow, optional
        By default one that suits the system, as for `solve`.
    t_span : (float, float), optional
        The default is the system's. Choose ten periods or more.
    y0 : array_like of shape (..., 2d), optional
        One state, or a batch of them. The default is the system's.
    n : int
        Lines of each signal.
    signal : callable, optional
        A function of states (..., 2d, m) at m times that returns complex or real signals (..., m), or (..., c, m). The
        default is z_i = s_i q_i − i p_i/s_i of each degree of freedom, for which the rotation of an oscillator is
        positive; s makes q and p comparable: √(mω) of an oscillator of frequency ω and mass m, 1 in natural units.
    samples : int, optional
        Number of samples; by default one after each step, or after every few, so that there are at most 65536.
        Frequencies above π·samples/|t1 − t0| are aliased.
    backend : "auto", "compiled" or "array"
        As for `solve`.
    **options
        Options of the method, such as `dt`.

    Returns
    -------
    Frequencies

    Raises
    ------
    ValueError, TypeError
        For bad arguments, at once.

    Notes
    -----
    At most 16 MB of samples are held at a time, or those of one orbit.

    References
    ----------
    .. [1] J. Laskar, Icarus 88 (1990) 266–291.
    .. [2] J. Laskar, Physica D 67 (1993) 257–281.

    Examples
    --------
    >>> import sympflow
    >>> system = sympflow.systems.pendulum()
    >>> float(frequencies(system, "kahan_li8", (0, 200), [0.01, 0.0], dt=0.1).frequencies[0, 0].round(6))
    0.999994
    """
    system = given_system(system)
    orbits = checked_orbits(system, method, t_span, y0, options, "frequencies are found on")
    check_counts(n=n)
    times = _sample_times(orbits, samples)
    taken = rotations(system) if signal is None else signal
    if not callable(taken):
        raise TypeError(f"`signal` must be a function of states (..., 2d, m); got {type(signal).__name__}.")
    rows, parts, status, message = orbits.rows, [], [], ""
    most = max(1, MOST_VALUES // (len(times) * (2 * system.ndof + 4 * n)))
    for start in range(0, len(rows), most):
        span = (orbits.t_span[0], float(times[-1]))
        some = rows[start : start + most]
        run: dict[str, Any] = {"t_eval": times, "backend": backend, "on_domain_exit": "ignore"}
        sol = solve(orbits.system, orbits.integrator, span, some, **run)
        if signal is None and (growing := _growing(sol.y[:, : system.ndof], times)):
            warn(
                f"`signal`: {growing} grows with time, as an angle that turns over, and its strongest lines are "
                "those of a ramp. Pass the sine and cosine of the angle, signal=lambda y: np.exp(1j * y[..., :1, :]).",
                RuntimeWarning,
            )
        z = signals(taken, sol.y, len(times))
        parts.append(lines(z, times, n))
        status.append(np.broadcast_to(np.asarray(sol.status), len(z)))
        if not message or (np.asarray(sol.status) < 0).any():
            message = sol.message
    omega, amplitude = (np.concatenate(found) for found in zip(*parts, strict=True))
    shape = (*orbits.batch, *omega.shape[1:])
    ended = np.concatenate(status).reshape(orbits.batch)[()]
    return Frequencies(omega.reshape(shape), amplitude.reshape(shape), ended, message)


def _sample_times(orbits: Orbits, samples: int | None) -> np.ndarray:
    """Equidistant times, those of steps if the number of samples is not given."""
    t0, t1 = orbits.t_span
    if samples is not None:
        check_counts(samples=samples)
    elif not orbits.integrator.on_grid:
        samples = OF_OTHER_METHODS
    if samples is None:
        length = orbits.integrator.step_length(orbits.system)
        assert length is not None
        grid = Grid(t0, t1, length)
        stride = max(1, math.ceil(grid.n_steps / MOST_SAMPLES))
        times = np.array([grid.time(k) for k in range(0, grid.n_steps + 1, stride)])
    else:
        times = np.linspace(t0, t1, samples)
    if len(times) < FEWEST_SAMPLES:
        raise ValueError(
            f"`t_span` gives {len(times)} samples, and lines need {FEWEST_SAMPLES} or more: end it later, or give "
            "`samples`."
        )
    return times


def rotations(system: HamiltonianSystem) -> Signal:
    """The signals s q − ip/s of states, (..., 2d, m) to (..., d, m), with the factors s of `natural_scale`."""
    d, s = system.ndof, natural_scale(system)[:, None]
    return lambda y: s * y[..., :d, :] - 1j * (y[..., d:, :] / s)


def _growing(q: np.ndarray, times: np.ndarray) -> str:
    """The first coordinate (N, d, m) that is nearly a straight line in time, or nothing."""
    t = times - times.mean()
    with np.errstate(all="ignore"):
        part = q - q.mean(-1, keepdims=True)
        correlation = (part @ t) / np.sqrt((part**2).sum(-1) * (t @ t))
    found = np.flatnonzero((np.abs(correlation) > STRAIGHT).any(0))
    return f"q{found[0] + 1}" if len(found) else ""


def signals(signal: Signal, y: np.ndarray, m: int) -> np.ndarray:
    """The signals (N, c, m) of states (N, 2d, m); a ValueError or TypeError if the function returns something else."""
    z = np.asarray(signal(y))
    if z.dtype.kind not in "biufc":
        raise TypeError(f"`signal` must return real or complex numbers; got dtype {z.dtype}.")
    if z.shape == (len(y), m):
        z = z[:, None]
    if z.ndim != 3 or z.shape[0] != len(y) or z.shape[2] != m:
        raise ValueError(f"`signal` must return shape (..., {m}) or (..., c, {m}) of states {y.shape}; got {z.shape}.")
    return z.astype(complex)


def lines(z: np.ndarray, times: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """The frequencies and amplitudes (N, c, n) of the n strongest lines of signals (N, c, m) at equidistant times."""
    found = [_lines_of(row, n) for row in z.reshape(-1, z.shape[-1])]  # by itself: the same in any batch
    m, spacing = z.shape[-1], (times[-1] - times[0]) / (len(times) - 1)
    angle, amplitude = (np.array(part).reshape(*z.shape[:-1], n) for part in zip(*found, strict=True))
    amplitude = amplitude * np.exp(-0.5j * (m - 1) * angle)  # at the first time, not in the middle
    return angle / spacing, amplitude


def _lines_of(z: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Angles per sample and amplitudes, in the middle, of the lines of one signal (m,)."""
    m = len(z)
    angles = np.full(n, np.nan)
    amplitudes = np.full(n, np.nan + 0j)
    if not np.isfinite(z).all():
        return angles, amplitudes
    s = np.arange(m) - (m - 1) / 2
    window = 1 + np.cos(2 * np.pi * s / (m - 1))
    window /= window.sum()
    basis = np.empty((0, m), dtype=complex)
    rest = z
    strength = float(np.abs(z).max())
    for k in range(n):
        angle = _refined(rest, window, s, _start(rest, window))
        basis = np.concatenate([basis, np.exp(1j * angle * s)[None]])
        angles[k] = angle
        a = _projected(basis, window, z)
        rest = z - a @ basis
        if abs(a[k]) < FAINTEST * strength:
            angles[k] = np.nan
            basis = basis[:k]
            break
    known = len(basis)
    if known > 1:
        a = _projected(basis, window, z)
        for k in 2 * [*range(known)]:  # each with the others taken off
            angles[k] = _refined(z - np.delete(a, k) @ np.delete(basis, k, axis=0), window, s, angles[k])
            basis[k] = np.exp(1j * angles[k] * s)
            a = _projected(basis, window, z)
    if known:
        amplitudes[:known] = _projected(basis, window, z)
    return angles, amplitudes


def _start(z: np.ndarray, window: np.ndarray) -> float:
    """The angle at which the Fourier transform, of twice the length, is largest."""
    size = 2 * len(z)
    k = int(np.argmax(np.abs(np.fft.fft(window * z, size))))
    return 2 * np.pi * (k if k < size // 2 else k - size) / size


def _refined(z: np.ndarray, window: np.ndarray, s: np.ndarray, angle: float) -> float:
    """The angle near a given one at which |⟨z, exp(i angle s)⟩| is largest, by Newton's iteration on its square."""
    bin_width = np.pi / len(z)
    weighted = window * z
    for _ in range(MOST_NEWTON):
        terms = weighted * np.exp(-1j * angle * s)
        value, slope, bend = terms.sum(), -1j * (s * terms).sum(), -(s * s * terms).sum()
        first = 2 * (value.conjugate() * slope).real
        second = 2 * (abs(slope) ** 2 + (value.conjugate() * bend).real)
        if second == 0:
            break
        step = -first / second if second < 0 else math.copysign(bin_width / 2, first)
        step = max(-bin_width, min(bin_width, step))
        angle += step
        if abs(step) <= 4e-16 * max(abs(angle), bin_width):
            break
    return float(angle)


def _projected(basis: np.ndarray, window: np.ndarray, z: np.ndarray) -> np.ndarray:
    """The coefficients (k,) of the projection of z on the lines, orthogonal with the window as weight."""
    weighted = window * basis.conj()
    return np.asarray(np.linalg.lstsq(weighted @ basis.T, weighted @ z, rcond=None)[0])

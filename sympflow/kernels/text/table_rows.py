"""Errors of a splitting step at labels, and their derivatives by the numbers of its table. Source text.

Pasted after the kicks and drifts that `sympflow.kernels.table_loops` writes, and `aligned`. Labels go through the step
`LANES` at a time, component first, so that the loops over them become vector instructions. On the way a tape keeps the
forces and their slope of each kick, and the velocities of each drift; on the way back each error has a cotangent, whose
product with the tape is its derivative by the numbers of the stage. So the derivatives cost one way back for each of
the few errors of a label, however many numbers there are.
"""
# ruff: noqa: F821
# mypy: ignore-errors

from numba import njit

LANES = 64
VECTOR = 8  # lanes are padded to a multiple of this with copies of the last one


@njit(**OPTIONS)
def load_lanes(X, start, count, width, W):
    """States (2D, n) from column `start` on."""
    for i in range(2 * WIDTH):
        for lane in range(width):
            W[i * LANES + lane] = X[i, start + min(lane, count - 1)]


@njit(**OPTIONS)
def seed_lanes(A, weights, place, start, count, width):
    """Let a cotangent begin with the weights of a component."""
    for lane in range(width):
        A[place * LANES + lane] = weights[start + min(lane, count - 1)]


@njit(**OPTIONS)
def add_lanes(target, source, factor, count):
    for lane in range(count):
        target[lane] += factor * source[lane]


@njit(**OPTIONS)
def table_rows(kicks, c, motions, values, X, Y, scale, slope, places, design, first, last, r, J):
    """The errors r of the labels of blocks first … last, and where J is not empty its columns.

    Parameters
    ----------
    kicks : (S,) of bool
        The sequence: True for a kick, False for a drift.
    c : (J, n)
        The numbers at each time, in the order of the stages.
    motions : (J, drifts, 2 d²)
        With friction, the linear maps from p to what a drift adds to q, and to p.
    values : (k,)
        Of the parameters of H.
    X : (2D, N)
        States at the start; of a driven system with t and a work of 0.
    Y, scale : (R, J N)
        Labels of the first R components, and the weights of their errors.
    slope : (R', J N)
        Weights of one more error, a sum over the components; none with R' = 0.
    places, design : (m, 2), (J, m)
        Of the entries of dc/dθ that are not 0: the parameter and the number, and its values.
    """
    n_states, n_numbers, n_stages = X.shape[1], c.shape[1], len(kicks)
    rows, linear = len(scale), len(J) > 0
    errors = rows + 1 if len(slope) > 0 else rows
    per_time = (n_states + LANES - 1) // LANES
    tape = TAPE * LANES
    W, T = aligned_zeros(2 * WIDTH * LANES), aligned_zeros((n_stages if linear else 1) * tape)
    A, B = aligned_zeros(2 * WIDTH * LANES), aligned_zeros(n_numbers * LANES)
    for block in range(first, last):
        j, start = block // per_time, block % per_time * LANES
        count = min(LANES, n_states - start)
        width = (count + VECTOR - 1) // VECTOR * VECTOR
        load_lanes(X, start, count, width, W)
        number = drift = at = 0
        for s in range(n_stages):
            if kicks[s]:
                if linear:
                    kick_taped(W, T[at : at + tape], c[j, number : number + TERMS], values, width)
                else:
                    kick_lanes(W, c[j, number : number + TERMS], values, width)
                number += TERMS
            else:
                drift_lanes(W, T[at : at + tape], c[j, number], motions[j, drift], values, width)
                number, drift = number + 1, drift + 1
            at += tape if linear else 0
        label = j * n_states + start
        for row in range(errors):
            out = r[(j * errors + row) * n_states + start :]
            if row < rows:
                place = OUTPUTS[row] * LANES
                for lane in range(count):
                    out[lane] = (W[place + lane] - Y[row, label + lane]) * scale[row, label + lane]
            else:
                for lane in range(count):
                    out[lane] = 0.0
                for k in range(len(slope)):
                    place = OUTPUTS[k] * LANES
                    for lane in range(count):
                        out[lane] += (W[place + lane] - Y[k, label + lane]) * slope[k, label + lane]
        if not linear:
            continue
        for row in range(errors):
            A[:] = 0.0
            if row < rows:
                seed_lanes(A, scale[row], OUTPUTS[row], label, count, width)
            else:
                for k in range(len(slope)):
                    seed_lanes(A, slope[k], OUTPUTS[k], label, count, width)
            number, drift = n_numbers, motions.shape[1]
            for s in range(n_stages - 1, -1, -1):
                at = s * tape
                if kicks[s]:
                    number -= TERMS
                    kick_back(A, T[at : at + tape], B[number * LANES : (number + TERMS) * LANES], width)
                else:
                    number, drift = number - 1, drift - 1
                    out = B[number * LANES : (number + 1) * LANES]
                    drift_back(A, T[at : at + tape], out, c[j, number], motions[j, drift], values, width)
            begin = (j * errors + row) * n_states + start
            for f in range(len(J)):
                J[f, begin : begin + count] = 0.0
            for k in range(len(places)):
                source = B[places[k, 1] * LANES : (places[k, 1] + 1) * LANES]
                add_lanes(J[places[k, 0], begin : begin + count], source, design[j, k], count)

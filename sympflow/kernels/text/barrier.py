"""A barrier of threads in compiled code, which wait for each other without the interpreter. Source text.

A pool's threads need a tenth of a millisecond to begin and to end a piece of work, as long as the forces of some
hundred bodies. Those that meet here spin for some microseconds, and then leave the core to others.
"""
# ruff: noqa: F821
# mypy: ignore-errors

from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

ARRIVED, TURN, GONE = 0, 1, 2
"""Numbers of `meeting` (3,): threads that are here, times that all were, and whether one of them ended too soon."""
SPINS, YIELDS = 20_000, 200  # looks before a thread lets others run, and before it sleeps
PAUSE = 20  # µs

leave_core = types.ExternalFunction("sched_yield", types.int32())
sleep = types.ExternalFunction("usleep", types.int32(types.uint32))


def address_of(context, builder, signature, args):
    array = context.make_array(signature.args[0])(context, builder, args[0])
    return cgutils.get_item_pointer(context, builder, signature.args[0], array, [args[1]])


@intrinsic
def seen(typing_context, meeting, i):
    """The number i, as any thread has left it."""

    def code(context, builder, signature, args):
        return builder.load_atomic(address_of(context, builder, signature, args), "seq_cst", 8)

    return types.int64(meeting, types.intp), code


@intrinsic
def added(typing_context, meeting, i, change):
    """Add to the number i at once, for all threads; what it was."""

    def code(context, builder, signature, args):
        return builder.atomic_rmw("add", address_of(context, builder, signature, args), args[2], "seq_cst")

    return types.int64(meeting, types.intp, types.int64), code


@njit(**OPTIONS)
def meet(meeting, members):
    """Wait until so many threads are here; False if one of them will not come."""
    if members == 1:
        return True
    turn, looks = seen(meeting, TURN), 0
    if added(meeting, ARRIVED, 1) == members - 1:
        added(meeting, ARRIVED, -members)
        added(meeting, TURN, 1)
        return True
    while seen(meeting, TURN) == turn:
        if seen(meeting, GONE) != 0:
            return False
        looks += 1
        if looks > SPINS + YIELDS:
            sleep(types.uint32(PAUSE))
        elif looks > SPINS:
            leave_core()
    return True

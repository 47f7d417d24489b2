"""Numbers side by side in a register: a type of its own for Numba, with arithmetic. Source text.

A value of `LANES` is `VECTOR` numbers. It is for loops that LLVM does not turn into vector instructions by itself.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import operator

from llvmlite import ir
from numba import types
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

REGISTER = ir.VectorType(ir.DoubleType(), VECTOR)


class Lanes(types.Type):
    """The type of numbers side by side."""


LANES = Lanes(f"lanes of {VECTOR}")


@register_model(Lanes)
class LanesModel(models.PrimitiveModel):
    def __init__(self, manager, of):
        super().__init__(manager, of, REGISTER)


def spread(builder, value):
    """A number in all lanes; lanes as they are."""
    if value.type == REGISTER:
        return value
    first = builder.insert_element(ir.Constant(REGISTER, ir.Undefined), value, ir.IntType(32)(0))
    order = ir.Constant(ir.VectorType(ir.IntType(32), VECTOR), [0] * VECTOR)
    return builder.shuffle_vector(first, ir.Constant(REGISTER, ir.Undefined), order)


def define(operation, name):
    """Let Numba know an operation of lanes with lanes or with a number."""
    pairs = [(LANES, LANES), (LANES, types.float64), (types.float64, LANES)]

    @infer_global(operation)
    class Typing(ConcreteTemplate):
        cases = tuple(signature(LANES, *pair) for pair in pairs)

    def generate(context, builder, signature, arguments):
        return getattr(builder, name)(*(spread(builder, value) for value in arguments), flags=("contract",))

    for pair in pairs:
        lower_builtin(operation, *pair)(generate)


define(operator.add, "fadd")
define(operator.sub, "fsub")
define(operator.mul, "fmul")
define(operator.truediv, "fdiv")


@infer_global(operator.neg)
class Negation(ConcreteTemplate):
    cases = (signature(LANES, LANES),)


@lower_builtin(operator.neg, LANES)
def negative(context, builder, signature, arguments):
    return builder.fneg(arguments[0])


@intrinsic
def all_lanes(typing_context, value):
    """A number in all lanes; lanes as they are."""

    def generate(context, builder, signature, arguments):
        return spread(builder, arguments[0])

    return LANES(value), generate


@intrinsic
def lanes_where(typing_context, there, value):
    """Lanes as they are where others are not 0, and 0 where these are."""

    def generate(context, builder, signature, arguments):
        nothing = ir.Constant(REGISTER, [0.0] * VECTOR)
        return builder.select(
            builder.fcmp_unordered("!=", arguments[0], nothing), spread(builder, arguments[1]), nothing
        )

    return LANES(there, value), generate


def address(context, builder, x, arguments):
    place = builder.gep(context.make_array(x)(context, builder, arguments[0]).data, [arguments[1]])
    return builder.bitcast(place, REGISTER.as_pointer())


@intrinsic
def lanes_at(typing_context, x, i):
    """x[i : i + VECTOR], of an aligned vector, where i is a multiple of `VECTOR`."""

    def generate(context, builder, signature, arguments):
        return builder.load(address(context, builder, x, arguments), align=8 * VECTOR)

    return LANES(x, i), generate


@intrinsic
def put_lanes(typing_context, x, i, value):
    """x[i : i + VECTOR] = value, of the same."""

    def generate(context, builder, signature, arguments):
        builder.store(arguments[2], address(context, builder, x, arguments), align=8 * VECTOR)
        return context.get_dummy_value()

    return types.void(x, i, LANES), generate


@intrinsic
def lanes_behind(typing_context, value, last):
    """Each lane of `value` in the lane after its own, and the last lane of `last` in the first one."""

    def generate(context, builder, signature, arguments):
        order = [2 * VECTOR - 1, *range(VECTOR - 1)]
        return builder.shuffle_vector(*arguments, ir.Constant(ir.VectorType(ir.IntType(32), VECTOR), order))

    return LANES(value, last), generate


@intrinsic
def lanes_ahead(typing_context, value, first):
    """Each lane of `value` in the lane before its own, and the first lane of `first` in the last one."""

    def generate(context, builder, signature, arguments):
        order = [*range(1, VECTOR), VECTOR]
        return builder.shuffle_vector(*arguments, ir.Constant(ir.VectorType(ir.IntType(32), VECTOR), order))

    return LANES(value, first), generate

"""Functions of machine code as text of LLVM IR: values, loops, conditions, memory, calls.

A `Value` is a number of the kind "exists when the code runs": a double, or a register of several, one trajectory each.
A stage called with values writes its operations into the `Code` of the function that is being built. Nothing here
reassociates or fuses: a scalar and every lane of a register get the same operations, and so the same bits.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

from sympflow.compiler.numbers import Number
from sympflow.compiler.tables import TABLES, Table

__all__ = [
    "BOOL",
    "DOUBLE",
    "INT",
    "LOWERED",
    "POINTER",
    "Code",
    "Module",
    "Rows",
    "Sweep",
    "Type",
    "Value",
    "Variable",
    "assign",
]


class Type(NamedTuple):
    """A type of values: the scalar's name in LLVM, and how many of them lie in a register."""

    scalar: str
    width: int = 1

    def __str__(self) -> str:
        return self.scalar if self.width == 1 else f"<{self.width} x {self.scalar}>"

    @property
    def floating(self) -> bool:
        return self.scalar == "double"

    @property
    def suffix(self) -> str:
        """The type in names of intrinsics."""
        short = "f64" if self.floating else self.scalar
        return short if self.width == 1 else f"v{self.width}{short}"

    def of(self, scalar: str) -> Type:
        """The type of other scalars, as many of them."""
        return Type(scalar, self.width)


DOUBLE, INT, BOOL, POINTER = Type("double"), Type("i64"), Type("i1"), Type("ptr")


class Value(Number):
    """A value of the function that is being built."""

    __slots__ = ("code", "name", "type")

    def __init__(self, code: Code, type: Type, name: str) -> None:
        self.code, self.type, self.name = code, type, name

    def apply(self, name: str, args: Sequence[Any]) -> Any:
        for x in args:
            if isinstance(x, Number) and not isinstance(x, Value):  # a kind that is made of values
                return x.apply(name, args)
        return self.code.apply(name, args)

    @property
    def bits(self) -> Value:
        """The bits of a double as a whole number."""
        return self.code.convert("bitcast", self, "i64")

    @property
    def real(self) -> Value:
        """The double of these bits."""
        return self.code.convert("bitcast", self, "double")

    def __and__(self, other: Any) -> Value:
        return self._bitwise("and", other)

    def __or__(self, other: Any) -> Value:
        return self._bitwise("or", other)

    def __xor__(self, other: Any) -> Value:
        return self._bitwise("xor", other)

    def __lshift__(self, other: Any) -> Value:
        return self._bitwise("shl", other)

    def __rshift__(self, other: Any) -> Value:
        return self._bitwise("lshr", other)

    def _bitwise(self, operation: str, other: Any) -> Value:
        return self.code.op(operation, self.type, self, self.code.operand(other, self.type))

    def __repr__(self) -> str:
        return f"{self.type} {self.name}"


LOWERED: dict[str, Callable[..., Value]] = {}
"""Code of functions of several instructions: see `elementary`."""


class Variable:
    """A place that holds one value after the other."""

    __slots__ = ("_code", "_place", "_type")

    def __init__(self, code: Code, x: Value) -> None:
        self._code, self._type, self._place = code, x.type, code.memory(1, x.type)
        self.value = x

    @property
    def value(self) -> Value:
        return self._code.load(self._place, 0, self._type)

    @value.setter
    def value(self, x: Value) -> None:
        self._code.store(x, self._place)


def assign(variables: Sequence[Variable], values: Sequence[Value]) -> None:
    """Give variables these values."""
    for variable, x in zip(variables, values, strict=True):
        variable.value = x


class Rows:
    """Memory as numbers of one type, one after the other."""

    __slots__ = ("code", "place", "type")

    def __init__(self, place: Value, type: Type) -> None:
        self.code, self.place, self.type = place.code, place, type

    def __getitem__(self, i: Any) -> Value:
        return self.code.load(self.place, i * self.type.width, self.type)

    def __setitem__(self, i: Any, x: Any) -> None:
        self.code.store(self.code.operand(x, self.type), self.place, i * self.type.width)

    def add(self, i: Any, *products: tuple[Value, Value]) -> None:
        """Add products to number i."""
        total = self[i]
        for x, y in products:
            total = self.code.fma(x, y, total)
        self[i] = total

    def part(self, i: Any) -> Rows:
        """The numbers from i on."""
        return Rows(self.code.at(self.place, i * self.type.width, self.type.scalar), self.type)


class Module:
    """The functions of one piece of machine code, and what they need; `fused` where a product and sum are one."""

    def __init__(self, fused: bool = True) -> None:
        self.fused = fused
        self._declared: dict[str, str] = {}
        self._functions: dict[str, str] = {}
        self._uses: dict[str, int] = {}

    def function(
        self, name: str, arguments: Sequence[Type], result: Type | None = None, within: bool = False, rare: bool = True
    ) -> Code:
        """Begin a function; `within` for one that is called by the others only, `rare`ly, and not copied into them."""
        return Code(self, name, arguments, result, within, rare)

    def used(self, name: str) -> int:
        """Count one more use of a name, and return how many there are."""
        self._uses[name] = self._uses.get(name, 0) + 1
        return self._uses[name]

    def declare(self, name: str, text: str) -> None:
        """Put a declaration or a constant before the functions, once."""
        self._declared[name] = text

    def has(self, name: str) -> bool:
        return name in self._functions

    def add(self, name: str, text: str) -> None:
        self._functions[name] = text

    def __str__(self) -> str:
        return "\n".join([*self._declared.values(), *self._functions.values()]) + "\n"


def literal(x: float, type: Type) -> str:
    """Return a constant as LLVM writes it."""
    if type.floating:
        text = f"0x{struct.unpack('<Q', struct.pack('<d', x))[0]:016X}"
    elif type.scalar == "i1":
        text = "true" if x else "false"
    else:
        text = str(int(x))
    return text if type.width == 1 else f"splat ({type.scalar} {text})"


def _vector(scalar: str, numbers: Iterable[int]) -> str:
    return f"<{', '.join(f'{scalar} {x}' for x in numbers)}>"


_PLAIN = {"add": "fadd", "sub": "fsub", "mul": "fmul", "times": "fmul", "div": "fdiv"}
_INTEGER = {"add": "add", "sub": "sub", "mul": "mul", "and": "and", "or": "or"}
_COMPARED = {"lt": ("olt", "slt"), "le": ("ole", "sle"), "eq": ("oeq", "eq")}
_INTRINSIC = {"sqrt": "llvm.sqrt", "abs": "llvm.fabs", "floor": "llvm.floor"}


class Code:
    """One function, written line by line; its `arguments` are values."""

    def __init__(
        self, module: Module, name: str, arguments: Sequence[Type], result: Type | None, within: bool, rare: bool
    ) -> None:
        self.module, self.name, self.result = module, name, result
        self._kind, self._traits = ("internal ", f" noinline{' cold' if rare else ''}") if within else ("", "")
        self._types = list(arguments)
        self.arguments = [Value(self, type, f"%a{i}") for i, type in enumerate(arguments)]
        self._lines: list[str] = []
        self._entry: list[str] = []
        self._count = 0
        self._block = "entry"
        self._before: dict[str, str] = {}
        self._known: dict[tuple[str, Any], list[Value]] = {}

    # arithmetic ---------------------------------------------------------------------------------------------------

    def constant(self, x: float, type: Type = DOUBLE) -> Value:
        return Value(self, type, literal(x, type))

    def operand(self, x: Any, type: Type) -> Value:
        """A number or float as a value of the type; a scalar goes to all lanes."""
        if not isinstance(x, Value):
            return self.constant(x, type)
        return self.splat(x, type.width) if x.type.width != type.width else x

    def op(self, operation: str, type: Type, *args: Value) -> Value:
        """Write an instruction of operands of one type."""
        return self._new(type, f"{operation} {args[0].type} {', '.join(a.name for a in args)}")

    def intrinsic(self, name: str, *args: Value, result: Type | None = None, more: str = "") -> Value:
        """Write a call of an LLVM intrinsic that is overloaded by the type of its first argument."""
        full = f"{name}.{args[0].type.suffix}"
        return self.external(full, args, args[0].type if result is None else result, more)

    def external(self, name: str, args: Sequence[Value], result: Type | None, more: str = "") -> Value:
        """Write a call of a function that is declared only: an intrinsic, or one of the C library."""
        types = ", ".join(str(a.type) for a in args) + (f", {more.split(maxsplit=1)[0]}" if more else "")
        self.module.declare(name, f"declare {result or 'void'} @{name}({types})")
        return self.call(f"@{name}", args, result, more)

    def call(self, target: str, args: Sequence[Value], result: Type | None = None, more: str = "") -> Value:
        """Write a call of a function, by its name or its address."""
        given = ", ".join([*(f"{a.type} {a.name}" for a in args), *([more] if more else [])])
        return self._new(result, f"call {result or 'void'} {target}({given})")

    def outlined(
        self,
        name: str,
        args: Sequence[Value],
        body: Callable[..., Value | None],
        result: Type | None = None,
        rare: bool = False,
    ) -> Value:
        """Write a call of a function of its own, made of `body(*arguments)` when it is called first."""
        if not self.module.has(name):
            function = self.module.function(name, [a.type for a in args], result, within=True, rare=rare)
            function.give(body(*function.arguments))
        return self.call(f"@{name}", args, result)

    def once(self, key: Any, make: Callable[[], Sequence[Value]]) -> list[Value]:
        """The values of `make()`, or those that it gave for this key before, if they hold here."""
        block: str | None = self._block
        while block is not None:
            if (block, key) in self._known:
                return self._known[block, key]
            block = self._before.get(block)
        values = list(make())
        self._known[self._block, key] = values
        return values

    def pack(self, values: Sequence[Value]) -> Value:
        """Several values as one, to be given by a function."""
        type = Type(f"{{ {', '.join(str(v.type) for v in values)} }}")
        total = Value(self, type, "poison")
        for i, v in enumerate(values):
            total = self._new(type, f"insertvalue {type} {total.name}, {v.type} {v.name}, {i}")
        return total

    def unpack(self, packed: Value, types: Sequence[Type]) -> list[Value]:
        return [self._new(t, f"extractvalue {packed.type} {packed.name}, {i}") for i, t in enumerate(types)]

    def lane(self, x: Value, k: int) -> Value:
        """The number in one lane."""
        return self._new(Type(x.type.scalar), f"extractelement {x.type} {x.name}, i64 {k}")

    def lanes(self, function: Callable[..., Value], args: Sequence[Value], result: Type) -> Value:
        """Call a function of scalars with one lane after the other."""
        if result.width == 1:
            return function(*args)
        total = Value(self, result, "poison")
        for k in range(result.width):
            y = function(*(self.lane(a, k) for a in args))
            total = self._new(result, f"insertelement {result} {total.name}, {y.type} {y.name}, i64 {k}")
        return total

    def apply(self, name: str, args: Sequence[Any]) -> Value:
        """Write a function of the table; operands that are floats become constants."""
        if isinstance(args[0], Table):
            return LOWERED[name](*args)
        numbers = [a for a in args if isinstance(a, Value)]
        width = max(a.type.width for a in numbers)
        scalar = next((a.type.scalar for a in numbers if a.type.scalar != "i1"), None)
        if scalar is None:
            scalar = "double" if name == "where" else "i1"
        type = Type(scalar, width)
        if name == "where":
            values = [self.operand(args[0], type.of("i1")), *(self.operand(a, type) for a in args[1:])]
            return self.select(*values)
        values = [self.operand(a, type) for a in args]
        if name in _COMPARED:
            kind = "fcmp " + _COMPARED[name][0] if type.floating else "icmp " + _COMPARED[name][1]
            return self.op(kind, type.of("i1"), *values)
        if not type.floating:
            if name == "not":
                return self.op("xor", type, values[0], self.constant(1, type))
            if name == "neg":
                return self.op("sub", type, self.constant(0, type), values[0])
            if name in ("min", "max"):
                return self.intrinsic(f"llvm.s{name}", *values)
            return self.op(_INTEGER[name], type, *values)
        if name in _PLAIN:
            return self.op(_PLAIN[name], type, *values)
        if name == "neg":
            return self.op("fneg", type, *values)
        if name == "fma":
            return self.fma(*values)
        if name in _INTRINSIC:
            return self.intrinsic(_INTRINSIC[name], *values)
        if name == "pow" and not isinstance(args[1], Value):
            return LOWERED["power"](values[0], float(args[1]))
        return LOWERED[name](*values)

    def fma(self, x: Value, y: Value, z: Value) -> Value:
        """x·y + z, rounded once where the machine can."""
        if self.module.fused:
            return self.intrinsic("llvm.fma", x, y, z)
        return self.op("fadd", x.type, self.op("fmul", x.type, x, y), z)

    def select(self, condition: Value, x: Value, y: Value) -> Value:
        text = f"select {condition.type} {condition.name}, {x.type} {x.name}, {y.type} {y.name}"
        return self._new(x.type, text)

    def convert(self, operation: str, x: Value, scalar: str) -> Value:
        """Write a conversion: bitcast, sitofp, fptosi, zext, sext, trunc …"""
        type = x.type.of(scalar)
        return self._new(type, f"{operation} {x.type} {x.name} to {type}")

    def splat(self, x: Value, width: int) -> Value:
        """A scalar in all lanes."""
        if width == 1:
            return x
        if not x.name.startswith("%"):
            return Value(self, Type(x.type.scalar, width), f"splat ({x.type.scalar} {x.name})")
        type = Type(x.type.scalar, width)
        first = self._new(type, f"insertelement {type} poison, {x.type} {x.name}, i64 0")
        return self._new(type, f"shufflevector {type} {first.name}, {type} poison, <{width} x i32> zeroinitializer")

    def shuffle(self, x: Value, y: Value, lanes: Sequence[int]) -> Value:
        """Lanes of x, and behind them those of y, in another order."""
        if x.type.width == 1:
            return (x, y)[lanes[0]]
        order = ", ".join(f"i32 {k}" for k in lanes)
        pair = f"{x.type} {x.name}, {y.type} {y.name}"
        return self._new(Type(x.type.scalar, len(lanes)), f"shufflevector {pair}, <{len(lanes)} x i32> <{order}>")

    def lane_numbers(self, width: int) -> Value:
        """0, 1, … in the lanes."""
        return Value(self, INT, "0") if width == 1 else Value(self, Type("i64", width), _vector("i64", range(width)))

    def total(self, x: Value) -> Value:
        """The sum of all lanes, halves added to halves."""
        while x.type.width > 2:
            half = Type(x.type.scalar, x.type.width // 2)
            n, rest = half.width, f"{x.type} poison"
            low, high = (
                self._new(half, f"shufflevector {x.type} {x.name}, {rest}, <{n} x i32> {_vector('i32', lanes)}")
                for lanes in (range(n), range(n, 2 * n))
            )
            x = low + high
        if x.type.width == 1:
            return x
        first, last = (self._new(Type(x.type.scalar), f"extractelement {x.type} {x.name}, i64 {k}") for k in (0, 1))
        return first + last

    def any(self, condition: Value) -> Value:
        """True if a condition holds in any lane."""
        if condition.type.width == 1:
            return condition
        return self.intrinsic("llvm.vector.reduce.or", condition, result=BOOL)

    # memory -------------------------------------------------------------------------------------------------------

    def at(self, pointer: Value, index: Any, scalar: str = "double") -> Value:
        """The address of an element of an array of scalars."""
        if isinstance(index, int) and index == 0:
            return pointer
        index = self.operand(index, INT)
        return self._new(POINTER, f"getelementptr inbounds {scalar}, ptr {pointer.name}, i64 {index.name}")

    def load(self, pointer: Value, index: Any = 0, type: Type = DOUBLE, shared: bool = False) -> Value:
        """The value at an index of an array of scalars, aligned as these are; `shared` if another thread changes it."""
        place = self.at(pointer, index, type.scalar)
        kind, order = ("load atomic volatile", " seq_cst") if shared else ("load", "")
        return self._new(type, f"{kind} {type}, ptr {place.name}{order}, align {_SIZES[type.scalar]}")

    def store(self, x: Value, pointer: Value, index: Any = 0) -> None:
        place = self.at(pointer, index, x.type.scalar)
        self._lines.append(f"  store {x.type} {x.name}, ptr {place.name}, align {_SIZES[x.type.scalar]}")

    def added(self, x: Value, pointer: Value, index: Any = 0) -> Value:
        """Add to a whole number that several threads change, and return it as it was."""
        place = self.at(pointer, index, x.type.scalar)
        return self._new(x.type, f"atomicrmw add ptr {place.name}, {x.type} {x.name} seq_cst")

    def address(self, x: Value) -> Value:
        """A whole number as the address of memory, which others may read and write too."""
        return self._new(POINTER, f"inttoptr i64 {x.name} to ptr")

    def memory(self, count: int, type: Type = DOUBLE) -> Value:
        """Room for so many values on the stack, aligned to 64 bytes."""
        self._count += 1
        name = f"%m{self._count}"
        self._entry.append(f"  {name} = alloca [{count} x {type}], align 64")
        return Value(self, POINTER, name)

    def gathered(self, pointer: Value, index: Value) -> Value:
        """The values at indices of an array of doubles, one in each lane."""
        if index.type.width == 1:
            return self.load(pointer, index)
        type, n = index.type.of("double"), index.type.width
        name, places = f"llvm.masked.gather.{type.suffix}.v{n}p0", Type("ptr", n)
        self.module.declare(name, f"declare {type} @{name}({places}, i32, <{n} x i1>, {type})")
        place = self._new(places, f"getelementptr inbounds double, ptr {pointer.name}, {index.type} {index.name}")
        given = f"{places} {place.name}, i32 8, <{n} x i1> splat (i1 true), {type} poison"
        return self._new(type, f"call {type} @{name}({given})")

    def table(self, table: Table) -> Value:
        """The address of the numbers of a table, which the linker inserts for its symbol."""
        symbol = table.symbol
        TABLES.setdefault(symbol, table)  # loaded code reads the first one, whose memory must stay
        self.module.declare(symbol, f"@{symbol} = external global double")
        self.module.declare(
            f"{symbol}.place", f"@{symbol}.place = internal externally_initialized global ptr @{symbol}"
        )
        return self.load(Value(self, POINTER, f"@{symbol}.place"), 0, POINTER)

    def array(self, name: str, values: Iterable[Any], type: Type = DOUBLE) -> Value:
        """The address of numbers that stand in the module, under a name of it."""
        numbers = [f"{type} {literal(x, type)}" for x in values]
        self.module.declare(name, f'@"{name}" = internal constant [{len(numbers)} x {type}] [{", ".join(numbers)}]')
        return Value(self, POINTER, f'@"{name}"')

    def variable(self, x: Value) -> Variable:
        """A variable with this value; the machine keeps it in a register."""
        return Variable(self, x)

    # control ------------------------------------------------------------------------------------------------------

    @contextmanager
    def over(self, count: Any) -> Iterator[Value]:
        """Execute the code written inside for k = 0 … count − 1, not at all if the count is not positive."""
        count = self.operand(count, INT)
        k = self.variable(self.constant(0, INT))
        with self.during(lambda: k.value < count):
            yield k.value
            k.value = k.value + 1

    @contextmanager
    def during(self, condition: Callable[[], Value]) -> Iterator[None]:
        """Execute the code written inside while a condition holds."""
        head, inside, after, before = self._label(), self._label(), self._label(), self._block
        self._branch(head)
        self._begin(head, before)
        self._lines.append(f"  br i1 {condition().name}, label %{inside}, label %{after}")
        self._begin(inside, head)
        yield
        self._branch(head)
        self._begin(after, head)

    @contextmanager
    def given(self, condition: Value) -> Iterator[None]:
        """Execute the code written inside if a condition holds."""
        inside, after, before = self._label(), self._label(), self._block
        self._lines.append(f"  br i1 {condition.name}, label %{inside}, label %{after}")
        self._begin(inside, before)
        yield
        self._branch(after)
        self._begin(after, before)

    def loop(self, count: Any, carried: Sequence[Value], body: Callable[..., Sequence[Value]]) -> list[Value]:
        """Return the values after `body(k, values)` for k = 0 … count − 1, none if the count is not positive."""
        variables = [self.variable(x) for x in carried]
        with self.over(count) as k:
            assign(variables, body(k, [x.value for x in variables]))
        return [x.value for x in variables]

    @contextmanager
    def sweep(self, first: Value, last: Value, read: Callable[[Any, Value], Value]) -> Iterator[Sweep]:
        """Execute the code written inside for k = first … last − 1, at least once, with values of other turns."""
        sweep = Sweep(self, first, read)
        outside, self._lines = self._lines, []
        head, after, before = self._label(), self._label(), self._block
        self._block, self._before[head] = head, before
        yield sweep
        following = sweep.k + 1
        again = following < last
        end, body, self._lines = self._block, self._lines, outside
        phis, begun, made = sweep.finished(before, end, following)
        self._lines += begun
        self._branch(head)
        self._begin(head, before)
        self._lines += [*phis, *made, *body, f"  br i1 {again.name}, label %{head}, label %{after}"]
        self._begin(after, end)

    @contextmanager
    def elsewhere(self, lines: list[str]) -> Iterator[None]:
        """Put what is written inside behind these lines."""
        here, self._lines = self._lines, lines
        yield
        self._lines = here

    def phi(self, value: Value, first: Value, before: str, following: Value, end: str) -> str:
        """The line of a value that is `first` when a loop begins, and then that of the turn before."""
        return f"  {value.name} = phi {value.type} [ {first.name}, %{before} ], [ {following.name}, %{end} ]"

    def repeat(self, carried: Sequence[Value], body: Callable[..., tuple[Value, Sequence[Value]]]) -> list[Value]:
        """Execute `body(values)`, which returns whether to go on and the new values, at least once."""
        variables, going = [self.variable(x) for x in carried], self.variable(self.constant(1, BOOL))
        with self.during(lambda: going.value):
            going.value, new = body([x.value for x in variables])
            assign(variables, new)
        return [x.value for x in variables]

    def when(
        self,
        condition: Value,
        then: Callable[[], Sequence[Value]],
        otherwise: Callable[[], Sequence[Value]] = tuple,
        rare: bool = False,
    ) -> list[Value]:
        """Execute one of two bodies, and return its values; `rare` if the first one hardly ever."""
        yes, no, after, before = self._label(), self._label(), self._label(), self._block
        weights = ""
        if rare:
            self.module.declare("!rare", '!0 = !{!"branch_weights", i32 1, i32 100000}')
            weights = ", !prof !0"
        self._lines.append(f"  br i1 {condition.name}, label %{yes}, label %{no}{weights}")
        ends, results = [], []
        for label, body in ((yes, then), (no, otherwise)):
            self._begin(label, before)
            results.append(list(body()))
            ends.append(self._block)
            self._branch(after)
        self._begin(after, before)
        return [
            self._new(x.type, f"phi {x.type} [ {x.name}, %{ends[0]} ], [ {y.name}, %{ends[1]} ]")
            for x, y in zip(*results, strict=True)
        ]

    def give(self, x: Value | None = None) -> None:
        """End the function, with its result."""
        self._lines.append("  ret void" if x is None else f"  ret {x.type} {x.name}")
        given = ", ".join(f"{t}{' noalias' if t == POINTER else ''} %a{i}" for i, t in enumerate(self._types))
        head = f"define {self._kind}{self.result or 'void'} @{self.name}({given}){self._traits} nounwind {{\nentry:"
        self.module.add(self.name, "\n".join([head, *self._entry, *self._lines, "}"]))

    def _name(self, type: Type) -> Value:
        self._count += 1
        return Value(self, type, f"%v{self._count}")

    def _new(self, type: Type | None, text: str) -> Value:
        if type is None:
            self._lines.append(f"  {text}")
            return Value(self, BOOL, "poison")
        value = self._name(type)
        self._lines.append(f"  {value.name} = {text}")
        return value

    def _label(self) -> str:
        self._count += 1
        return f"b{self._count}"

    def _begin(self, label: str, before: str) -> None:
        """Begin a block, which is reached through the one before only."""
        self._lines.append(f"{label}:")
        self._block, self._before[label] = label, before

    def _branch(self, label: str) -> None:
        self._lines.append(f"  br label %{label}")


class Sweep:
    """Turns k of a loop over places, in which values of places further on stay in registers until their turn comes."""

    def __init__(self, code: Code, first: Value, read: Callable[[Any, Value], Value]) -> None:
        self.code, self.k = code, code._name(INT)
        self._first, self._read = first, read
        self._values: dict[Any, dict[int, Value]] = {}
        self._made: set[Any] = set()
        self._begun: list[str] = []
        self._types: dict[Any, Type] = {}

    def get(self, key: Any, d: int, type: Type) -> Value:
        """The value of a key at the place k + d: read from memory when that is met first, unless it is put there.

        A value that is put is 0 for places before the first one where it was.
        """
        self._types[key] = type
        values = self._values.setdefault(key, {})
        if d not in values:
            values[d] = self.code._name(type)
        return values[d]

    def put(self, key: Any, d: int, x: Value) -> None:
        """Set the value of a key at the place k + d, the furthest one at which it is used."""
        self._types[key] = x.type
        self._values.setdefault(key, {})[d] = x
        self._made.add(key)

    @contextmanager
    def before(self) -> Iterator[None]:
        """Put what is written inside before the loop."""
        with self.code.elsewhere(self._begun):
            yield

    def finished(self, before: str, end: str, following: Value) -> tuple[list[str], list[str], list[str]]:
        """Lines that carry values over, lines before the loop, and those where a turn begins."""
        code, made = self.code, list[str]()
        phis = [code.phi(self.k, self._first, before, following, end)]
        for key, values in self._values.items():
            most, type = max(values), self._types[key]
            if key not in self._made:
                with code.elsewhere(made):
                    x = self._read(key, self.k + most)
                made.append(f"  {values[most].name} = bitcast {type} {x.name} to {type}")
            for d in range(min(values), most):
                value = self.get(key, d, type)
                first = code.constant(0.0, type)
                if key not in self._made:
                    with code.elsewhere(self._begun):
                        first = self._read(key, self._first + d)
                phis.append(code.phi(value, first, before, self.get(key, d + 1, type), end))
        return phis, self._begun, made


_SIZES = {"double": 8, "i64": 8, "i32": 4, "i1": 1, "ptr": 8}

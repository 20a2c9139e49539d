# mypy: disallow-untyped-calls=False, disallow-untyped-decorators=False
# mypy: disable-error-code="no-any-return, override"
"""Lets a function written for one run compute eight runs, using a vector type for its values.

A loop over runs becomes vector instructions only if it is the innermost loop. In the dynamics
of a chain of joints, the innermost loops go from joint to joint. The compiler would vectorise
those, although their values are not adjacent in memory. This module therefore defines a Numba
type for a value that consists of eight numbers, one per run. In a function compiled for this
type, a single instruction computes `a + b` for all eight runs. The source of the function is
not changed.

A function that branches on such a value is rejected at compile time, because the eight runs may
need different branches. The function must use `choose` instead.

Invariant:
    - Each element of a result is computed by the same operations from the same operands as in a
      run that is computed alone.
"""

import hashlib
import math
import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.extending import intrinsic, lower_cast, models, register_model
from numba.core.imputils import lower_builtin, lower_getattr_generic, lower_setattr_generic
from numba.core.typeconv.castgraph import Conversion
from numba.core.typing.templates import (
    AbstractTemplate,
    AttributeTemplate,
    infer_getattr,
    infer_global,
    signature,
)

from ..step.jit import set_lane_form
from ..step.vectors import choose, holds_anywhere, round_down, whole
from .lane_rows import LANES, Constants, LaneField, LaneTable, RowType, make_view, offset_rows

GROUP = 8
"""Number of runs whose values form one vector: the doubles that fit in one register."""
_WORD = 8
_WORD_TYPE = ir.IntType(64)
_LLVM_KINDS = {
    "f8": ir.VectorType(ir.DoubleType(), GROUP),
    "i8": ir.VectorType(_WORD_TYPE, GROUP),
    "b1": ir.VectorType(ir.IntType(1), GROUP),
}


class LaneVector(types.Type):
    """Numba type of eight numbers in one vector register, one for each of eight runs.

    One SIMD instruction then computes a value for all eight runs.

    Args:
        kind: Element type: "f8" for a float, "i8" for an integer, "b1" for a condition.
    """

    in_lanes = True

    def __init__(self, kind: str) -> None:
        self.kind = kind
        super().__init__(f"LaneVector({kind}, {GROUP})")

    @property
    def mangling_args(self) -> tuple[str, tuple[str]]:
        """Form of this type that Numba uses in the names of compiled functions."""
        return "LaneVector", (self.kind,)

    def can_convert_from(self, _context: Any, other: Any) -> Any:
        """Tells Numba that a scalar may be used where a vector of eight floats is needed.

        The scalar is then repeated eight times. Returns None, which forbids the conversion, for
        vectors of integers or conditions, and for values that are not numbers.
        """
        is_number = isinstance(other, types.Float | types.Integer)
        return Conversion.safe if is_number and self.kind == "f8" else None

    def unify(self, _context: Any, other: Any) -> Any:
        """Returns the type of a variable that is a vector or a scalar, depending on the branch.

        Numba requires a single type per variable. The vector type is used, and the scalar is
        repeated for all eight runs. Returns None, which causes a compilation error, if the
        vector does not contain floats or if the other value is not a number.
        """
        is_number = isinstance(other, types.Float | types.Integer)
        return self if is_number and self.kind == "f8" else None


FLOATS = LaneVector("f8")
INTEGERS = LaneVector("i8")
CONDITIONS = LaneVector("b1")


@register_model(LaneVector)
class _VectorModel(models.PrimitiveModel):
    """Represents a `LaneVector` in machine code as an LLVM vector."""

    def __init__(self, manager: Any, numba_type: LaneVector) -> None:
        super().__init__(manager, numba_type, _LLVM_KINDS[numba_type.kind])


def _repeat(builder: Any, number: Any, vector_type: Any) -> Any:
    """Generates LLVM code for a vector whose elements are all equal."""
    undefined = ir.Constant(vector_type, ir.Undefined)
    first = builder.insert_element(undefined, number, ir.Constant(ir.IntType(32), 0))
    places = ir.Constant(ir.VectorType(ir.IntType(32), GROUP), [0] * GROUP)
    return builder.shuffle_vector(first, undefined, places)


def _cast_number(context: Any, builder: Any, source: Any, _target: Any, number: Any) -> Any:
    """Generates LLVM code that converts a scalar to a vector of floats."""
    as_float = context.cast(builder, number, source, types.float64)
    return _repeat(builder, as_float, _LLVM_KINDS["f8"])


lower_cast(types.Float, FLOATS)(_cast_number)
lower_cast(types.Integer, FLOATS)(_cast_number)


def _is_number(numba_type: Any) -> bool:
    return isinstance(numba_type, types.Float | types.Integer)


def _define_binary(function: Any, result: LaneVector, generate: Callable[..., Any]) -> None:
    """Tells Numba how to compute an operation such as `a + b` on vectors of eight elements.

    One of the operands may be a scalar, which is then used for all eight runs.

    Args:
        function: The operation as a function, such as `operator.add`.
        result: Type of the result.
        generate: Function that appends the LLVM instruction.
    """

    @infer_global(function)
    class _Template(AbstractTemplate):
        def generic(self, args: Any, _keywords: Any) -> Any:
            if len(args) != 2 or FLOATS not in args:
                return None
            if all(kind == FLOATS or _is_number(kind) for kind in args):
                return signature(result, FLOATS, FLOATS)
            return None

    lower_builtin(function, FLOATS, FLOATS)(
        lambda _context, builder, _signature, args: generate(builder, *args)
    )


def _define_unary(function: Any, generate: Callable[..., Any]) -> None:
    """Tells Numba how to compute an operation on a vector of floats."""

    @infer_global(function)
    class _Template(AbstractTemplate):
        def generic(self, args: Any, _keywords: Any) -> Any:
            return signature(FLOATS, FLOATS) if args == (FLOATS,) else None

    lower_builtin(function, FLOATS)(
        lambda _context, builder, _signature, args: generate(builder, args[0])
    )


def _call_llvm(name: str) -> Callable[..., Any]:
    """Returns a function that generates a call to an LLVM function, such as sqrt."""

    def generate(builder: Any, number: Any) -> Any:
        floats = _LLVM_KINDS["f8"]
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(floats, [floats]), f"{name}.v{GROUP}f64"
        )
        return builder.call(function, [number])

    return generate


def _compare(symbol: str) -> Callable[..., Any]:
    """Returns a function that generates a comparison of two vectors, which is false for NaN."""
    return lambda builder, a, b: builder.fcmp_ordered(symbol, a, b)


def _least(builder: Any, a: Any, b: Any) -> Any:
    return builder.select(builder.fcmp_ordered("<", b, a), b, a)


def _largest(builder: Any, a: Any, b: Any) -> Any:
    return builder.select(builder.fcmp_ordered(">", b, a), b, a)


for _operators, _name in (
    ((operator.add, operator.iadd), "fadd"),
    ((operator.sub, operator.isub), "fsub"),
    ((operator.mul, operator.imul), "fmul"),
    ((operator.truediv, operator.itruediv), "fdiv"),
):
    for _operator in _operators:
        _define_binary(
            _operator, FLOATS, lambda builder, a, b, name=_name: getattr(builder, name)(a, b)
        )
for _operator, _symbol in (
    (operator.lt, "<"),
    (operator.le, "<="),
    (operator.gt, ">"),
    (operator.ge, ">="),
    (operator.eq, "=="),
):
    _define_binary(_operator, CONDITIONS, _compare(_symbol))
_define_binary(
    operator.ne, CONDITIONS, lambda builder, a, b: builder.fcmp_unordered("!=", a, b)
)
# The same as Numba's `min` and `max` of two numbers.
_define_binary(min, FLOATS, _least)
_define_binary(max, FLOATS, _largest)
_define_unary(operator.neg, lambda builder, a: builder.fneg(a))
_define_unary(abs, _call_llvm("llvm.fabs"))
_define_unary(math.sqrt, _call_llvm("llvm.sqrt"))
_define_unary(np.floor, _call_llvm("llvm.floor"))


def _define_integers(function: Any, result: LaneVector, generate: Callable[..., Any]) -> None:
    """Tells Numba how to compute an operation on a vector of eight integers and an integer.

    Args:
        function: The operation as a function, such as `operator.eq`.
        result: Type of the result.
        generate: Function that appends the LLVM instruction.
    """

    @infer_global(function)
    class _Template(AbstractTemplate):
        def generic(self, args: Any, _keywords: Any) -> Any:
            if len(args) == 2 and args[0] == INTEGERS and isinstance(args[1], types.Integer):
                return signature(result, INTEGERS, types.int64)
            return None

    def lower(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return generate(builder, args[0], _repeat(builder, args[1], _LLVM_KINDS["i8"]))

    lower_builtin(function, INTEGERS, types.int64)(lower)


_define_integers(operator.add, INTEGERS, lambda builder, a, b: builder.add(a, b))
_define_integers(operator.and_, INTEGERS, lambda builder, a, b: builder.and_(a, b))
_define_integers(operator.ne, CONDITIONS, lambda builder, a, b: builder.icmp_signed("!=", a, b))


@intrinsic
def _select(_context: Any, condition: Any, if_true: Any, if_false: Any) -> Any:
    """Generates LLVM code that selects elements from two vectors based on eight conditions."""
    if condition != CONDITIONS:
        return None
    if not all(kind == FLOATS or _is_number(kind) for kind in (if_true, if_false)):
        return None

    def generate(_target: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.select(*args)

    return FLOATS(CONDITIONS, FLOATS, FLOATS), generate


@intrinsic
def _truncate(_context: Any, number: Any) -> Any:
    """Generates LLVM code that converts floats to integers."""

    def generate(_target: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.fptosi(args[0], _LLVM_KINDS["i8"])

    return (INTEGERS(FLOATS), generate) if number == FLOATS else None


@intrinsic
def _reduce_or(_context: Any, conditions: Any) -> Any:
    """Generates LLVM code that determines whether any of eight conditions holds."""

    def generate(_target: Any, builder: Any, _signature: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], ir.IntType(GROUP))
        return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))

    return (types.boolean(conditions), generate) if conditions == CONDITIONS else None


select_vector: Any = _select
reduce_or: Any = _reduce_or
truncate_vector: Any = _truncate


def _choose_vector(condition: Any, if_true: Any, if_false: Any) -> Any:
    """Selects elements from two vectors based on eight conditions: `choose` for eight runs."""
    return select_vector(condition, if_true, if_false)


def _whole_vector(number: Any) -> Any:
    """Converts eight floats to integers: `whole` for eight runs at once."""
    return truncate_vector(number)


def _holds_in_vector(condition: Any) -> Any:
    """Version of `holds_anywhere` for vectors."""
    return reduce_or(condition)


set_lane_form(choose, lambda _types: _choose_vector)
set_lane_form(holds_anywhere, lambda _types: _holds_in_vector)


def _round_vector_down(number: Any) -> Any:
    """Rounds eight floats down: `round_down` for eight runs at once."""
    return np.floor(number)


set_lane_form(round_down, lambda _types: _round_vector_down)
set_lane_form(whole, lambda _types: _whole_vector)


class _GroupType(types.Type):
    """Numba type of some rows of a `LaneTable` in eight lanes, represented as a pointer."""

    in_lanes = True

    def __init__(self, table: Any, constants: tuple[Constants, ...]) -> None:
        self.fields: tuple[LaneField, ...] = table.fields
        self.row_length: int = table.row_length
        self.constants = constants
        name = f"{type(self).__name__}({self.fields}, {constants}, {LANES}, {GROUP})"
        super().__init__(name)

    @property
    def mangling_args(self) -> tuple[str, tuple[str]]:
        """Form of this type that Numba uses in the names of compiled functions."""
        digest = hashlib.sha256(self.name.encode()).hexdigest()
        return type(self).__name__, (f"g{digest[:16]}",)


class _RowsInGroup(_GroupType):
    """Numba type of an array of records of eight simulations, for SIMD vector instructions.

    Eight runs (lanes) are simulated side by side. Indexing the array, for example by the number
    of a network link, yields a `_RowInGroup`: the record of this link in all eight runs.
    """


class _RowInGroup(RowType, _GroupType):
    """Numba type of one record of eight simulations at once, for SIMD vector instructions.

    A record (row) contains, for example, the state of one arm. Eight runs (lanes) are simulated
    side by side, so a field of the row, such as an angle, is a vector of eight values
    (`LaneVector`), one per run.
    """


@register_model(_RowsInGroup)
@register_model(_RowInGroup)
class _GroupModel(models.PrimitiveModel):
    """Represents rows in eight lanes in machine code as a pointer."""

    def __init__(self, manager: Any, numba_type: Any) -> None:
        super().__init__(manager, numba_type, ir.IntType(8).as_pointer())


_EQUAL_IN_ALL_RUNS = ("prismatic",)
"""Integer fields that are equal in all runs of a structure, so that code may branch on them."""


def _vector_of(field: LaneField) -> LaneVector:
    """Returns the `LaneVector` for the values of a field."""
    return FLOATS if field.kind == "f8" else INTEGERS


@infer_getattr
class _RowAttributes(AttributeTemplate):
    """Tells Numba the type of `row.field` for a row in eight lanes."""

    key = _RowInGroup

    def generic_resolve(self, row: _RowInGroup, name: str) -> Any:
        if row.find_constant(name) is not None:
            return types.int64
        field = row.find_field(name)
        if field is None:
            return None
        if name in _EQUAL_IN_ALL_RUNS:
            return types.int64
        vector = _vector_of(field)
        if not field.shape:
            return vector
        return types.Array(vector, len(field.shape), "A", aligned=False)


@infer_getattr
class _RowsAttributes(AttributeTemplate):
    """Tells Numba the type of `rows.shape`, which is (count,), for rows in eight lanes."""

    key = _RowsInGroup

    def resolve_shape(self, _rows: _RowsInGroup) -> Any:
        return types.UniTuple(types.intp, 1)


def _find_numbers(builder: Any, pointer: Any, field: LaneField) -> Any:
    """Generates LLVM code for the address of a field's first vector."""
    numbers = offset_rows(builder, pointer, field.first_word)
    return builder.bitcast(numbers, _LLVM_KINDS[_vector_of(field).kind].as_pointer())


@lower_getattr_generic(_RowInGroup)
def _read_field(context: Any, builder: Any, row_type: _RowInGroup, row: Any, name: str) -> Any:
    """Generates LLVM code that reads `row.field` of a row in eight lanes (runs) at once.

    Numba calls this function when it compiles such an expression. The result is a constant if
    the field is equal in all lanes, otherwise a vector of eight elements for a scalar field,
    and an array of such vectors for any other field.

    Args:
        context: Numba's compilation context.
        builder: Builder that appends LLVM instructions.
        row_type: Numba type of the row.
        row: The row, as an LLVM value.
        name: Name of the field.
    """
    constant = row_type.find_constant(name)
    if constant is not None:
        return context.get_constant(types.int64, constant)
    field = row_type.find_field(name)
    assert field is not None
    data = _find_numbers(builder, row, field)
    if name in _EQUAL_IN_ALL_RUNS:
        return builder.load(builder.bitcast(data, _WORD_TYPE.as_pointer()))
    if not field.shape:
        return builder.load(data, align=_WORD)

    array_type = types.Array(_vector_of(field), len(field.shape), "A", aligned=False)
    return make_view(context, builder, array_type, data, field.shape, GROUP * _WORD)


@lower_setattr_generic(_RowInGroup)
def _write_field(context: Any, builder: Any, sig: Any, args: Any, name: str) -> None:
    """Generates LLVM code that writes a vector to `row.field`."""
    row_type, value_type = sig.args
    field = row_type.find_field(name)
    value = context.cast(builder, args[1], value_type, _vector_of(field))
    builder.store(value, _find_numbers(builder, args[0], field), align=_WORD)


@lower_getattr_generic(_RowsInGroup)
def _read_shape(context: Any, builder: Any, rows: _RowsInGroup, _value: Any, _name: str) -> Any:
    """Generates LLVM code for `rows.shape` of rows in eight lanes, which is a constant."""
    count = context.get_constant(types.intp, len(rows.constants))
    return context.make_tuple(builder, types.UniTuple(types.intp, 1), [count])


@infer_global(operator.getitem)
class _RowsItem(AbstractTemplate):
    """Tells Numba the type of `rows[index]` if all rows have the same constants."""

    def generic(self, args: Any, _keywords: Any) -> Any:
        rows, index = args
        if not isinstance(rows, _RowsInGroup) or not isinstance(index, types.Integer):
            return None
        if len(set(rows.constants)) > 1:
            return None
        return signature(_RowInGroup(rows, rows.constants[:1]), rows, types.intp)


@lower_builtin(operator.getitem, _RowsInGroup, types.Integer)
def _get_item(_context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Generates LLVM code for `rows[index]`."""
    row_bytes = ir.Constant(args[1].type, sig.args[0].row_length * LANES * _WORD)
    offset = builder.mul(args[1], row_bytes)
    return builder.gep(args[0], [offset], source_etype=ir.IntType(8))


@intrinsic
def _in_group(_context: Any, table: Any, _group: Any) -> Any:
    """Generates LLVM code for the rows of eight adjacent runs (lanes) in a shared array."""
    assert isinstance(table, LaneTable)
    rows_type = _RowsInGroup(table, table.constants)

    def generate(_target: Any, builder: Any, _signature: Any, args: Any) -> Any:
        offset = builder.mul(args[1], ir.Constant(args[1].type, GROUP * _WORD))
        return builder.gep(args[0], [offset], source_etype=ir.IntType(8))

    return rows_type(table, types.intp), generate


in_group: Any = _in_group
"""Returns the rows of a table in lanes 8 g to 8 g + 7: `in_group(table, g)`."""

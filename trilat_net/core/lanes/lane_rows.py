# mypy: disallow-untyped-calls=False, disallow-untyped-decorators=False
# mypy: disable-error-code="no-any-return, override"
"""Stores the states of several runs side by side, for loops with vector instructions.

The state of an arm in one run is a row of values (`row_fields`). In lanes, each of them becomes
`LANES` values that are adjacent in memory, one per run. The first joint angles of all runs, for
example, are stored next to each other, so one instruction loads several of them. The position
of a run among the others is called its lane.

The functions of a control period receive an object that represents the row of one lane, and has
the same fields as the row of a single run. No function therefore needs a second version.

Fields that are equal in all lanes, such as the type of control law, can be constants. The
compiler then removes the branches for other values.

Invariant:
    - A row in a lane has the same fields, shapes and types as a row of a single run.
    - Every property on which compiled code depends is part of a type name. These names are part
      of the key under which the code is stored.
"""

import hashlib
import operator
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.extending import intrinsic, models, register_model
from numba.core.imputils import lower_builtin, lower_getattr_generic, lower_setattr_generic
from numba.core.typing.templates import (
    AbstractTemplate,
    AttributeTemplate,
    infer_getattr,
    infer_global,
    signature,
)
from numba.np import arrayobj
from numpy.typing import NDArray

LANES = 64
"""Number of lanes, which is the largest number of runs that are computed together.

A vector register holds at most eight values. With several registers per quantity, the processor
can compute one while waiting for the others.
"""
_WORD = 8
"""Size of each value in a row, bytes."""
_ALIGNMENT = 64
"""Size of a vector register and of a cache line, bytes."""
_NUMBA_KINDS = {"i8": types.int64, "f8": types.float64, "u8": types.uint64}

Words = NDArray[np.int64]
"""Rows in lanes as 64-bit words, shape (rows, words per row, LANES)."""
Constants = tuple[tuple[str, int], ...]
"""Names and values of the fields that are equal in all lanes."""


class LaneField(NamedTuple):
    """One field of a row (the state of one arm in one run), with its position in the row.

    All values in a row are eight bytes long.

    Attributes:
        name: Name of the field.
        kind: Element type: "i8", "f8" or "u8".
        first_word: Index of its first value in a row of a single run.
        shape: Shape of the field in a row of a single run, or () for a scalar.
    """

    name: str
    kind: str
    first_word: int
    shape: tuple[int, ...]


class LaneTable(types.Type):
    """Numba type of an array with the states of an arm in several runs side by side.

    The state in one run is a row of values with named fields. Each run has a lane: a value of
    the row becomes `LANES` adjacent values, one per run. In machine code, an instance of this
    type is a pointer to the first value of the array.

    Args:
        dtype: Data type of a row of a single run, whose values must all have 64 bits.
        constants: For each row, the fields that are equal in all lanes.
    """

    in_lanes = True

    def __init__(self, dtype: np.dtype[Any], constants: tuple[Constants, ...] = ((),)) -> None:
        fields = []
        assert dtype.fields is not None
        for name, (field_dtype, offset, *_) in dtype.fields.items():
            kind = field_dtype.base.str[1:]
            fields.append(LaneField(name, kind, offset // _WORD, field_dtype.shape))
        self.fields = tuple(fields)
        self.row_length = dtype.itemsize // _WORD
        self.constants = constants
        super().__init__(f"{type(self).__name__}({self.fields}, {constants}, {LANES})")

    @property
    def mangling_args(self) -> tuple[str, tuple[str]]:
        """Form of this type that Numba uses in the names of compiled functions.

        The full name of the type contains characters that are not allowed there.
        """
        digest = hashlib.sha256(self.name.encode()).hexdigest()
        return type(self).__name__, (f"l{digest[:16]}",)

    @property
    def count(self) -> int:
        """Number of records of one run, each of which has its own constant fields.

        A field is constant if it is the same in all simulated runs (lanes), for example the
        type of a network link. The compiler knows the constant fields.
        """
        return len(self.constants)


class _PartOfTable(LaneTable):
    """Numba type of some rows of a `LaneTable` in one lane."""

    def __init__(self, table: LaneTable, constants: tuple[Constants, ...]) -> None:
        self.fields = table.fields
        self.row_length = table.row_length
        self.constants = constants
        types.Type.__init__(self, f"{type(self).__name__}({self.fields}, {constants}, {LANES})")


class RowType(types.Type):
    """Base class of the Numba types of a record in lanes, whose fields are found by name.

    Attributes:
        fields: Fields of the record.
        constants: Tuple whose only entry contains the fields that are equal in all lanes.
    """

    fields: tuple[LaneField, ...]
    constants: tuple[Constants, ...]

    def find_field(self, name: str) -> LaneField | None:
        """Looks up the position and type of a field of the record, such as "q".

        Returns None if the record has no such field.
        """
        return next((field for field in self.fields if field.name == name), None)

    def find_constant(self, name: str) -> int | None:
        """Returns the value of a field that is the same in all runs and known to the compiler.

        The compiler then inserts the value into the machine code, and removes branches that the
        value rules out. Returns None if the field can differ between runs.
        """
        return dict(self.constants[0]).get(name)


class RowsInLane(_PartOfTable):
    """Numba type of an array of records of one simulation, for example of all links of a site.

    Several runs are simulated side by side, with one run per lane. Corresponding values of all
    runs are adjacent in memory, and this type selects those of a single run.
    """


class LaneRow(RowType, _PartOfTable):
    """Numba type of one record of one simulation, whose fields compiled code reads by name.

    Several runs are simulated side by side, with corresponding values of all runs adjacent in
    memory. This type hides that memory layout, so the same source code also works for a run
    that is simulated alone.
    """


class LaneNumbers(types.Type):
    """Numba type of an array with one integer per run, for runs simulated side by side.

    An example is the current tick of each run. In machine code, a value of this type is a
    pointer to the first integer.
    """

    in_lanes = True

    def __init__(self) -> None:
        super().__init__(f"LaneNumbers({LANES})")

    @property
    def mangling_args(self) -> tuple[str, tuple[str]]:
        """Form of this type that Numba uses in the names of compiled functions."""
        return "LaneNumbers", (f"n{LANES}",)


@register_model(LaneNumbers)
@register_model(LaneTable)
class _TableModel(models.PrimitiveModel):
    """Represents a `LaneTable` in machine code as a pointer."""

    def __init__(self, manager: Any, numba_type: Any) -> None:
        super().__init__(manager, numba_type, ir.IntType(8).as_pointer())


@register_model(RowsInLane)
@register_model(LaneRow)
class _RowModel(models.StructModel):
    """Represents rows in a lane in machine code as a pointer and the index of the lane."""

    def __init__(self, manager: Any, numba_type: Any) -> None:
        members = [("pointer", types.voidptr), ("lane", types.intp)]
        super().__init__(manager, numba_type, members)


def _offset_pointer(builder: Any, pointer: Any, offset: Any) -> Any:
    """Generates LLVM code that adds a byte offset to a pointer."""
    return builder.gep(pointer, [offset], source_etype=ir.IntType(8))


def offset_rows(builder: Any, pointer: Any, word_count: int) -> Any:
    """Generates LLVM code for the address a given number of words after a pointer.

    The rows of several runs are stored side by side, so each word of a row takes up the space
    of `LANES` words in memory.

    Args:
        builder: Builder that appends LLVM instructions.
        pointer: The pointer.
        word_count: Distance from the pointer in a row of a single run, in 64-bit words.
    """
    word = ir.IntType(64)
    return _offset_pointer(builder, pointer, ir.Constant(word, word_count * LANES * _WORD))


@infer_getattr
class _RowAttributes(AttributeTemplate):
    """Tells Numba the type of `row.field` for a row in a lane."""

    key = LaneRow

    def generic_resolve(self, row: LaneRow, name: str) -> Any:
        if row.find_constant(name) is not None:
            return types.int64
        field = row.find_field(name)
        if field is None:
            return None
        kind = _NUMBA_KINDS[field.kind]
        return types.Array(kind, len(field.shape), "A") if field.shape else kind


@infer_getattr
class _RowsAttributes(AttributeTemplate):
    """Tells Numba the type of `rows.shape`, which is (count,), for rows in a lane."""

    key = RowsInLane

    def resolve_shape(self, _rows: RowsInLane) -> Any:
        return types.UniTuple(types.intp, 1)


def _find_number(
    context: Any, builder: Any, row_type: LaneRow, row_value: Any, field: LaneField
) -> Any:
    """Generates LLVM code for the address of a field's first value in a lane."""
    row = cgutils.create_struct_proxy(row_type)(context, builder, value=row_value)
    word = row.lane.type
    in_lane = builder.mul(row.lane, ir.Constant(word, _WORD))
    offset = builder.add(ir.Constant(word, field.first_word * LANES * _WORD), in_lane)
    pointer = _offset_pointer(builder, row.pointer, offset)
    number_type = context.get_data_type(_NUMBA_KINDS[field.kind])
    return builder.bitcast(pointer, number_type.as_pointer())


def make_view(
    context: Any,
    builder: Any,
    array_type: types.Array,
    data: Any,
    shape: tuple[int, ...],
    itemsize: int,
) -> Any:
    """Generates LLVM code for an array that views a row's field in one lane, or in several.

    Successive elements of the field are `LANES` values apart in memory.

    Args:
        context: Numba's compilation context.
        builder: Builder that appends LLVM instructions.
        array_type: Numba type of the array.
        data: Pointer to the first element, as an LLVM value.
        shape: Shape of the field.
        itemsize: Size of an array element, bytes.
    """
    strides: list[int] = []
    step = LANES * _WORD
    for length in reversed(shape):
        strides.insert(0, step)
        step *= length

    def pack(numbers: Any) -> Any:
        constants = [context.get_constant(types.intp, number) for number in numbers]
        return cgutils.pack_array(builder, constants)

    view = context.make_array(array_type)(context, builder)
    arrayobj.populate_array(
        view,
        data=data,
        shape=pack(shape),
        strides=pack(strides),
        itemsize=context.get_constant(types.intp, itemsize),
        meminfo=None,
    )
    return view._getvalue()


@lower_getattr_generic(LaneRow)
def _read_field(context: Any, builder: Any, row_type: LaneRow, row: Any, name: str) -> Any:
    """Generates LLVM code that reads a field of a record of one simulation, as `row.field`.

    Numba calls this function when it compiles such an expression. Several runs are simulated
    side by side, with one run per lane. The result is a constant if the field is equal in all
    lanes, otherwise a scalar for a scalar field, and an array for any other field. The elements
    of this array are `LANES` values apart in memory.

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
    data = _find_number(context, builder, row_type, row, field)
    if not field.shape:
        return builder.load(data)

    array_type = types.Array(_NUMBA_KINDS[field.kind], len(field.shape), "A")
    return make_view(context, builder, array_type, data, field.shape, _WORD)


@lower_setattr_generic(LaneRow)
def _write_field(context: Any, builder: Any, sig: Any, args: Any, name: str) -> None:
    """Generates LLVM code that writes a value to `row.field`."""
    row_type, value_type = sig.args
    row, value = args
    field = row_type.find_field(name)
    data = _find_number(context, builder, row_type, row, field)
    kind = _NUMBA_KINDS[field.kind]
    builder.store(context.cast(builder, value, value_type, kind), data)


@lower_getattr_generic(RowsInLane)
def _read_shape(context: Any, builder: Any, rows: RowsInLane, _value: Any, _name: str) -> Any:
    """Generates LLVM code for `rows.shape` of rows in a lane, which is a constant."""
    count = context.get_constant(types.intp, rows.count)
    return context.make_tuple(builder, types.UniTuple(types.intp, 1), [count])


def _find_row(
    context: Any,
    builder: Any,
    rows_type: RowsInLane,
    rows_value: Any,
    index: Any,
    row_type: Any,
) -> Any:
    """Generates LLVM code for `rows[index]`: one record of one of several simulations.

    Args:
        context: Numba's compilation context.
        builder: Builder that appends LLVM instructions.
        rows_type: Numba type of the rows.
        rows_value: The rows, as an LLVM value.
        index: The index, as an LLVM value.
        row_type: Numba type of the row.
    """
    rows = cgutils.create_struct_proxy(rows_type)(context, builder, value=rows_value)
    row = cgutils.create_struct_proxy(row_type)(context, builder)
    row_bytes = ir.Constant(index.type, rows_type.row_length * LANES * _WORD)
    row.pointer = _offset_pointer(builder, rows.pointer, builder.mul(index, row_bytes))
    row.lane = rows.lane
    return row._getvalue()


@infer_global(operator.getitem)
class _RowsItem(AbstractTemplate):
    """Tells Numba the type of `rows[index]` if all rows have the same constants."""

    def generic(self, args: Any, _keywords: Any) -> Any:
        rows, index = args
        if not isinstance(rows, RowsInLane) or not isinstance(index, types.Integer):
            return None
        if len(set(rows.constants)) > 1:
            return None
        constants = rows.constants[:1] or ((),)
        return signature(LaneRow(rows, constants), rows, types.intp)


@lower_builtin(operator.getitem, RowsInLane, types.Integer)
def _get_item(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Generates LLVM code for `rows[index]`."""
    return _find_row(context, builder, sig.args[0], args[0], args[1], sig.return_type)


@infer_global(len)
class _RowsLength(AbstractTemplate):
    """Tells Numba the type of `len(rows)`."""

    def generic(self, args: Any, _keywords: Any) -> Any:
        (rows,) = args
        return signature(types.intp, rows) if isinstance(rows, RowsInLane) else None


@lower_builtin(len, RowsInLane)
def _get_length(context: Any, _builder: Any, sig: Any, _args: Any) -> Any:
    """Generates LLVM code for `len(rows)`, which is a constant."""
    return context.get_constant(types.intp, sig.args[0].count)


@intrinsic
def _in_lane(_context: Any, table: Any, _lane: Any) -> Any:
    """Generates LLVM code for the rows of an array that belong to one lane."""
    rows_type = RowsInLane(table, table.constants)

    def generate(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        rows = cgutils.create_struct_proxy(rows_type)(context, builder)
        rows.pointer, rows.lane = args
        return rows._getvalue()

    return rows_type(table, types.intp), generate


@intrinsic(prefer_literal=True)
def _select_row(_context: Any, rows: Any, index: Any) -> Any:
    """Generates LLVM code for `rows[index]` with a constant index.

    With a constant index, the compiler knows the constant fields of this record (row), such as
    the type of an operator, and can remove the branches for other types.
    """
    if not isinstance(index, types.IntegerLiteral):
        return None
    number = index.literal_value
    row_type = LaneRow(rows, rows.constants[number : number + 1])

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        position = context.get_constant(types.intp, number)
        return _find_row(context, builder, sig.args[0], args[0], position, sig.return_type)

    return row_type(rows, index), generate


@intrinsic
def _number_of(_context: Any, numbers: Any, _lane: Any) -> Any:
    """Generates LLVM code for an integer of one lane, such as its current tick.

    The first argument is either an array with one integer per lane, or a single integer shared
    by all lanes.
    """

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        numbers_type = sig.args[0]
        data, lane = args
        if isinstance(numbers_type, types.Integer):
            return data
        if isinstance(numbers_type, types.Array):
            data = context.make_array(numbers_type)(context, builder, data).data
        word = ir.IntType(64)
        first = builder.bitcast(data, word.as_pointer())
        return builder.load(builder.gep(first, [lane], source_etype=word))

    return types.int64(numbers, types.intp), generate


@intrinsic
def _pointer_to(_context: Any, address: Any) -> Any:
    """Generates LLVM code that converts an address to a pointer."""

    def generate(_target: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.inttoptr(args[0], ir.IntType(8).as_pointer())

    return types.voidptr(address), generate


# Compiled code calls these functions without the first argument of their definitions.
in_lane: Any = _in_lane
"""Returns the rows of a table in one lane: `in_lane(table, lane)`."""
select_row: Any = _select_row
"""Returns a row with its own constants: `select_row(rows, index)`, for a constant index."""
number_of: Any = _number_of
"""Returns the integer of a lane: `number_of(numbers, lane)`.

`numbers` is either a `LaneNumbers` array with one entry per lane, or an integer shared by all
lanes.
"""
pointer_to: Any = _pointer_to
"""Converts the address of a table to a pointer, which represents the table in calls."""


def allocate_words(rows: int, row_length: int) -> Words:
    """Allocates a zero-filled array for the states of several runs side by side.

    The shape is (rows, values per row, LANES), with one lane per run. The array is aligned to a
    cache line, because vector instructions read an aligned array faster.

    Args:
        rows: Number of rows.
        row_length: Number of values in a row of a single run.
    """
    count = rows * row_length * LANES
    room = np.zeros(count + _ALIGNMENT // _WORD, np.int64)
    first = -room.ctypes.data // _WORD % (_ALIGNMENT // _WORD)
    return room[first : first + count].reshape(rows, row_length, LANES)


def read_words(rows: NDArray[Any]) -> Words:
    """Returns the values of structured records as integers with the same bits ("words").

    The same code can then copy values of any type. The shape is (rows, words per row).

    Args:
        rows: Structured array of the rows, shape (rows,).
    """
    row_length = rows.dtype.itemsize // _WORD
    return np.ascontiguousarray(rows).view(np.int64).reshape(len(rows), row_length)

"""Columns of Arrow tables, whichever of Arrow's types their writer chose for the same values.

pandas, polars, DuckDB and LeRobot's own tools write equal values as different types: text as
`string`, `large_string` or a dictionary, vectors as lists of fixed or any length, whole numbers in
any width. Here each has one *simple type*, to which the others are cast.
"""

from collections.abc import Sequence

import pyarrow as pa
import pyarrow.compute as pc

_FLOATS = (pa.float16(), pa.float32(), pa.float64())
_WHOLE = (pa.int8(), pa.int16(), pa.int32(), pa.int64())
_UNSIGNED = (pa.uint8(), pa.uint16(), pa.uint32(), pa.uint64())
_TEXTS = (pa.string(), pa.large_string(), pa.string_view())
_BYTES = (pa.binary(), pa.large_binary(), pa.binary_view())
_SIMPLE = {
    pa.null(): pa.null(),
    pa.bool_(): pa.bool_(),
    **dict.fromkeys(_FLOATS, pa.float64()),
    **dict.fromkeys((*_WHOLE, *_UNSIGNED), pa.int64()),
    **dict.fromkeys(_TEXTS, pa.string()),
    **dict.fromkeys(_BYTES, pa.binary()),
}
"""The simple type of each type without parts."""


def is_listed(kind: pa.DataType) -> bool:
    """Return whether a type is one of Arrow's lists."""
    return bool(
        pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)
    )


def is_text(kind: pa.DataType) -> bool:
    """Return whether a type is text, in a dictionary or not."""
    return simple_type(kind) == pa.string()


def is_number(kind: pa.DataType) -> bool:
    """Return whether a type is a whole or other number."""
    return simple_type(kind) in (pa.int64(), pa.float64())


def is_whole(kind: pa.DataType) -> bool:
    """Return whether a type is a whole number."""
    return simple_type(kind) == pa.int64()


def is_plain(kind: pa.DataType) -> bool:
    """Return whether a type is text, bytes, number, bool, or a list or struct of these."""
    return simple_type(kind) is not None


def simple_type(kind: pa.DataType) -> pa.DataType | None:
    """Return the simple type of a type; None if it is not plain, such as a time or a map."""
    if isinstance(kind, pa.BaseExtensionType):
        return simple_type(kind.storage_type)
    if pa.types.is_dictionary(kind):
        return simple_type(kind.value_type)
    if is_listed(kind):
        item = simple_type(kind.value_type)
        return None if item is None else pa.list_(item)
    if pa.types.is_struct(kind):
        fields = {field.name: simple_type(field.type) for field in kind}
        # Two fields of one name cannot become a dict.
        unique = len(fields) == kind.num_fields
        return pa.struct(fields) if unique and None not in fields.values() else None
    return pa.float64() if pa.types.is_decimal(kind) else _SIMPLE.get(kind)


def simplified(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Return a column of a plain type in its simple type.

    Raises:
        pa.ArrowException: A value has no equal in it, such as a whole number of over 63 bits.
    """
    column = _stored(column)
    simple = simple_type(column.type)
    return column if column.type == simple else pc.cast(column, simple)


def _stored(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Return the values that a column of an extension type stores."""
    kind = column.type
    if not isinstance(kind, pa.BaseExtensionType):
        return column
    return pa.chunked_array([chunk.storage for chunk in column.chunks], kind.storage_type)


def concatenated(tables: Sequence[pa.Table]) -> pa.Table:
    """Return the rows of tables whose columns may differ in order, type and number.

    A column that a table lacks is empty in its rows.

    Raises:
        pa.ArrowException: A column has values of different kinds, such as text and numbers.
    """
    if all(table.schema.equals(tables[0].schema) for table in tables[1:]):
        return pa.concat_tables(tables)
    simple = [
        pa.table({name: simplified(table[name]) for name in table.column_names}) for table in tables
    ]
    return pa.concat_tables(simple, promote_options="permissive")

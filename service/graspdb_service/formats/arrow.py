"""Arrow IPC streams: columns in and out without a Python object a value.

Reading trusts nothing: a stream is checked message by message before its arrays are touched, and compressed
buffers are refused, for a few bytes of them may claim any amount of memory.
"""

from __future__ import annotations

import importlib
import io
import struct
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from graspdb.wire import OUTCOMES
from graspdb_service.problems import ProblemError, invalid, invalid_fields
from graspdb_service.trial_columns import Bools, Floats, Ints

#: Key of the schema's metadata that holds, as JSON, what else a request or an answer says.
METADATA = b"graspdb"

#: Whole numbers up to here are floats as well.
_WHOLE = 2**53
_LAST_MICROSECOND = 253_402_300_799_999_999
_INSTALL = "pip install 'graspdb[service,arrow]' where the service runs"


def library() -> Any:
    """The pyarrow package, which is an extra: 406 where it is not installed."""
    try:
        return importlib.import_module("pyarrow")
    except ImportError:
        raise ProblemError(
            406,
            "arrow-not-installed",
            f"This service was installed without Arrow: use JSON, or install it ({_INSTALL})",
        ) from None


# -- in ------------------------------------------------------------------------------------------------------


class Table:
    """The columns of a stream from a request, called ``prefix`` and their name in errors.

    ``family`` names a struct of columns, or the part before the dot of any number of them. 415 without
    pyarrow; 422 for what is no stream, or for other than these columns.
    """

    def __init__(
        self, body: bytes, columns: Iterable[str], *, prefix: str = "columns", family: str | None = None
    ) -> None:
        self._prefix = prefix
        try:
            pa = library()
        except ProblemError as error:
            raise ProblemError(415, error.kind, error.title) from None
        try:
            _check_messages(pa, body)
            with pa.ipc.open_stream(pa.py_buffer(body)) as stream:
                table = stream.read_all()
            table.validate(full=True)
        except (
            pa.ArrowException,
            ValueError,
            TypeError,
            LookupError,
            EOFError,
            OSError,
            struct.error,
        ) as error:
            raise invalid("body", f"not a valid Arrow IPC stream: {str(error)[:200]}") from None
        self._pa, self._table = pa, table if family is None else _spread(pa, table, family)
        self.count: int = table.num_rows
        self.names: list[str] = list(self._table.column_names)
        known = set(columns) - {family}
        wrong = [
            name
            for name, number in Counter(self.names).items()
            if number > 1 or (name not in known and not (family and name.startswith(f"{family}.")))
        ]
        if wrong:
            told = f"unknown or repeated; there are {', '.join(sorted(known))}"
            raise invalid_fields(
                [(f"{prefix}.{name[:80]}", told) for name in sorted(set(wrong))[:20]],
                "The stream has columns that are not known, or one twice",
            )

    @property
    def options(self) -> dict[str, Any]:
        """What stands beside the columns: the JSON object in the schema's metadata."""
        text = (self._table.schema.metadata or {}).get(METADATA, b"{}")
        try:
            options = orjson.loads(text)
        except orjson.JSONDecodeError as error:
            raise invalid("metadata.graspdb", f"not valid JSON: {error}") from None
        if not isinstance(options, dict):
            raise invalid("metadata.graspdb", "must be a JSON object")
        return options

    def column(self, name: str) -> Any:
        """A column as one array; None where the stream has none, or only nulls."""
        if name not in self.names:
            return None
        column = self._table[name]
        if column.null_count == len(column):
            return None
        # Dictionaries are never decoded: many rows may share one huge value.
        return self._pa.concat_arrays(column.unify_dictionaries().chunks)

    def required(self, name: str) -> Any:
        """As :meth:`column`, without nulls; 422 where it is missing, or naming the first null."""
        column = self.column(name)
        if column is None:
            raise self._wrong(name, "required")
        if column.null_count:
            self.fault(name, int(np.flatnonzero(_numpy(column.is_null()))[0]), "required")
        return column

    def vectors(self, name: str, width: int) -> Floats:
        """(n, width) finite numbers of a column of lists; 422 naming the first row that is none."""
        pa, column = self._pa, self.required(name)
        kind = column.type
        fixed = pa.types.is_fixed_size_list(kind)
        lists = fixed or pa.types.is_list(kind) or pa.types.is_large_list(kind)
        if not lists or not (pa.types.is_floating(kind.value_type) or pa.types.is_integer(kind.value_type)):
            raise self._wrong(name, f"lists of {width} numbers; this column is {kind}")
        if fixed and kind.list_size != width:
            raise self._wrong(name, f"lists of {width} numbers, not of {kind.list_size}")
        if not fixed:
            sizes = column.value_lengths().to_numpy()
            wrong = np.flatnonzero(sizes != width)
            if wrong.size:
                self.fault(name, int(wrong[0]), f"a list of {width} numbers")
        flat = column.flatten()
        if flat.null_count:
            null = np.flatnonzero(_numpy(flat.is_null()))[0]
            self.fault(name, int(null) // width, f"a list of {width} numbers")
        values = self._doubles(name, flat, width).reshape(-1, width)
        bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if bad.size:
            self.fault(name, int(bad[0]), "every number must be finite")
        return np.asarray(values)

    def scalars(self, name: str) -> Floats | None:
        """(n,) finite numbers, NaN for null, else 422; None where the column is absent."""
        pa, column = self._pa, self.column(name)
        if column is None:
            return None
        if not (pa.types.is_floating(column.type) or pa.types.is_integer(column.type)):
            raise self._wrong(name, f"numbers or nulls; this column is {column.type}")
        null, values = _numpy(column.is_null()), self._doubles(name, column)
        bad = np.flatnonzero(~null & ~np.isfinite(values))
        if bad.size:
            self.fault(name, int(bad[0]), "a finite number or null")
        return np.asarray(np.where(null, np.nan, values))

    def texts(self, name: str) -> tuple[list[str], Ints] | None:
        """Distinct texts of a column, and which of them each row has (-1: null); None where it is absent."""
        pa, column = self._pa, self.column(name)
        if column is None:
            return None
        coded = pa.types.is_dictionary(column.type)
        kind = column.type.value_type if coded else column.type
        if not (pa.types.is_string(kind) or pa.types.is_large_string(kind)):
            raise self._wrong(name, f"text; this column is {column.type}")
        encoded = column if coded else column.dictionary_encode()
        indices = _numpy(encoded.indices.fill_null(-1)).astype(np.int64)
        return encoded.dictionary.to_pylist(), indices

    def objects(self, name: str) -> list[Any] | None:
        """A column as Python objects, None for null; None where it is absent.

        422 for a type of which a few bytes may stand for much: dictionaries, views, runs.
        """
        pa, column = self._pa, self.column(name)
        if column is None:
            return None
        if not _plain(pa, column.type):
            raise self._wrong(name, f"plain lists, structs, text or times; it is {column.type}")
        try:
            if pa.types.is_timestamp(column.type):
                column = self._microseconds(name, column)
            found: list[Any] = column.to_pylist()
        # A time zone that nobody knows is a LookupError.
        except (ValueError, OverflowError, LookupError) as error:
            raise self._wrong(name, str(error)[:200]) from None
        return found

    def _microseconds(self, name: str, column: Any) -> Any:
        """Times in the unit that they are stored in; 422 naming the first that none of it is."""
        pa = self._pa
        ticks = _numpy(column.cast(pa.int64()).fill_null(0))
        each = {"s": 10**6, "ms": 10**3}.get(column.type.unit, 1)
        parts = 1000 if column.type.unit == "ns" else 1
        lost = np.flatnonzero(ticks % parts)
        if lost.size:
            self.fault(name, int(lost[0]), "times are stored in microseconds: round it to them")
        last = _LAST_MICROSECOND // each
        far = np.flatnonzero((ticks // parts > last) | (ticks // parts < -last))
        if far.size:
            self.fault(name, int(far[0]), "a time between the years 1900 and 2500")
        return column.cast(pa.timestamp("us", column.type.tz))

    def _doubles(self, name: str, column: Any, width: int = 1) -> Floats:
        """Numbers as float64, NaN for null; 422 naming the first row that has one it can't hold."""
        values = _numpy(column)
        if np.issubdtype(values.dtype, np.integer):
            long = np.flatnonzero((values > _WHOLE) | (values < -_WHOLE))
            if long.size:
                self.fault(name, int(long[0]) // width, "a whole number beyond 2^53 is no float64")
        return np.asarray(values, dtype=np.float64)

    def booleans(self, name: str) -> Bools | None:
        """(n,) where a column holds true and false; None where it holds something else."""
        column = self.required(name)
        if not self._pa.types.is_boolean(column.type):
            return None
        return np.asarray(_numpy(column), dtype=np.bool_)

    def fault(self, name: str, row: int, message: str) -> None:
        """Raise a 422 that names a row of a column."""
        raise self._wrong(f"{name}.{row}", message)

    def _wrong(self, name: str, message: str) -> ProblemError:
        return invalid(f"{self._prefix}.{name}", message)


def _spread(pa: Any, table: Any, family: str) -> Any:
    """The table with the fields of a struct as columns ``family.field``."""
    if family not in table.column_names or table.column_names.count(family) > 1:
        return table
    place = table.column_names.index(family)
    kind = table.schema.types[place]
    if not pa.types.is_struct(kind):
        return table
    for field, values in zip(kind, table.column(place).flatten(), strict=True):
        table = table.append_column(f"{family}.{field.name}", values)
    return table.remove_column(place)


def _numpy(column: Any) -> NDArray[Any]:
    values: NDArray[Any] = column.to_numpy(zero_copy_only=False)
    return values


def _plain(pa: Any, kind: Any) -> bool:
    """Whether values of a type take about as much memory as they do in a stream."""
    types = pa.types
    if types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind):
        return _plain(pa, kind.value_type)
    if types.is_struct(kind):
        return all(_plain(pa, field.type) for field in kind)
    texts, numbers = (types.is_string, types.is_large_string), (types.is_floating, types.is_integer)
    return any(fits(kind) for fits in (*texts, *numbers, types.is_boolean, types.is_timestamp))


def _check_messages(pa: Any, body: bytes) -> None:
    """Refuse a stream with compressed buffers (ValueError; for no stream, what pyarrow or struct say)."""
    for message in pa.ipc.MessageReader.open_stream(pa.py_buffer(body)):
        if message.type in ("record batch", "dictionary") and _compressed(message.metadata.to_pybytes()):
            raise ValueError("its buffers are compressed: write it without compression")


def _compressed(metadata: bytes) -> bool:
    """Whether a message's record batch names a compression (Message.fbs of the Arrow format, version 5)."""
    message = _u32(metadata, 0)
    header = _field(metadata, message, 2)
    batch = header + _u32(metadata, header)
    if metadata[_field(metadata, message, 1)] == 2:
        data = _field(metadata, batch, 1)
        batch = data + _u32(metadata, data)
    return _field(metadata, batch, 3) != 0


def _field(content: bytes, table: int, number: int) -> int:
    """Where a field of a flatbuffer's table lies; 0 where the table has none."""
    (back,) = struct.unpack_from("<i", content, table)
    vtable = table - back
    (size,) = struct.unpack_from("<H", content, vtable)
    at = 4 + 2 * number
    if at >= size:
        return 0
    (offset,) = struct.unpack_from("<H", content, vtable + at)
    return table + offset if offset else 0


def _u32(content: bytes, at: int) -> int:
    (value,) = struct.unpack_from("<I", content, at)
    return int(value)


# -- out -----------------------------------------------------------------------------------------------------


def stream(schema: Any, batches: Iterable[Any]) -> Iterator[bytes]:
    """An IPC stream piece by piece, for however many batches."""
    sink = io.BytesIO()

    def taken() -> bytes:
        content = sink.getvalue()
        sink.seek(0)
        sink.truncate()
        return content

    with library().ipc.new_stream(sink, schema) as writer:
        yield taken()
        for batch in batches:
            writer.write_batch(batch)
            yield taken()
    yield taken()


def schema_of(fields: Sequence[tuple[str, Any]], told: Mapping[str, Any] | None = None) -> Any:
    """A schema of named types, with what else is said in its metadata."""
    metadata = None if told is None else {METADATA: orjson.dumps(told)}
    return library().schema(fields, metadata=metadata)


def record_batch(columns: Mapping[str, Any], told: Mapping[str, Any]) -> Any:
    """Columns as a record batch, with what else is said in its schema's metadata."""
    return library().RecordBatch.from_pydict(columns, metadata={METADATA: orjson.dumps(told)})


def vectors(values: Floats, width: int) -> Any:
    """A column of fixed-size lists from (n, width)."""
    pa = library()
    flat = pa.array(np.ascontiguousarray(values, dtype=np.float64).reshape(-1))
    return pa.FixedSizeListArray.from_arrays(flat, width)


def vector_type(width: int) -> Any:
    """The type of :func:`vectors`."""
    pa = library()
    return pa.list_(pa.float64(), width)


def numbers(values: Any) -> Any:
    """A column of numbers, null where one is not finite."""
    column = np.ascontiguousarray(values, dtype=np.float64)
    return library().array(column, mask=~np.isfinite(column))


def outcome_names(codes: NDArray[np.uint8]) -> Any:
    """A column of outcomes' names, each stored once."""
    pa = library()
    return pa.DictionaryArray.from_arrays(pa.array(codes.astype(np.int8)), pa.array(OUTCOMES))


def outcome_type() -> Any:
    """The type of :func:`outcome_names`."""
    pa = library()
    return pa.dictionary(pa.int8(), pa.string())

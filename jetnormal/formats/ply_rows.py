"""The rows of one PLY element: arrays where all properties are scalar, row by row where there are lists."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from jetnormal.errors import InputError
from jetnormal.formats.columns import Columns
from jetnormal.formats.ply_header import BYTE_ORDERS, Element, Property
from jetnormal.formats.table import format_rows, read_table


def read_element(stream: BinaryIO, element: Element, encoding: str, path: Path, line: int) -> Columns:
    """Read the rows of an element from a stream's position.

    Args:
        stream: a binary stream; it is left behind the last row.
        element: what to read.
        encoding: of the file.
        path: the file, for messages.
        line: number of the first row's line if the file is text, for messages.

    Returns:
        The properties by name; a list property is an object array of arrays.

    Raises:
        InputError: if rows are missing or are not what the header says.
    """
    if element.is_scalar and encoding == "ascii":
        columns = len(element.properties)
        table = read_table(stream, element.dtype(encoding), path=path, line=line, columns=columns, rows=element.count)
        return {prop.name: table[prop.name] for prop in element.properties}
    try:
        if element.is_scalar:
            dtype = element.dtype(encoding)
            table = np.frombuffer(_take(stream, element.count * dtype.itemsize), dtype)
            return {prop.name: table[prop.name] for prop in element.properties}
        row = _text_row if encoding == "ascii" else _binary_row
        order = BYTE_ORDERS[encoding]
        rows = [row(stream, element.properties, order) for _ in range(element.count)]
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path}: element {element.name!r}: {error}; export the file again") from None
    values = list(zip(*rows, strict=True)) or [()] * len(element.properties)
    return {prop.name: _column(prop, column) for prop, column in zip(element.properties, values, strict=True)}


def _take(stream: BinaryIO, size: int) -> bytes:
    if size < 0:
        raise ValueError("a list has a negative length")
    data = stream.read(size)
    if len(data) != size:
        raise ValueError("the file is truncated")
    return data


def _binary_row(stream: BinaryIO, properties: tuple[Property, ...], order: str) -> list[NDArray[Any]]:
    row = []
    for prop in properties:
        length = 1
        if prop.length_type:
            length_type = np.dtype(order + prop.length_type)
            length = int(np.frombuffer(_take(stream, length_type.itemsize), length_type)[0])
        dtype = np.dtype(order + prop.type)
        row.append(np.frombuffer(_take(stream, length * dtype.itemsize), dtype).astype(prop.type))
    return row


def _text_row(stream: BinaryIO, properties: tuple[Property, ...], order: str) -> list[NDArray[Any]]:
    """One row of text; `order` means nothing here."""
    raw = stream.readline()
    while raw and not raw.strip():
        raw = stream.readline()
    if not raw:
        raise ValueError("rows are missing, the file is truncated")
    words = iter(raw.split())
    row = []
    try:
        for prop in properties:
            length = int(next(words)) if prop.length_type else 1
            parse = float if prop.type.startswith("f") else int
            row.append(np.array([parse(next(words)) for _ in range(length)], prop.type))
    except StopIteration:
        raise ValueError(f"the row {raw[:40].decode('latin1').strip()!r} has too few values") from None
    if next(words, None) is not None:
        raise ValueError(f"the row {raw[:40].decode('latin1').strip()!r} has too many values")
    return row


def _column(prop: Property, values: tuple[NDArray[Any], ...]) -> NDArray[Any]:
    if prop.length_type is None:
        return np.concatenate(values) if values else np.empty(0, prop.type)
    lists = np.empty(len(values), object)
    for index, row in enumerate(values):  # assigned at once, lists of one length would become a matrix
        lists[index] = row
    return lists


def format_element(columns: Columns, element: Element, encoding: str) -> Iterator[bytes | memoryview]:
    """Yield the rows of an element in chunks; `columns` are in the order and types of its properties."""
    if not element.is_scalar:
        row = _format_text_row if encoding == "ascii" else _format_binary_row
        order = BYTE_ORDERS[encoding]
        for values in zip(*columns.values(), strict=True):
            yield row(values, element.properties, order)
    elif encoding == "ascii":
        yield from format_rows(list(columns.values()), " ")
    else:
        table = np.empty(element.count, element.dtype(encoding))
        for name, column in columns.items():
            table[name] = column
        yield table.view(np.uint8).data


def _format_binary_row(values: tuple[Any, ...], properties: tuple[Property, ...], order: str) -> bytes:
    parts = []
    for prop, value in zip(properties, values, strict=True):
        if prop.length_type:
            parts.append(np.array(len(value), order + prop.length_type))
        parts.append(np.asarray(value, order + prop.type))
    return b"".join(part.tobytes() for part in parts)


def _format_text_row(values: tuple[Any, ...], properties: tuple[Property, ...], order: str) -> bytes:
    """One row of text; `order` means nothing here."""
    words = []
    for prop, value in zip(properties, values, strict=True):
        numbers = np.asarray(value, prop.type).reshape(-1)
        if prop.length_type:
            words.append(str(len(numbers)))
        words += map(str, numbers if prop.type == "f4" else numbers.tolist())  # a float32 has a shorter form
    return (" ".join(words) + "\n").encode("ascii")

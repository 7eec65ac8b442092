"""Thrift's compact protocol, in which Parquet describes itself; Arrow crashes on forgeries.

https://github.com/apache/thrift/blob/master/doc/specs/thrift-compact-protocol.md
"""

from __future__ import annotations

from typing import IO, Any

MAX_DEPTH, MAX_TEXT = 20, 2**24

Struct = dict[int, Any]
"""Values by the number of their field; lists, structs, numbers, bytes."""


class Thrift:
    """Reads values one after the other, from where a file is."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file, self._depth = file, 0

    def struct(self) -> Struct:
        """The fields of a struct.

        Raises:
            ValueError, IndexError: it is none, or goes on after the end.
        """
        found, field = Struct(), 0
        while head := self._byte():
            field = field + (head >> 4) if head >> 4 else self._number()
            kind = head & 15
            found[field] = kind == 1 if kind in (1, 2) else self._value(kind)
        return found

    def _value(self, kind: int) -> Any:
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise ValueError(f"it has more than {MAX_DEPTH} values in one another")
        found = self._one(kind)
        self._depth -= 1
        return found

    def _one(self, kind: int) -> Any:
        if kind in (1, 2, 3):  # in a list, a truth takes a byte
            return self._byte()
        if kind in (4, 5, 6):
            return self._number()
        if kind == 12:
            return self.struct()
        if kind in (9, 10):
            head = self._byte()
            count = head >> 4 if head >> 4 < 15 else self._varint()
            return [self._value(head & 15) for _ in range(count)]  # each takes a byte at least
        if kind in (7, 8):
            size = 8 if kind == 7 else self._varint()
            found = self._file.read(min(size, MAX_TEXT))
            if len(found) < size:
                raise ValueError("it goes on after its end")
            return found
        raise ValueError(f"it has a value of kind {kind}")

    def _byte(self) -> int:
        return self._file.read(1)[0]

    def _varint(self) -> int:
        found = shift = 0
        while True:
            byte = self._byte()
            found |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return found
            if shift > 63:
                raise ValueError("it has a number of more than 64 bits")

    def _number(self) -> int:
        packed = self._varint()
        return packed >> 1 ^ -(packed & 1)

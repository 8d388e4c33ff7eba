"""What a leaf's 64 bits mean: an index, a float, or an element of a field.

The store keeps payloads only; a diagram carries its leaf type, and operators refuse to mix types.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams.field import Field


@dataclass(frozen=True)
class IndexLeaves:
    """Integers 0, 1, 2, ...: blocks, actions, rows of a table; 0 and 1 are false and true."""

    def encode(self, value: int) -> int:
        """The payload of `value`.

        Raises:
            ValueError: no integer in [0, 2^64).
        """
        number = int(value)
        if number != value or not 0 <= number < 2**64:
            raise ValueError(f"{value!r} as an index leaf; index leaves are integers in [0, 2^64)")
        return number

    def decode(self, payload: int) -> int:
        """The value of a payload."""
        return payload


@dataclass(frozen=True)
class FloatLeaves:
    """Doubles; -0.0 is 0.0, and there is one NaN."""

    def encode(self, value: float) -> int:
        """The payload of `value`."""
        canonical = math.nan if math.isnan(value) else value + 0.0
        return int(struct.unpack("<Q", struct.pack("<d", canonical))[0])

    def decode(self, payload: int) -> float:
        """The value of a payload."""
        return float(struct.unpack("<d", struct.pack("<Q", payload))[0])


INDEX = IndexLeaves()
FLOAT = FloatLeaves()

LeafType: TypeAlias = IndexLeaves | FloatLeaves | Field


def payloads(leaf_type: LeafType, values: Any) -> npt.NDArray[np.uint64]:
    """The payloads of an array of values; field elements must be given in stored form.

    Raises:
        ValueError: values that leaves of this type can't have.
    """
    if isinstance(leaf_type, FloatLeaves):
        floats = np.asarray(values, dtype=np.float64) + 0.0
        floats[np.isnan(floats)] = np.nan
        return floats.view(np.uint64)
    given = np.asarray(values)
    if given.size == 0:
        return np.empty(given.shape, dtype=np.uint64)
    if given.dtype.kind not in "bui" or (given.dtype.kind == "i" and given.min() < 0):
        raise ValueError(f"{describe(leaf_type)} leaves are given as non-negative integers")
    stored = np.ascontiguousarray(given, dtype=np.uint64)
    if isinstance(leaf_type, Field) and int(stored.max()) >= leaf_type.prime:
        raise ValueError(f"the stored form of an element of {describe(leaf_type)} is less than the prime")
    return stored


def describe(leaf_type: LeafType) -> str:
    """The leaf type's name for messages."""
    if isinstance(leaf_type, Field):
        return f"GF({leaf_type.prime})"
    return "index" if isinstance(leaf_type, IndexLeaves) else "float"

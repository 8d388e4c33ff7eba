"""What a leaf's 64 bits mean: an index, a float, or an element of a field.

The store keeps payloads only; a diagram carries its leaf type, and operators refuse to mix types.
"""

from __future__ import annotations

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
        """The payload of `value`."""
        return value

    def decode(self, payload: int) -> int:
        """The value of a payload."""
        return payload


@dataclass(frozen=True)
class FloatLeaves:
    """Doubles; -0.0 is 0.0."""

    def encode(self, value: float) -> int:
        """The payload of `value`."""
        return int(struct.unpack("<Q", struct.pack("<d", value + 0.0))[0])

    def decode(self, payload: int) -> float:
        """The value of a payload."""
        return float(struct.unpack("<d", struct.pack("<Q", payload))[0])


INDEX = IndexLeaves()
FLOAT = FloatLeaves()

LeafType: TypeAlias = IndexLeaves | FloatLeaves | Field


def payloads(leaf_type: LeafType, values: Any) -> npt.NDArray[np.uint64]:
    """The payloads of an array of values; field elements must be given in stored form."""
    if isinstance(leaf_type, FloatLeaves):
        return (np.asarray(values, dtype=np.float64) + 0.0).view(np.uint64)
    return np.ascontiguousarray(values, dtype=np.uint64)


def describe(leaf_type: LeafType) -> str:
    """The leaf type's name for messages."""
    if isinstance(leaf_type, Field):
        return f"GF({leaf_type.prime})"
    return "index" if isinstance(leaf_type, IndexLeaves) else "float"

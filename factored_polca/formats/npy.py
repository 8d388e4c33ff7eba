"""Arrays in numpy's format npy, read from bytes that are not trusted.

    file   ::= "\\x93NUMPY" 1 0 (length of the header, two bytes) header (the numbers, in C order)
    header ::= "{'descr': '" type "', 'fortran_order': False, 'shape': (" [size {", " size} [","]] "), }"
               {" "} "\\n"

numpy's own reader gives the header to Python's parser and to the constructor of data types, which take far
more than that, and fail on it in many ways.  Here the header is what numpy writes for plain arrays, or
the array is refused.

Source: R. Kern and others, "numpy.lib.format", the documentation of numpy 2.
"""

from __future__ import annotations

import math
import re
from typing import Any, Final

import numpy as np
import numpy.typing as npt

TYPES: Final = ("<i2", "<i4", "<i8", "<u8", "<f8", "|b1")
"""Types of numbers that arrays in our files may have."""

_MAGIC: Final = b"\x93NUMPY\x01\x00"
_HEADER: Final = re.compile(
    rb"\{'descr': '([<|][a-z][0-9])', 'fortran_order': False, "
    rb"'shape': \(((?:[0-9]{1,18}(?:, |,?(?=\))))*)\)(?:, )?\} *\n"
)
_LONGEST: Final = 1_000


def read_npy(data: bytes, name: str) -> npt.NDArray[Any]:
    """The array in `data`, called `name` in messages; it can't be written to.

    Raises:
        ValueError: it is no such file, or has more or fewer bytes than its shape needs.
    """
    size = int.from_bytes(data[len(_MAGIC) : len(_MAGIC) + 2], "little")
    start = len(_MAGIC) + 2 + size
    if not data.startswith(_MAGIC) or size > _LONGEST or len(data) < start:
        raise ValueError(f"{name} is no npy file of version 1.0")
    match = _HEADER.fullmatch(data, len(_MAGIC) + 2, start)
    if match is None or match[1].decode("ascii") not in TYPES:
        raise ValueError(f"{name} is no array of numbers in C order")
    shape = tuple(int(word) for word in re.findall(rb"[0-9]+", match[2]))
    dtype = np.dtype(match[1].decode("ascii"))
    if math.prod(shape) * dtype.itemsize != len(data) - start:
        raise ValueError(f"{name} has not as many bytes as its shape needs")
    if dtype.kind == "b" and any(byte > 1 for byte in data[start:]):
        raise ValueError(f"{name} has a truth value that is none")
    return np.frombuffer(data, dtype=dtype, offset=start).reshape(shape)

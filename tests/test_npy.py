"""Arrays that are not trusted: what numpy writes is read, anything else is refused by a ValueError."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest

from factored_polca.formats.npy import TYPES, read_npy


def written(array: np.ndarray[Any, Any]) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, array, version=(1, 0), allow_pickle=False)
    return stream.getvalue()


@pytest.mark.parametrize("kind", TYPES)
@pytest.mark.parametrize("shape", [(), (0,), (1,), (6,), (2, 3), (3, 1, 2)])
def test_what_numpy_writes_is_read(kind: str, shape: tuple[int, ...]) -> None:
    array = np.arange(np.prod(shape, dtype=int)).reshape(shape).astype(kind)
    back = read_npy(written(array), "a")
    assert back.dtype == array.dtype
    assert back.shape == shape
    assert np.array_equal(back, array)


def with_header(text: str, numbers: bytes = bytes(16)) -> bytes:
    line = text.encode("latin-1").ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(line).to_bytes(2, "little") + line + numbers


PLAIN = "{'descr': '<i8', 'fortran_order': False, 'shape': (2,), }"


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (b"", "no npy file"),
        (b"\x93NUMPY\x02\x00" + bytes(200), "no npy file"),
        (with_header(PLAIN)[:50], "no npy file"),
        (b"\x93NUMPY\x01\x00\xff\xff" + bytes(1 << 16), "no npy file"),
        (with_header(PLAIN, bytes(15)), "not as many bytes"),
        (with_header(PLAIN.replace("2", "999999999999999")), "not as many bytes"),
        # Each of these made numpy's own reader raise an exception of another class.
        (with_header(PLAIN.replace("<i8", ",")), "no array of numbers"),
        (with_header(PLAIN.replace("}", "(")), "no array of numbers"),
        (with_header(PLAIN.replace("<i8", "O")), "no array of numbers"),
        (with_header(PLAIN.replace("False", "True")), "no array of numbers"),
        (with_header(PLAIN.replace("2", "-2")), "no array of numbers"),
        (with_header(PLAIN.replace("2,", "2,,")), "no array of numbers"),
        (with_header(PLAIN.replace("<i8", "<f2")), "no array of numbers"),
        (with_header("__import__('os')"), "no array of numbers"),
        (with_header("(" * 117), "no array of numbers"),
        (with_header("{'descr': '|b1', 'fortran_order': False, 'shape': (1,), }", b"\x02"), "truth value"),
    ],
)
def test_anything_else_is_refused(data: bytes, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        read_npy(data, "a")

"""The loop that runs a straight-line program on floats: a module of its own, compiled where needed."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams.jit import lean_kernel

FloatArray = npt.NDArray[np.float64]
Int32Array = npt.NDArray[np.int32]
Int8Array = npt.NDArray[np.int8]


@lean_kernel
def run_numbers(
    operation: Int8Array, left: Int32Array, right: Int32Array, constants: FloatArray,
    setting: FloatArray, values: FloatArray, sizes: FloatArray, count: int,
) -> None:  # fmt: skip
    """Fill the first `count` registers of `values` and of `sizes`, their running error bounds."""
    for k in range(count):
        code = operation[k]
        i = left[k]
        j = right[k]
        if code == 0:
            values[k] = constants[i]
            sizes[k] = abs(constants[i])
        elif code == 1:
            values[k] = setting[i]
            sizes[k] = abs(setting[i])
        elif code == 2:
            values[k] = values[i] + values[j]
            sizes[k] = sizes[i] + sizes[j]
        elif code == 3:
            values[k] = values[i] * values[j]
            sizes[k] = sizes[i] * sizes[j]
        else:
            values[k] = values[i] / values[j]
            sizes[k] = (sizes[i] + abs(values[k]) * sizes[j]) / abs(values[j])


@lean_kernel
def run_masses(
    operation: Int8Array, left: Int32Array, right: Int32Array, values: FloatArray, first: int
) -> None:
    """Fill the registers from `first` on, sums and products of registers before them."""
    for k in range(first, len(operation)):
        if operation[k] == 2:
            values[k] = values[left[k]] + values[right[k]]
        else:
            values[k] = values[left[k]] * values[right[k]]

"""What weighted sums over one leaf type pass to their kernels."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams.field import Field
from factored_polca.diagrams.leaves import LeafType
from factored_polca.diagrams.manager import Manager


def sum_options(
    manager: Manager, leaf_type: LeafType, normalised: bool, step: float = 0.0
) -> npt.NDArray[np.int64]:
    """The options that weighted sums over `leaf_type` pass to their kernels, until the next collection.

    Sums of floats are rounded to multiples of `step`, a power of 2, where it is not 0.
    """
    key = (f"{'normalised ' if normalised else ''}sum to {step!r}", leaf_type)
    if key in manager.operator_rows:
        return manager.operator_rows[key]
    is_field = isinstance(leaf_type, Field)
    number = manager.field_number(leaf_type) if isinstance(leaf_type, Field) else manager.step_number(step)
    zero, one = manager.constant(0, leaf_type), manager.constant(1, leaf_type)
    bits = int(np.float64(step).view(np.int64))
    values = [zero.node, one.node, normalised, 2 * number + normalised, not is_field, bits]
    return manager.operator_rows.setdefault(key, np.array(values, dtype=np.int64))

"""A belief of which the hidden features are a product, but for a cluster with a joint distribution."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import Diagram
from factored_polca.structured.alpha_forest import Forest
from factored_polca.structured.pomdp_model import Seen

FloatArray = npt.NDArray[np.float64]

KEPT_BITS = np.uint64(8)
"""Bits of a float that do not count where beliefs are compared."""


@dataclass(frozen=True, eq=False)
class PointBelief:
    """A belief at one y.

    `marginals` holds the distributions of the hidden features one after the other.  `cluster` are the
    levels of the features whose joint distribution is `diagram`; it is empty for a product.
    """

    seen: Seen
    marginals: FloatArray
    cluster: tuple[int, ...] = ()
    diagram: Diagram | None = None
    joint: Forest | None = None
    ways: FloatArray = field(default_factory=lambda: np.empty(0))

    def key(self) -> tuple[object, ...]:
        """Equal for beliefs that are taken for the same."""
        parts: list[object] = [self.seen, rounded_bits(self.marginals).tobytes()]
        if self.joint is not None:
            f = self.joint
            parts += [
                self.cluster,
                f.levels[: f.nodes].tobytes(),
                f.children[: f.edges].tobytes(),
                rounded_bits(f.value[: f.nodes]).tobytes(),
            ]
        return tuple(parts)


def rounded_bits(values: FloatArray) -> npt.NDArray[np.uint64]:
    """The first 45 bits of floats, rounded."""
    bits = np.ascontiguousarray(values).view(np.uint64)
    result: npt.NDArray[np.uint64] = (bits + np.uint64(128)) >> KEPT_BITS
    return result

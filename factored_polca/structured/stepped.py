"""Regressions whose sums are rounded to multiples of a step while they are made.

Rounding results alone would come too late: sums of many features whose values differ in the last bits, or
by less than matters yet, have exponentially many leaves half-way.  A regression through n changed features
rounds n times on each path, each time by half a step at most, and averages what was rounded before:

    |rounded - exact regression| <= n * step / 2.

The step is a power of 2, so that its multiples are floats.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import FLOAT, Diagram
from factored_polca.diagrams.operations import sum_options
from factored_polca.symbolic import NumericView, SymbolicModel
from factored_polca.symbolic.regression import Prepared


class SteppedView(NumericView):
    """The probabilities of a model as floats; regressions without synchronic arcs are rounded to multiples
    of `step`, where it is not 0."""

    def __init__(self, symbolic: SymbolicModel) -> None:
        super().__init__(symbolic, FLOAT)
        self.step = 0.0
        self._stepped: dict[int, Prepared] = {}

    def use_step(self, width: float) -> None:
        """Round to the largest power of 2 that is at most `width`; to none for 0."""
        step = 2.0 ** math.floor(math.log2(width)) if width > 1e-290 else 0.0
        if step != self.step:
            self.step = step
            self._options = None
            self._stepped = {}

    def sum_options(self) -> npt.NDArray[np.int64]:
        """The options of normalised weighted sums, until the next collection."""
        if self._options is None or self._options[0] != self.manager.collections:
            options = sum_options(self.manager, FLOAT, True, self.step)
            self._options = (self.manager.collections, options)
        return self._options[1]

    def regress_nodes(self, prepared: Prepared, value: Diagram) -> Diagram:
        """The regression of V, remembered apart from those with other steps."""
        if not self.step:
            return super().regress_nodes(prepared, value)
        if prepared.key not in self._stepped:
            key = self.manager.cache_key("step", prepared.key, self.step)
            self._stepped[prepared.key] = replace(prepared, key=key)
        return super().regress_nodes(self._stepped[prepared.key], value)

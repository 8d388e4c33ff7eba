"""Random models in both readings, made once for all tests that share a seed.

`FACTORED_POLCA_LONG=1` in the environment takes 1,000 seeds in place of 300, and larger models.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from typing import Any

import numpy as np
import pytest
from random_models import random_model

from factored_polca.diagrams import Diagram, LeafType, evaluate_states
from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.explicit.exact_mdp import ExactMDP
from factored_polca.models import Model
from factored_polca.symbolic import ORDERS, SymbolicModel, compile_model

LONG = os.environ.get("FACTORED_POLCA_LONG") == "1"
MODELS = 1_000 if LONG else 300
MAXIMUM_STATES = 256 if LONG else 64
CHUNK = 20


def chunks(models: int = MODELS) -> pytest.MarkDecorator:
    """Run a test once for each chunk of `seeds`, out of the first `models` seeds."""
    starts = range(0, models, CHUNK)
    ranges = [range(start, min(start + CHUNK, models)) for start in starts]
    return pytest.mark.parametrize("seeds", ranges, ids=[f"{r.start}-{r.stop - 1}" for r in ranges])


@dataclass(frozen=True)
class Case:
    """A model, enumerated and compiled; `states` [s, feature] are value numbers in explicit order."""

    seed: int
    model: Model
    exact: ExactMDP
    symbolic: SymbolicModel
    states: Any

    def at(self, diagram: Diagram) -> list[Any]:
        """The decoded value of a diagram at each state."""
        payloads = evaluate_states(diagram, self.states, self.symbolic.columns())
        return [diagram.leaf_type.decode(int(payload)) for payload in payloads]

    def diagram(self, values: Sequence[Any], leaf_type: LeafType) -> Diagram:
        """The diagram with `values` [s] over the present variables."""
        return table_diagram(self.symbolic, values, leaf_type)


def state_table(model: Model, exact: ExactMDP) -> Any:
    pairs = [zip(model.features, values, strict=True) for values in exact.state_values]
    return np.array([[feature.index(value) for feature, value in row] for row in pairs], dtype=np.int32)


def table_diagram(symbolic: SymbolicModel, values: Sequence[Any], leaf_type: LeafType) -> Diagram:
    features = symbolic.model.features
    names = [feature.name for feature in features]
    axes = [names.index(name) for name in symbolic.order]
    table = np.array(values, dtype=object).reshape([len(feature.values) for feature in features])

    def build(part: Any, place: int) -> Diagram:
        if place == len(axes):
            return symbolic.manager.constant(part.item() if hasattr(part, "item") else part, leaf_type)
        children = [build(child, place + 1) for child in part]
        return symbolic.manager.variable(2 * place, children)

    return build(table.transpose(axes), 0)


def compiled(model: Model, order: str = "auto", seed: int = -1) -> Case:
    exact = enumerate_model(model)
    symbolic = compile_model(model, order=order)
    return Case(seed, model, exact, symbolic, state_table(model, exact))


@cache
def case(seed: int) -> Case:
    """The random model of `seed`, compiled with one of the variable orders in turn."""
    model = random_model(seed, max_states=MAXIMUM_STATES)
    return compiled(model, ORDERS[seed % len(ORDERS)], seed)


def probability_sum(row: dict[int, Fraction], values: Sequence[int]) -> Fraction:
    """The sum over next states of probability times value, as the definition says."""
    return sum((chance * values[t] for t, chance in row.items()), Fraction(0))

"""Shipped domains through every format: written, read, written and read again, or refused with the reason.

The table has a row for each domain, at a small size.  Read again, a written model is the same model, and
its written form says the same as the domain: blocks and values agree to 1e-9.  In the table `...` stands
for a model that the format expresses, a text for the reason why it does not.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from types import EllipsisType

import numpy as np
import pytest

from factored_polca import library
from factored_polca.explicit.dynamic_programming import value_iteration
from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.formats import FORMATS, Document, spudd_trees
from factored_polca.minimisation import flat_process, minimise
from factored_polca.minimisation.unreduced import unreduced_pomdp
from factored_polca.models import FALSE, Action, Feature, Model, ModelError, Observation, work
from factored_polca.solvers.pomdp_choose import solve_pomdp
from factored_polca.symbolic import compile_model

Outcome = EllipsisType | str
TOO_MANY = "states, which this format lists, are more than 20000"


@dataclass(frozen=True)
class Row:
    """A domain, its parameters, and what becomes of it in SPUDD's, POMDPX and Cassandra's format."""

    domain: str
    parameters: Mapping[str, str]
    spudd: Outcome = ...
    pomdpx: Outcome = ...
    cassandra: Outcome = ...
    ends: int = 1
    """Blocks of terminal states once they are states like others: more than one if what is seen differs."""


ROWS = [
    Row("cheese", {}),
    Row("cheese_taxi", {}),
    Row("coffee", {}, cassandra=""),
    Row("components", {"size": "3"}),
    Row("components", {"size": "40"}, cassandra=TOO_MANY),
    Row("expon", {"size": "4"}),
    Row("hallway", {"size": "5"}),
    Row("linear", {"size": "4"}),
    Row("linear", {"size": "16"}, cassandra=TOO_MANY),
    Row("meds", {}),
    Row("network", {"size": "3"}),
    Row("nursebot", {}, pomdpx="", cassandra=""),
    Row("part_painting", {}),
    Row("rocksample", {"size": "3", "rocks": "2"}, ends=3),  # the rover's row is seen beyond the edge, too
    Row("sysadmin", {"size": "4"}),
    Row("taxi", {"size": "2"}),
    Row("tiger", {}),
    Row("toy", {}),
    Row("twenty_questions", {}),
    Row("workshop", {"size": "1"}),
]
"""An empty reason: the format expresses the model, which is left out here for its size."""

CASES = [
    pytest.param(row, extension, outcome, id=f"{row.domain}-{'-'.join(row.parameters.values())}{extension}")
    for row in ROWS
    for extension, outcome in (
        (".toml", ...), (".dat", row.spudd), (".pomdpx", row.pomdpx), (".pomdp", row.cassandra),
    )
    if outcome != ""
]  # fmt: skip


@cache
def loaded(domain: str, parameters: tuple[tuple[str, str], ...]) -> Document:
    found = library.load(domain, dict(parameters))
    return Document(found.model, found.tasks)


def document_of(row: Row, extension: str) -> Document:
    whole = loaded(row.domain, tuple(row.parameters.items()))
    return whole if extension == ".toml" else Document(whole.model)


def again(document: Document, extension: str) -> Document:
    """What is read of what is written; no row of it had to be rounded."""
    form = FORMATS[extension]
    back = form.read(form.write(document), {}, document.model.name)
    told = {warning.message for warning in back.warnings}
    assert told <= {"init does not sum to 1; it was divided by its sum"}  # thirds are written as weights
    return back


def test_every_shipped_domain_has_a_row() -> None:
    assert {row.domain for row in ROWS} == set(library.domains())


@pytest.mark.parametrize(("row", "extension", "outcome"), CASES)
def test_what_is_read_again_is_the_same_model(row: Row, extension: str, outcome: Outcome) -> None:
    document = document_of(row, extension)
    if isinstance(outcome, str):
        with pytest.raises(ModelError, match=outcome):
            FORMATS[extension].write(document)
        return
    once = again(document, extension)
    twice = again(once, extension)
    assert twice.model == once.model
    assert twice.tasks == once.tasks == document.tasks
    if extension == ".toml":
        assert once.model == document.model


SAME = [
    pytest.param(row, extension, id=f"{row.domain}{extension}")
    for row in ROWS
    for extension, outcome in ((".dat", row.spudd), (".pomdpx", row.pomdpx), (".pomdp", row.cassandra))
    if outcome is ... and row.cassandra != TOO_MANY  # values are computed state by state
]


@pytest.mark.parametrize(("row", "extension"), SAME)
def test_a_domain_is_worth_the_same_in_each_format(row: Row, extension: str) -> None:
    model = document_of(row, extension).model
    back = again(Document(model), extension).model
    assert value_of(back) == pytest.approx(value_of(model), rel=1e-9, abs=1e-9)
    if extension != ".pomdp":  # a flat file has states of its own for what was seen
        assert blocks_of(back) == blocks_of(model) + row.ends - 1


def blocks_of(model: Model) -> int:
    return minimise(flat_process(compile_model(model))).partition.blocks


def value_of(model: Model) -> list[float]:
    """The optimal value of an MDP; of a POMDP two bounds, each of which is a function of the model."""
    if model.observability == "full":
        exact = enumerate_model(model)
        start = [float(chance) for chance in exact.initial]
        return [float(np.dot(start, value_iteration(exact.to_arrays())))]
    pomdp = unreduced_pomdp(compile_model(model), reachable=True)
    fib, blind = solve_pomdp(pomdp, "fib"), solve_pomdp(pomdp, "blind")
    return [fib.upper, blind.lower]


# --------------------------------------------------------------------------------------------
# The end
# --------------------------------------------------------------------------------------------


def errand(observability: str) -> Model:
    """A walk over 0..3 that ends at 3, worth 10; what is done there would be worth 7 if it did not."""
    x, near = Feature("x", range(4)), Observation("near", ["yes", "no"])
    senses = {near: "yes if x' >= 2 else no"} if observability == "partial" else {}
    return Model(
        "errand",
        [x],
        [
            Action("go", {x: "{x + 1: 0.5, x: 0.5} if x < 3 else 0"}, senses=senses),
            Action("stay", rewards="8 if x == 3 else 0", senses=senses),
        ],
        rewards="10 if x' == 3 and x < 3 else -1",
        terminal=x.is_(3),
        initial={x: 0},
        discount="0.9",
        observability=observability,
        observations=[near] if senses else [],
    )


@pytest.mark.parametrize("observability", ["full", "partial"])
@pytest.mark.parametrize("extension", [".dat", ".pomdpx", ".pomdp", ".toml"])
def test_terminal_states_are_absorbing_and_earn_nothing(extension: str, observability: str) -> None:
    """By hand, with g the discount: V_2 = (10 - 1)/2 + g V_2/2, V_k = -1 + g (V_k + V_(k+1))/2 below."""
    back = again(Document(errand(observability)), extension).model
    assert (back.terminal == FALSE) is (extension != ".toml")
    g = 0.9
    value = (10 - 1) / (2 - g)
    for _ in range(2):
        value = (-2 + g * value) / (2 - g)
    if observability == "full":
        assert value_of(back) == pytest.approx([value], abs=1e-9)
        return
    pomdp = unreduced_pomdp(compile_model(back), reachable=True)
    going, best = solve_pomdp(pomdp, "blind"), solve_pomdp(pomdp, "fib")
    assert going.lower == pytest.approx(value, abs=1e-6)  # to go is best wherever one may be
    assert best.upper == pytest.approx(value, abs=1e-6)


@pytest.mark.parametrize("extension", [".toml", ".dat", ".pomdpx"])
@pytest.mark.parametrize(("domain", "size"), [("components", "16"), ("sysadmin", "24")])
def test_files_of_ten_million_states_are_read_in_few_steps(
    domain: str, size: str, extension: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Readers count tokens and nodes: 60,000 are enough, where there are 10^7 states and more."""
    for module in (spudd_trees, work):
        monkeypatch.setattr(module, "MAXIMUM_STEPS", 60_000)
    model = library.load(domain, {"size": size}).model
    assert model.states > 10**7
    assert again(Document(model), extension).model.states == model.states

"""The files .alpha and .pg: what is written is read back, samples of pomdp-solve are read."""

from __future__ import annotations

import random

import numpy as np
import pytest
from random_pomdps import random_pomdp
from small_pomdps import tiger
from test_cassandra_writer import foretold, read_back, seen_half, worn

from factored_polca.explicit.alpha_expansion import enumerate_vectors
from factored_polca.explicit.exact_pomdp import enumerate_pomdp
from factored_polca.explicit.policy_graph import PolicyGraph, evaluate, value
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.formats.alpha_file import read_alpha, write_alpha
from factored_polca.formats.cassandra import read_pomdp, write_pomdp
from factored_polca.formats.graph_file import read_graph, write_graph
from factored_polca.models import LimitReached, ModelError


def small(seed: int) -> ArrayPOMDP:
    model = random_pomdp(seed, max_states=6)
    if any(feature.observed for feature in model.features):
        model = foretold(model)
    return enumerate_pomdp(model).to_arrays()


@pytest.mark.parametrize("seed", range(60))
def test_vectors_are_read_back_and_mean_the_same_in_the_written_model(seed: int) -> None:
    pomdp = small(seed)
    try:
        vectors = enumerate_vectors(pomdp, 2, limit=300)
    except LimitReached:
        vectors = enumerate_vectors(pomdp, 1)
    text = write_alpha(vectors, pomdp)
    again = read_alpha(text, pomdp)
    there = read_back(write_pomdp(pomdp))
    theirs = read_alpha(text, there)
    assert again.value(pomdp.initial) == pytest.approx(vectors.value(pomdp.initial), abs=1e-12)
    assert theirs.value(there.initial) == pytest.approx(vectors.value(pomdp.initial), abs=1e-12)
    generator = np.random.default_rng(seed)
    for y in np.unique(pomdp.observed[~pomdp.terminal]).tolist():
        mine = (pomdp.observed == y) & ~pomdp.terminal
        beliefs = generator.dirichlet(np.ones(pomdp.states), 20) * mine
        beliefs /= beliefs.sum(axis=1, keepdims=True)
        assert again.values(beliefs) == pytest.approx(vectors.values(beliefs), abs=1e-12)


def random_graph(pomdp: ArrayPOMDP, seed: int, nodes: int = 4) -> PolicyGraph:
    generator = np.random.default_rng(seed)
    kinds = int(pomdp.observed.max()) + 1
    actions = generator.integers(len(pomdp.actions), size=nodes)
    after = [
        np.tile(generator.integers(nodes, size=(len(pomdp.observations[a]), 1)), (1, kinds))
        for a in actions.tolist()
    ]
    return PolicyGraph(actions, tuple(after), np.zeros(kinds, dtype=np.int64))


@pytest.mark.parametrize("seed", range(60))
def test_graphs_are_read_back_and_earn_the_same(seed: int) -> None:
    pomdp = small(seed)
    if len(np.unique(pomdp.observed[~pomdp.terminal])) == (~pomdp.terminal).sum() > 1:
        with pytest.raises(ModelError, match="every state is seen"):
            write_graph(random_graph(pomdp, seed), pomdp)
        return
    graph = random_graph(pomdp, seed)
    text = write_graph(graph, pomdp)
    again = read_graph(text, pomdp)
    ours = value(graph, pomdp, evaluate(graph, pomdp), pomdp.initial)
    assert value(again, pomdp, evaluate(again, pomdp), pomdp.initial) == pytest.approx(ours, abs=1e-9)
    file = write_pomdp(pomdp)
    there, (channel,) = read_back(file), read_pomdp(file, "m").observations
    theirs = read_graph(text, there, labels=[f"observation={v}" for v in channel.values])
    assert value(theirs, there, evaluate(theirs, there), there.initial) == pytest.approx(ours, abs=1e-9)


# What pomdp-solve 5.4 writes for `worn` and a horizon of four steps.
ALPHA = """1
-1.0837343749999999165112285 -1.0837343749999999165112285 0.2239843750000000133226763 0.0

0
0.7268886718750000586197757 0.7268886718750000586197757 -3.6204179687499999928945726 0.0
"""
GRAPH = "0 1  0 - 0 \n1 0  0 1 X \n"


def test_files_of_pomdp_solve_are_read() -> None:
    vectors = read_alpha(ALPHA, worn())
    assert vectors.action(np.array([1.0, 0.0, 0.0])) == 0
    assert vectors.value(np.array([0.0, 1.0, 0.0])) == 0.223984375
    graph = read_graph(GRAPH, worn(), start=1)
    assert graph.actions.tolist() == [1, 0]
    assert [table.tolist() for table in graph.successors] == [[[0]], [[0], [1]]]
    assert graph.start.tolist() == [1]


def test_a_graph_may_move_on_by_what_is_seen() -> None:
    pomdp = seen_half([0.5, 0.5, 0.0, 0.0])
    tables = (np.array([[0, 1]]), np.array([[1, 0]]))
    graph = PolicyGraph(np.array([0, 1]), tables, np.array([0, -1]))
    again = read_graph(write_graph(graph, pomdp), pomdp)
    assert [table.tolist() for table in again.successors] == [[[0, 1]], [[1, 0]]]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "without a vector"),
        ("0\n1 2\n3\n1 2\n", r"line 3, column 1: '3' is no action \(actions are 0 to 2\)"),
        ("0\n1\n", "the last vector has 1 numbers for 2 states"),
        ("0\n1 nan\n", "'nan' is no finite"),
        ("0\n1 1e9999\n", "is no finite"),
        ("0 1 ٣\n", "is no finite"),
        ("-1 1 2\n", "'-1' is no action"),
        ("0x1 1 2\n", "'0x1' is no action"),
        ("9" * 500 + " 1 2", "is no action"),
        ("0 1 " + "1" * 5000, "is no finite"),
    ],
)
def test_bad_vectors_are_refused(text: str, told: str) -> None:
    with pytest.raises(ModelError, match=told):
        read_alpha(text, tiger(0.95))


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "without a node"),
        ("0 0 0\n", "1 successors for 2 observations"),
        ("0 0 0 0 0\n", "3 successors for 2 observations"),
        ("1 0 0 0\n0 0 0 0\n", "node 1 stands where node 0"),
        ("0 3 0 0\n", "'3' is no action"),
        ("0 0 1 0\n", "'1' is no node"),
        ("0 0 ? 0\n", "is no node"),
        ("0\n", "0 successors for 2 observations"),
    ],
)
def test_bad_graphs_are_refused(text: str, told: str) -> None:
    with pytest.raises(ModelError, match=told):
        read_graph(text, tiger(0.95))


def test_faults_have_line_and_column() -> None:
    with pytest.raises(ModelError) as caught:
        read_alpha("0\n1 2\n\n  x\n1 2\n", tiger(0.95))
    assert (caught.value.faults[0].line, caught.value.faults[0].column) == (4, 3)
    with pytest.raises(ModelError) as caught:
        read_graph("0 0 0 0\n1 1 0 y\n", tiger(0.95))
    assert (caught.value.faults[0].line, caught.value.faults[0].column) == (2, 7)


def test_changed_files_raise_nothing_but_model_errors() -> None:
    generator = random.Random(5)
    pieces = [*(ALPHA + GRAPH).split(), "-", "X", "1e5", "\n", "\x00", "é", "--", "1_0", "٣", "inf"]
    pomdp, refused = worn(), 0
    for _ in range(2000):
        text = generator.choice((" ", "\n")).join(generator.choices(pieces, k=generator.randint(0, 14)))
        for reader in (read_alpha, read_graph):
            try:
                reader(text, pomdp)
            except ModelError:
                refused += 1
    assert refused > 3000

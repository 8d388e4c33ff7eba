"""The explicit minimiser against closed forms, hand-made examples and all partitions of small models."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from itertools import product

import pytest
from random_models import add_irrelevant_feature, random_model, relabel, reorder

from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.explicit.exact_mdp import ExactMDP
from factored_polca.explicit.minimiser import OUTSIDE, minimise
from factored_polca.explicit.reachability import reachable_states
from factored_polca.models import (
    Action,
    Feature,
    Model,
    boolean,
    check,
)

F = Fraction
SEEDS = range(60)
SMALL = {"features": (1, 3), "values": (2, 3), "actions": (1, 3), "max_states": 6}


def _boutilier(size: int, *, linear: bool) -> Model:
    """The best ("linear") and worst ("expon") case of Boutilier, Dearden & Goldszmidt (2000)."""
    actions = []
    for k in range(size):
        ready = " and ".join([f"x{i}" for i in range(k)] or ["true"])
        effects = {f"x{k}": f"({{true: 0.9, x{k}: 0.1}}) if {ready} else false"}
        cleared = range(k + 1, size) if linear else range(k)
        effects |= {f"x{i}": "false" for i in cleared}
        actions.append(Action(f"a{k}", effects))
    everything = " and ".join(f"x{i}" for i in range(size))
    return Model("boutilier", [boolean(f"x{i}") for i in range(size)], actions,
                 rewards=f"1 if {everything} else 0")  # fmt: skip


def _components(size: int) -> Model:
    values = ("ok", "degraded", "failed")
    names = [f"c{i}" for i in range(size)]
    noop = ('switch({c}, "ok": {{"ok": 0.9, "degraded": 0.1}}, "degraded": {{"degraded": 0.8, '
            '"failed": 0.2}}, "failed": "failed")')  # fmt: skip
    fix = ('switch({c}, "ok": "ok", "degraded": {{"ok": 1/2, "degraded": 1/2}}, '
           '"failed": {{"ok": 1/4, "degraded": 1/4, "failed": 1/2}})')  # fmt: skip
    return Model(
        "components",
        [Feature(name, values) for name in names],
        [Action(a, {c: e.format(c=c) for c in names}) for a, e in (("noop", noop), ("fix", fix))],
        rewards=[f'switch({c}, "ok": 1, "failed": -2, else: 0)' for c in names],
    )  # fmt: skip


@pytest.mark.parametrize("size", [1, 2, 4, 6])
def test_known_numbers_of_blocks(size: int) -> None:
    # n + 1 and 2^n: Boutilier, Dearden & Goldszmidt (2000); (n+1)(n+2)/2: one block for each count
    # of ok, degraded and failed components.
    assert minimise(enumerate_model(_boutilier(size, linear=True))).blocks == size + 1
    assert minimise(enumerate_model(_boutilier(size, linear=False))).blocks == 2**size
    if size <= 4:
        assert minimise(enumerate_model(_components(size))).blocks == (size + 1) * (size + 2) // 2


def test_a_partition_by_hand() -> None:
    # A countdown x in 4..0 that ends at 0 and pays on arrival, beside an irrelevant coin.
    model = Model(
        "countdown",
        [Feature("x", range(5)), boolean("coin")],
        [Action("down", {"x": "x - 1", "coin": "bernoulli(0.3)"}, rewards="1 if x' == 0 else 0")],
        terminal="x == 0",
        initial={"x": "3", "coin": "true"},
    )
    mdp = enumerate_model(model)
    partition = minimise(mdp)
    assert partition.block_of == (0, 0, 1, 1, 2, 2, 3, 3, 4, 4)
    # By rewards: {0}, {1}, {2, 3, 4}; then 2 comes apart, then 3 and 4; then nothing.
    assert (partition.initial_blocks, partition.blocks, partition.rounds) == (3, 5, 3)
    assert partition.members()[1] == (2, 3)
    assert partition.representatives == (0, 2, 4, 6, 8)
    reached = reachable_states(mdp)
    assert [s for s in range(10) if not reached[s]] == [6, 8, 9]
    inside = minimise(mdp, reached)
    assert inside.blocks == 4
    assert inside.block_of == (0, 0, 1, 1, 2, 2, OUTSIDE, 3, OUTSIDE, OUTSIDE)


def test_applicable_actions_and_dead_ends_split_but_terminal_states_do_not() -> None:
    model = Model(
        "m",
        [Feature("x", range(6))],
        [Action("a", applicable="x in {0, 1}"), Action("b", applicable="x in {1, 2}", rewards="x / 1000")],
        terminal="x >= 4",
    )
    assert minimise(enumerate_model(model)).block_of == (0, 1, 2, 3, 4, 4)


def _set_partitions(count: int) -> Iterator[list[int]]:
    """All partitions of `count` things, as block numbers by first occurrence."""
    if count == 0:
        yield []
        return
    for smaller in _set_partitions(count - 1):
        for block in range(max(smaller, default=-1) + 2):
            yield [*smaller, block]


def _is_stable(mdp: ExactMDP, block_of: list[int]) -> bool:
    """Givan, Dean & Greig's definition: any two states of a block agree in everything that counts."""
    blocks = set(block_of)

    def entering(a: int, s: int, block: int) -> Fraction:
        return sum((p for t, p in mdp.rows[a][s].items() if block_of[t] == block), F(0))

    for s, t in product(range(mdp.states), repeat=2):
        if s < t and block_of[s] == block_of[t]:
            if mdp.terminal[s] != mdp.terminal[t]:
                return False
            for a in range(len(mdp.actions)):
                if (mdp.applicable[a][s], mdp.rewards[a][s]) != (mdp.applicable[a][t], mdp.rewards[a][t]):
                    return False
                if any(entering(a, s, block) != entering(a, t, block) for block in blocks):
                    return False
    return True


@pytest.mark.parametrize("seed", SEEDS[:40])
def test_no_stable_partition_has_fewer_blocks(seed: int) -> None:
    mdp = enumerate_model(random_model(seed, **SMALL))  # type: ignore[arg-type]
    stable = [blocks for blocks in _set_partitions(mdp.states) if _is_stable(mdp, blocks)]
    fewest = min(stable, key=lambda blocks: len(set(blocks)))
    assert list(minimise(mdp).block_of) == fewest


@pytest.mark.parametrize("seed", SEEDS[:30])
def test_names_order_and_irrelevant_features_do_not_change_the_blocks(seed: int) -> None:
    model = random_model(seed, max_states=100)
    mdp = enumerate_model(model)
    partition = minimise(mdp)

    other = relabel(model, seed)
    assert check(other) == []
    renamed = enumerate_model(other)
    assert (renamed.rows, renamed.rewards, renamed.terminal) == (mdp.rows, mdp.rewards, mdp.terminal)
    assert (renamed.applicable, renamed.initial) == (mdp.applicable, mdp.initial)
    assert {f.name for f in other.features}.isdisjoint(f.name for f in model.features)

    turned = enumerate_model(reorder(model, seed))
    positions = [[f.name for f in turned.features].index(f.name) for f in model.features]
    block_of = minimise(turned).block_of
    pairs = {
        (partition.block_of[mdp.index([values[i] for i in positions])], block_of[t])
        for t, values in enumerate(turned.state_values)
    }
    assert len(pairs) == partition.blocks == minimise(turned).blocks

    more = add_irrelevant_feature(model, seed)
    assert check(more) == []
    larger = enumerate_model(more)
    added = next(i for i, f in enumerate(more.features) if f.name == "irrelevant")
    projected = [mdp.index(values[:added] + values[added + 1 :]) for values in larger.state_values]
    blocks = minimise(larger)
    assert blocks.blocks == partition.blocks
    matched = {(blocks.block_of[s], partition.block_of[t]) for s, t in enumerate(projected)}
    assert len(matched) == partition.blocks

"""Interchangeable actions: against multisets and sets of signatures by enumeration; DESIGN 4's probes."""

from __future__ import annotations

from fractions import Fraction
from functools import cache
from random import Random

import numpy as np
import pytest
from changed_models import replace_action
from random_models import random_model

from factored_polca.diagrams import evaluate_states
from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.explicit.exact_dynamic_programming import optimal_solution
from factored_polca.explicit.exact_mdp import ExactMDP
from factored_polca.explicit.minimiser import minimise as minimise_named
from factored_polca.explicit.minimiser import minimise_interchangeable
from factored_polca.hierarchy import Options, plan
from factored_polca.hierarchy.evaluation import expectation
from factored_polca.hierarchy.executable import composed_policy, executable
from factored_polca.hierarchy.plan import plan_mdp
from factored_polca.library import load
from factored_polca.minimisation import (
    Choice,
    DecisionProcess,
    flat_process,
    interchangeable_quotient,
    minimise,
    reduce,
)
from factored_polca.minimisation.criterion import policy_primitives
from factored_polca.models import (
    Action,
    Constant,
    Feature,
    Model,
    ModelError,
    Switch,
    boolean,
    conditional,
    conjunction,
    lottery,
)
from factored_polca.models.model import replace_fields
from factored_polca.solvers import solve_mdp
from factored_polca.symbolic import SymbolicModel, compile_model

SEEDS = range(100)


def copied_actions(seed: int) -> Model:
    """A random model, some of its actions there twice under other names and in another order."""
    model, random = random_model(seed), Random(f"copies {seed}")
    copies = [replace_action(a, name=f"{a.name}_again") for a in model.actions if random.random() < 0.5]
    actions = [*model.actions, *copies]
    return replace_fields(model, actions=tuple(random.sample(actions, len(actions))))


def permuted_actions(seed: int) -> Model:
    """Two or three copies of a random component, each with the same actions of its own, in any order."""
    random = Random(f"components {seed}")
    size, count = random.randint(2, 3), random.randint(2, 3)
    parts = [Feature(f"part_{i}", range(size)) for i in range(count)]

    def rows() -> list[list[Fraction]]:
        drawn = [[random.choice((0, 1, 1, 2, 3)) for _ in range(size)] for _ in range(size)]
        return [
            [Fraction(n, sum(row) or 1) if sum(row) else Fraction(1, size) for n in row] for row in drawn
        ]

    def moved(part: Feature, table: list[list[Fraction]]) -> Switch:
        cases = [(v, lottery({t: q for t, q in enumerate(table[v]) if q})) for v in range(size)]
        return Switch(part.now, tuple(cases))

    rest, kinds = rows(), [(rows(), random.randint(-3, 0)) for _ in range(random.randint(1, 2))]
    actions = [
        Action(f"act_{i}_{k}", {p: moved(p, table if p is part else rest) for p in parts}, rewards=cost)
        for i, part in enumerate(parts)
        for k, (table, cost) in enumerate(kinds)
    ]
    worth = [random.randint(-2, 4) for _ in range(size)]
    return Model(
        f"components-{seed}",
        parts,
        random.sample(actions, len(actions)),
        rewards=[Switch(p.now, tuple((v, Constant(w)) for v, w in enumerate(worth))) for p in parts],
        terminal=conjunction([p.is_(0) for p in parts]) if random.random() < 0.4 else False,
    )


@cache
def case(seed: int) -> tuple[SymbolicModel, ExactMDP]:
    """Duplicated actions in even cases, permuted ones in odd ones."""
    model = permuted_actions(seed) if seed % 2 else copied_actions(seed)
    return compile_model(model), enumerate_model(model)


def states(symbolic: SymbolicModel, exact: ExactMDP) -> np.typing.NDArray[np.int32]:
    features = symbolic.model.features
    rows = [[f.index(v) for f, v in zip(features, s, strict=True)] for s in exact.state_values]
    return np.array(rows, dtype=np.int32)


def renumbered(blocks: object) -> list[int]:
    numbers: dict[int, int] = {}
    return [numbers.setdefault(int(b), len(numbers)) for b in blocks]  # type: ignore[attr-defined]


@pytest.mark.parametrize("seed", SEEDS)
def test_the_partition_is_that_of_multisets_and_never_coarser_than_that_of_sets(seed: int) -> None:
    symbolic, exact = case(seed)
    found = minimise(flat_process(symbolic), seed=seed, interchangeable=True).partition
    blocks = renumbered(evaluate_states(found.diagram, states(symbolic, exact), symbolic.columns()))
    assert blocks == list(minimise_interchangeable(exact).block_of)
    by_sets = minimise_interchangeable(exact, as_sets=True).block_of
    assert len(set(zip(blocks, by_sets, strict=True))) == found.blocks
    named = minimise_named(exact).block_of
    assert len(set(zip(named, blocks, strict=True))) == len(set(named))


@pytest.mark.parametrize("seed", SEEDS)
def test_the_lifted_policy_earns_on_the_model_what_it_earns_on_the_quotient(seed: int) -> None:
    symbolic, _ = case(seed)
    process = flat_process(symbolic)
    partition = minimise(process, seed=seed, interchangeable=True).partition
    quotient = interchangeable_quotient(process, partition, seed=seed)
    solution = solve_mdp(quotient.mdp)
    value = expectation(quotient.project_initial(), solution.values)
    plain = reduce(process)
    optimum = solve_mdp(plain.quotient.mdp)
    assert value == pytest.approx(expectation(plain.project_initial(), optimum.values), rel=1e-7, abs=1e-7)
    policy = quotient.lift_policy(solution.policy.astype(np.int64))
    count = len(symbolic.actions)
    defined = ~policy.equals(symbolic.manager.constant(count))
    taken = policy_primitives(policy, defined, count)
    rewards = {p: symbolic.actions[p].rewards for p in taken}
    chain = DecisionProcess(
        symbolic, (Choice("lifted", defined, taken, policy),), symbolic.terminal, rewards
    )
    if value > -np.inf:
        lifted = reduce(chain)
        earned = solve_mdp(lifted.quotient.mdp)
        assert expectation(lifted.project_initial(), earned.values) == pytest.approx(
            value, rel=1e-7, abs=1e-7
        )


def test_the_random_models_exercise_merging_by_names_and_by_multisets() -> None:
    merged = differs = 0
    for seed in SEEDS:
        _, exact = case(seed)
        by_multisets = minimise_interchangeable(exact).blocks
        merged += by_multisets < minimise_named(exact).blocks
        differs += minimise_interchangeable(exact, as_sets=True).blocks < by_multisets
    assert merged >= 40
    assert differs >= 1


def machines(count: int, ring: bool) -> Model:
    """Machines with a reboot each; in a ring one that is down makes the next one fail more often."""
    ups = [boolean(f"up_{i}") for i in range(count)]

    def drift(i: int) -> object:
        stays = lottery({True: "0.9", False: "0.1"})
        if ring:
            stays = conditional(ups[i - 1], stays, lottery({True: "0.6", False: "0.4"}))
        return conditional(ups[i], stays, lottery({True: "0.1", False: "0.9"}))

    def effects(rebooted: int | None) -> dict[object, object]:
        return {up: True if i == rebooted else drift(i) for i, up in enumerate(ups)}

    reboots = [Action(f"reboot_{i}", effects(i), rewards=-1) for i in range(count)]  # type: ignore[arg-type]
    noop = Action("noop", effects(None))  # type: ignore[arg-type]
    return Model("machines", ups, [noop, *reboots], rewards=[conditional(up, 1, 0) for up in ups])


@pytest.mark.parametrize(("count", "ring", "blocks"), [(10, False, 11), (30, False, 31), (10, True, 108)])
def test_identical_machines_are_counted_and_those_in_a_ring_turned(
    count: int, ring: bool, blocks: int
) -> None:
    """n + 1 numbers of machines that are up; 108 necklaces of ten beads in two colours (MacMahon)."""
    process = flat_process(compile_model(machines(count, ring)))
    assert minimise(process, interchangeable=True).partition.blocks == blocks


def test_rewards_that_differ_are_never_confused() -> None:
    model = machines(2, ring=False)
    dear = [replace_action(a, rewards=[-2]) if a.name == "reboot_1" else a for a in model.actions]
    process = flat_process(compile_model(replace_fields(model, actions=tuple(dear))))
    assert minimise(process, interchangeable=True).partition.blocks == 4


def test_tiger_does_not_exchange_its_doors() -> None:
    """Which door to open is what one does not know: exchanging them would give the answer away."""
    process = flat_process(compile_model(load("tiger", {}).model))
    with pytest.raises(ModelError, match="a state that is seen"):
        minimise(process, interchangeable=True)
    with pytest.raises(ModelError, match="a state that is seen"):
        interchangeable_quotient(process, minimise(process).partition)


# -- plans ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("seeds", [range(start, start + 10) for start in range(0, 40, 10)], ids=str)
def test_a_plan_with_exchanged_actions_earns_the_optimum_of_the_named_ones(seeds: range) -> None:
    done = 0
    for seed in seeds:
        model = copied_actions(seed) if seed % 2 else permuted_actions(seed)
        mdp = enumerate_model(model)
        if (
            len(
                {
                    r
                    for row, app in zip(mdp.rewards, mdp.applicable, strict=True)
                    for r, here in zip(row, app, strict=True)
                    if here
                }
            )
            == 1
        ):
            continue  # nothing to optimise
        done += 1
        exact, start = optimal_solution(mdp), mdp.initial
        found = plan_mdp(model, options=Options(interchangeable=True, seed=seed))
        expected = sum(float(b * v) for b, v in zip(start, exact.values, strict=True) if b)
        assert found.polled.value == pytest.approx(expected, rel=1e-7, abs=1e-7), seed
        # what is executed, block by block, is the lifted policy
        made = executable(found)
        composed = composed_policy(found.symbolic, found.tasks, made.policies)
        assert composed == made.policy, seed
    assert done > 4


def test_a_plan_for_twenty_machines_reboots_one_that_is_down() -> None:
    model = load("sysadmin", {"size": "20", "topology": "independent"}).model
    found = plan_mdp(model, options=Options(interchangeable=True))
    assert found.root.reduction.partition.blocks == 21
    assert found.flat is not None
    assert found.flat.value == pytest.approx(found.polled.value, rel=1e-8)
    policy = executable(found)
    names = [action.name for action in model.actions]
    states = np.ones((21, 20), dtype=np.int32)
    for machine in range(20):
        states[machine, machine] = 0
    taken = evaluate_states(policy.policy, states, found.symbolic.columns()).tolist()
    assert [names[a] for a in taken[:20]] == [f"reboot_{machine}" for machine in range(20)]


def test_plans_where_the_state_is_not_seen_do_not_exchange_actions() -> None:
    with pytest.raises(ModelError, match="interchangeable actions need a state that is seen"):
        plan(load("tiger").model, options=Options(interchangeable=True))

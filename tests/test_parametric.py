"""Models with parameters: one minimisation serves all settings, held against brute force at each.

The other reading of each setting is the model with numbers in place of its parameters, enumerated state by
state, its coarsest partition by signatures written out in full, its value by value iteration.
"""

from __future__ import annotations

from fractions import Fraction
from functools import cache

import numpy as np
import pytest
from parametric_models import generic, parametric_mdp, parametric_pomdp, settings

from factored_polca.diagrams import FLOAT, evaluate_states, relabel
from factored_polca.explicit import minimiser
from factored_polca.explicit.alpha_expansion import forward_values
from factored_polca.explicit.dynamic_programming import action_values, evaluate_policy, lost_states
from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.explicit.exact_mdp import ExactMDP
from factored_polca.explicit.exact_pomdp import ExactPOMDP, enumerate_pomdp
from factored_polca.minimisation import Reduction
from factored_polca.models import Action, Model, boolean, lottery, parse
from factored_polca.parametric import (
    ParametricQuotient,
    parametric_flat_process,
    reduce_parametric,
)
from factored_polca.solvers.choose import solve_mdp
from factored_polca.symbolic import NumericView

MODELS = 30  # of each kind
SETTINGS = 20


@cache
def reduced(kind: str, seed: int) -> tuple[Model, ParametricQuotient]:
    model = (parametric_mdp if kind == "mdp" else parametric_pomdp)(seed)
    return model, reduce_parametric(parametric_flat_process(model), seed=seed)


def enumerated(model: Model, values: dict[str, Fraction]) -> ExactMDP | ExactPOMDP:
    instance = model.with_parameters(values)
    return enumerate_model(instance) if model.observability == "full" else enumerate_pomdp(instance)


def brute_force(exact: ExactMDP | ExactPOMDP) -> tuple[int, ...]:
    """The coarsest stable partition: the block of each state."""
    if isinstance(exact, ExactMDP):
        return minimiser.minimise(exact).block_of
    return minimiser.minimise_pomdp(exact).block_of


def blocks_of(quotient: ParametricQuotient, exact: ExactMDP | ExactPOMDP) -> np.ndarray:
    """The quotient's block of each enumerated state."""
    symbolic = quotient.process.process.symbolic

    digits = [[f.index(v) for f, v in zip(exact.features, s, strict=True)] for s in exact.state_values]
    states = np.array(digits, dtype=np.int32)
    return evaluate_states(quotient.partition.diagram, states, symbolic.columns()).astype(np.int64)


def refines(fine: list[int], coarse: tuple[int, ...]) -> bool:
    """Whether each class of `fine` lies in one of `coarse`."""
    return len(set(zip(fine, coarse, strict=True))) == len(set(fine))


CASES = [(kind, seed) for kind in ("mdp", "pomdp") for seed in range(MODELS)]


@pytest.mark.parametrize(("kind", "seed"), CASES)
def test_the_partition_is_the_coarsest_at_a_generic_setting(kind: str, seed: int) -> None:
    model, quotient = reduced(kind, seed)
    for draw in range(2):
        exact = enumerated(model, generic(100 * seed + draw))
        mine, coarse = blocks_of(quotient, exact).tolist(), brute_force(exact)
        assert refines(mine, coarse)
        assert len(set(mine)) == len(set(coarse)) == quotient.partition.blocks


@pytest.mark.parametrize(("kind", "seed"), CASES)
def test_the_instance_is_the_quotient_of_the_instantiated_model_or_finer(kind: str, seed: int) -> None:
    model, quotient = reduced(kind, seed)
    for number, values in enumerate(settings(seed, SETTINGS)):
        exact = enumerated(model, values)
        block = blocks_of(quotient, exact).tolist()
        assert refines(block, brute_force(exact)), values
        check_rows(quotient, exact, block, values, exactly=number % 5 == 0)
        if isinstance(exact, ExactMDP):
            check_values(quotient, exact, block, values)
        else:
            check_forward(quotient, exact, block, values, seed)


@pytest.mark.parametrize(
    ("kind", "seed"), [(kind, seed) for kind in ("mdp", "pomdp") for seed in range(12)]
)
def test_the_reduction_at_a_setting_is_the_same_process_and_lifts_policies(kind: str, seed: int) -> None:
    model, quotient = reduced(kind, seed)
    for values in settings(seed, 3):
        reduction = quotient.reduction(values)
        one, other = (
            (reduction.mdp, quotient.mdp(values)) if kind == "mdp"
            else (reduction.pomdp_quotient.pomdp.to_mdp(), quotient.pomdp(values).to_mdp())
        )  # fmt: skip
        for a in range(len(one.actions)):
            difference = one.transitions[a].toarray() - other.transitions[a].toarray()
            assert np.abs(difference).max() < 1e-12
        np.testing.assert_allclose(one.rewards, other.rewards, rtol=1e-12, atol=1e-12)
        if kind == "mdp":
            check_lifted(reduction, enumerated(model, values), quotient)


def check_lifted(reduction: Reduction, exact: ExactMDP, quotient: ParametricQuotient) -> None:
    """The optimal policy of the instance, at every state, earns its value there."""
    solution = solve_mdp(reduction.mdp, epsilon=1e-12)
    block = blocks_of(quotient, exact).tolist()
    flat = exact.to_arrays()
    policy = [int(solution.policy[b]) for b in block]
    live = ~np.isneginf(solution.values[block])
    earned = evaluate_policy(flat, policy)
    np.testing.assert_allclose(earned[live], solution.values[block][live], rtol=1e-9, atol=1e-9)
    lifted = reduction.lift_policy(solution.policy)
    symbolic = reduction.process.symbolic
    digits = [[f.index(v) for f, v in zip(exact.features, s, strict=True)] for s in exact.state_values]
    taken = evaluate_states(lifted, np.array(digits, dtype=np.int32), symbolic.columns())
    assert [int(a) for a in taken] == [len(flat.actions) if a < 0 else a for a in policy]


def check_rows(
    quotient: ParametricQuotient,
    exact: ExactMDP | ExactPOMDP,
    block: list[int],
    values: dict[str, Fraction],
    exactly: bool,
) -> None:
    """The rows and rewards of the instance are those of every state of the block."""
    rows = exact.rows if isinstance(exact, ExactMDP) else exact.kernel
    mdp = quotient.mdp(values) if isinstance(exact, ExactMDP) else quotient.pomdp(values).to_mdp()
    for a in range(len(exact.actions)):
        dense = mdp.transitions[a].toarray()
        known: dict[int, dict[int, Fraction]] = {}
        for s, b in enumerate(block):
            sums: dict[int, Fraction] = {}
            for key, chance in rows[a][s].items():
                target = block[key[0] if isinstance(key, tuple) else key]
                sums[target] = sums.get(target, Fraction(0)) + chance
            assert known.setdefault(b, sums) == sums
            expected = np.zeros(len(dense))
            for target, chance in sums.items():
                expected[target] = float(chance)
            np.testing.assert_allclose(dense[b], expected, rtol=0, atol=1e-12)
            assert mdp.rewards[a, b] == pytest.approx(float(exact.rewards[a][s]), rel=1e-12, abs=1e-12)
            assert mdp.terminal[b] == exact.terminal[s]
            if isinstance(exact, ExactMDP):
                assert mdp.applicable[a, b] == exact.applicable[a][s]
        if exactly:
            for b, sums in known.items():
                found: dict[int, Fraction] = {}
                for (target, _), chance in quotient.exact_row(a, b, values).items():
                    found[target] = found.get(target, Fraction(0)) + chance
                assert found == sums
                assert quotient.exact_reward(a, b, values) == exact.rewards[a][block.index(b)]
    initial = np.zeros(quotient.partition.blocks)
    for s, chance in enumerate(exact.initial):
        initial[block[s]] += float(chance)
    np.testing.assert_allclose(quotient.initial_distribution(values), initial, rtol=0, atol=1e-12)


def check_values(
    quotient: ParametricQuotient, exact: ExactMDP, block: list[int], values: dict[str, Fraction]
) -> None:
    """The optimal values of the instance are those of the states, to 1e-9 of the largest.

    A function v with max_a Q(v) = v within e is within e / (1 - discount) of the only one that has e = 0.
    """
    flat = exact.to_arrays()
    found = solve_mdp(quotient.mdp(values), epsilon=1e-12).values[block]
    lost = lost_states(flat)
    assert np.array_equal(np.isneginf(found), lost)
    backed = np.where(flat.terminal, 0.0, action_values(flat, found).max(axis=0))
    scale = max(1.0, float(np.abs(found[~lost]).max(initial=0.0)))
    assert np.abs(backed - found)[~lost].max(initial=0.0) <= 1e-9 * scale * (1 - flat.discount)


def check_forward(
    quotient: ParametricQuotient,
    exact: ExactPOMDP,
    block: list[int],
    values: dict[str, Fraction],
    seed: int,
) -> None:
    """The optimal values of two steps from b0 and from random beliefs are those of the model."""
    flat, small = exact.to_arrays(), quotient.pomdp(values)
    generator = np.random.default_rng(seed)
    beliefs = np.vstack([flat.initial, generator.dirichlet(np.full(flat.states, 0.4), size=2)])
    beliefs[1:] = [_seen_alike(belief, flat.observed) for belief in beliefs[1:]]
    projected = np.zeros((len(beliefs), small.states))
    for s, b in enumerate(block):
        projected[:, b] += beliefs[:, s]
    wanted, found = (forward_values(*pair, 2) for pair in ((flat, beliefs), (small, projected)))
    np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-9)


def _seen_alike(belief: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """The part of a belief on what is seen of its likeliest state, as a belief."""
    part = np.where(observed == observed[belief.argmax()], belief, 0.0)
    return part / part.sum()


def test_settings_that_share_a_manager_are_not_confused() -> None:
    """Regressions are remembered by action: each setting's numbers must count as another model's."""
    x = boolean("x")
    chance = parse("p")
    model = Model(
        "coin", [x], [Action("toss", {x: lottery({True: chance, False: 1 - chance})})],
        rewards=["1 if x else 0"], initial={x: False}, discount="0.5", parameters={"p": Fraction(1, 3)},
    )  # fmt: skip
    process = parametric_flat_process(model)
    for setting in (Fraction(1, 4), Fraction(3, 4), Fraction(0), Fraction(1), Fraction(1, 4)):
        symbolic = process.at({"p": setting}).symbolic
        manager = symbolic.manager
        on = relabel(manager.indicator(symbolic.now(0), [1]), np.array([0.0, 1.0]), FLOAT)
        assert NumericView(symbolic).regress(0, on) == manager.constant(float(setting), FLOAT)

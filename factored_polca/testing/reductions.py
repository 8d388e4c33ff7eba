"""`check_reduction`: whether a reduction's quotient and its ways there and back are right, state by state.

The oracle is the enumeration of the model in exact rationals; what choice c stands for in state s, and
what it earns there, is read off the decision process.  With C(s) the block of s, for each s that goes on

    sum over t in block k, o merged into m, of K_c(s; t, o) = K_c(C(s); k, m),    R_c(s) = R_c(C(s)).
"""

from __future__ import annotations

from collections import defaultdict
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import evaluate_states
from factored_polca.explicit.belief import ImpossibleObservation
from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.explicit.exact_pomdp import enumerate_pomdp
from factored_polca.minimisation import PomdpQuotient, Reduction
from factored_polca.minimisation.quotient import exact_rewards, primitives_at
from factored_polca.symbolic import SymbolicModel

MOST_STATES = 5_000
TOLERANCE = 1e-11

Joint: TypeAlias = tuple[tuple[dict[tuple[int, int], float], ...], ...]
"""[primitive][s] -> (next state, joint observation) -> probability."""


def check_reduction(
    reduction: Reduction, *, maximum_states: int = MOST_STATES, tolerance: float = TOLERANCE
) -> None:
    """Whether a reduction keeps what its process does, by enumeration of all states.

    Each state's block; terminal flags, rows and rewards of the quotient; the initial belief over
    blocks; and, carried back, values and policies.

    Raises:
        AssertionError: with the state, the choice and the two numbers.
        LimitReached: more than `maximum_states` states.
    """
    process, partition = reduction.process, reduction.partition
    symbolic, columns = process.symbolic, process.symbolic.columns()
    joint, initial, labels = _enumerated(symbolic, maximum_states)
    sizes = [len(feature.values) for feature in symbolic.model.features]
    count = int(np.prod(sizes))
    states = np.stack(np.unravel_index(np.arange(count), sizes), axis=1).astype(np.int32)
    blocks = reduction.project_states(states)
    inside = blocks < partition.blocks
    found = np.bincount(blocks[inside], minlength=partition.blocks)
    assert found.tolist() == list(partition.sizes), (
        "the states of the blocks, counted one by one, are not those that the partition says"
    )
    terminal = evaluate_states(process.terminal, states, columns).astype(np.bool_)
    quotient = reduction.quotient.mdp
    for s in np.flatnonzero(inside).tolist():
        assert terminal[s] == quotient.terminal[blocks[s]], (
            f"state {_named(symbolic, states[s])} is {'' if terminal[s] else 'not '}terminal, other than "
            f"its block {blocks[s]}"
        )
    mass = np.bincount(blocks[inside], initial[inside], minlength=partition.blocks)
    off = np.abs(mass - reduction.project_initial())
    assert off.max(initial=0.0) <= tolerance, (
        f"the initial belief over blocks is wrong in block {int(off.argmax())} by {off.max():.3g}"
    )
    for number, choice in enumerate(process.choices):
        primitive = primitives_at(choice, states, columns)
        primitive[terminal | ~inside] = -1
        _check_choice(reduction, number, primitive, states, blocks, joint, labels, tolerance)
    _check_lifts(reduction, states, blocks, inside)


def _enumerated(symbolic: SymbolicModel, most: int) -> tuple[Joint, npt.NDArray[np.float64], list[Any]]:
    """The joint rows of the primitives, b0 [s], and the joint observations as {channel: value}."""
    model = symbolic.model
    if model.observability == "full":
        mdp = enumerate_model(model, maximum_states=most)
        rows = tuple(tuple({(t, 0): float(p) for t, p in row.items()} for row in a) for a in mdp.rows)
        return rows, np.array(mdp.initial, dtype=np.float64), [{}]
    pomdp = enumerate_pomdp(model, maximum_states=most)
    labels = [
        {c.name: v for c, v in zip(pomdp.channels, values, strict=True)} for values in pomdp.observations
    ]
    kernel = tuple(tuple({key: float(p) for key, p in row.items()} for row in a) for a in pomdp.kernel)
    return kernel, np.array(pomdp.initial, dtype=np.float64), labels


def _check_choice(
    reduction: Reduction,
    number: int,
    primitive: npt.NDArray[np.int32],
    states: npt.NDArray[np.int32],
    blocks: npt.NDArray[np.int64],
    joint: Joint,
    labels: list[Any],
    tolerance: float,
) -> None:
    quotient, process = reduction.quotient, reduction.process
    name = process.names[number]
    seen, matrices = True, (quotient.mdp.transitions[number],)
    if isinstance(quotient, PomdpQuotient):
        seen, matrices = False, quotient.pomdp.kernel[number]
    rows = [matrix.toarray() for matrix in matrices]
    merged: dict[int, int] = {}
    for p in np.unique(primitive[primitive >= 0]).tolist():
        mine = np.flatnonzero(primitive == p)
        rewards = np.array([float(r) for r in exact_rewards(process, p, states[mine])])
        for s, reward in zip(mine.tolist(), rewards.tolist(), strict=True):
            block = int(blocks[s])
            where = f"choice {name!r} in state {_named(process.symbolic, states[s])} (block {block})"
            told = float(quotient.mdp.rewards[number, block])
            assert abs(reward - told) <= tolerance * max(1.0, abs(reward)), (
                f"{where} earns {reward:.9g}, its block {told:.9g}"
            )
            expected: dict[tuple[int, int], float] = defaultdict(float)
            for (t, o), chance in joint[p][s].items():
                if o not in merged:
                    merged[o] = 0 if seen else _merged(reduction.pomdp_quotient, number, labels[o], where)
                expected[int(blocks[t]), merged[o]] += chance
            for m, row in enumerate(rows):
                for k in {*np.flatnonzero(row[block]).tolist(), *(k for k, o in expected if o == m)}:
                    right, given = expected.get((k, m), 0.0), float(row[block, k])
                    assert abs(right - given) <= tolerance, (
                        f"{where} leads to block {k} with observation {m} with probability {right:.9g}, "
                        f"its block with {given:.9g}"
                    )
    stands = quotient.primitive[number, blocks[blocks < reduction.partition.blocks]] >= 0
    applies = primitive[blocks < reduction.partition.blocks] >= 0
    assert np.array_equal(stands, applies), (
        f"choice {name!r} applies in other states than its quotient says"
    )


def _merged(quotient: PomdpQuotient, choice: int, values: dict[str, Any], where: str) -> int:
    try:
        return quotient.observation_of(choice, values)
    except ImpossibleObservation as error:
        raise AssertionError(f"{where}: {error}, though it does") from error


def _check_lifts(
    reduction: Reduction,
    states: npt.NDArray[np.int32],
    blocks: npt.NDArray[np.int64],
    inside: npt.NDArray[np.bool_],
) -> None:
    """A function of blocks, carried back, is that function of a state's block; so is a policy."""
    process, count = reduction.process, reduction.partition.blocks
    columns, random = process.symbolic.columns(), np.random.default_rng(0)
    values = random.normal(size=count)
    lifted = evaluate_states(reduction.lift_values(values), states, columns).view(np.float64)
    assert np.allclose(lifted[inside], values[blocks[inside]], rtol=1e-12, atol=1e-12), (
        "lifted values are not those of the states' blocks"
    )
    primitive = reduction.quotient.primitive
    policy = np.array([_any(np.flatnonzero(primitive[:, b] >= 0), random) for b in range(count)])
    actions = evaluate_states(reduction.lift_policy(policy), states, columns).astype(np.int64)
    for number, choice in enumerate(process.choices):
        mine = np.flatnonzero(inside & (policy[np.where(inside, blocks, 0)] == number))
        expected = primitives_at(choice, states[mine], columns)
        assert np.array_equal(actions[mine], expected), (
            f"a lifted policy takes other actions than {process.names[number]!r} stands for"
        )
    idle = inside & (policy[np.where(inside, blocks, 0)] < 0)
    assert (actions[idle] == len(process.symbolic.actions)).all(), "a lifted policy acts where it has none"


def _any(choices: npt.NDArray[np.int64], random: np.random.Generator) -> int:
    return int(random.choice(choices)) if len(choices) else -1


def _named(symbolic: SymbolicModel, state: npt.NDArray[np.int32]) -> str:
    pairs = zip(symbolic.model.features, state.tolist(), strict=True)
    return ", ".join(f"{feature.name}={feature.values[value]}" for feature, value in pairs)

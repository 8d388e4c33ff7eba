"""Policies as named arrays, and back: every number is checked against the POMDP that they are for.

    alpha, staged   `set_states`, `set_actions`, `set_vectors`: the sets of vectors one after the other,
                    each its states [i], actions [n] and vectors [n, i] row by row; `set_sizes` [set, 2]
                    the pairs (i, n); `stage_sets` [h] how many sets belong to stage h (alpha: one stage)
    graph           `actions` [n], `start` [y], `successors`: [o, y] of node 0, of node 1, ...
    entropy         `actions` [s, bin]
    mdp             `actions` [h, s], -1 where there is nothing to do

`head` holds what is no array: "meanings" [h] of alpha and staged, "staged" of mdp.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt

from factored_polca.explicit.alpha_vectors import AlphaSet, AlphaVectors, Meaning, StagedVectors
from factored_polca.explicit.arrays import IntArray
from factored_polca.explicit.entropy_policy import EntropyPolicy
from factored_polca.explicit.policies import AnyPolicy
from factored_polca.explicit.policy_graph import PolicyGraph
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.explicit.state_policy import StatePolicy
from factored_polca.formats.archive import Archive

Kind = Literal["alpha", "staged", "graph", "entropy", "mdp"]
KINDS: Final[tuple[Kind, ...]] = get_args(Kind)


class Stored(NamedTuple):
    """A policy in the form of a file."""

    kind: Kind
    head: Mapping[str, Any]
    arrays: Mapping[str, npt.NDArray[Any]]


def stored_policy(policy: AnyPolicy) -> Stored:
    """`policy` as arrays."""
    match policy:
        case AlphaVectors():
            return _stored_stages("alpha", [policy])
        case StagedVectors():
            return _stored_stages("staged", policy.stages)
        case PolicyGraph():
            successors = [np.asarray(table, dtype=np.int64).ravel() for table in policy.successors]
            arrays = {"actions": policy.actions, "start": policy.start, "successors": _joined(successors)}
            return Stored("graph", {}, arrays)
        case EntropyPolicy():
            return Stored("entropy", {}, {"actions": policy.actions})
        case StatePolicy():
            return Stored("mdp", {"staged": policy.staged}, {"actions": policy.actions})


def _stored_stages(kind: Kind, stages: Sequence[AlphaVectors]) -> Stored:
    sets = [part for stage in stages for part in stage.sets]
    sizes = [(len(part.states), len(part.actions)) for part in sets]
    arrays = {
        "stage_sets": np.array([len(stage.sets) for stage in stages], dtype=np.int64),
        "set_sizes": np.array(sizes, dtype=np.int64).reshape(-1, 2),
        "set_states": _joined([part.states for part in sets]),
        "set_actions": _joined([part.actions for part in sets]),
        "set_vectors": np.concatenate([np.empty(0), *(part.vectors.ravel() for part in sets)]),
    }
    return Stored(kind, {"meanings": [stage.meaning for stage in stages]}, arrays)


def _joined(pieces: Sequence[IntArray]) -> IntArray:
    return np.concatenate([np.empty(0, dtype=np.int64), *pieces])


def read_policy(kind: object, head: Mapping[str, Any], archive: Archive, pomdp: ArrayPOMDP) -> AnyPolicy:
    """The policy for `pomdp` in an archive.

    Raises:
        ValueError: anything that is no policy for it.
        KeyError: something is missing.
    """
    match kind:
        case "alpha" | "staged":
            stages = _stages(head, archive, pomdp)
            if kind == "staged":
                return StagedVectors(stages)
            if len(stages) != 1:
                raise ValueError("a policy of vectors has one stage")
            return stages[0]
        case "graph":
            return _graph(archive, pomdp)
        case "entropy":
            return _entropy(archive, pomdp)
        case "mdp":
            return _state_policy(head, archive, pomdp)
        case _:
            raise ValueError(f"no kind of policy: {str(kind)[:80]!r}; there are {', '.join(KINDS)}")


def _stages(head: Mapping[str, Any], archive: Archive, pomdp: ArrayPOMDP) -> tuple[AlphaVectors, ...]:
    counts = archive.array("stage_sets", "integers")
    sizes = archive.array("set_sizes", "integers", 2)
    states, actions = archive.array("set_states", "integers"), archive.array("set_actions", "integers")
    vectors = archive.array("set_vectors", "numbers")
    meanings = head["meanings"]
    if not isinstance(meanings, list) or not set(meanings) <= set(get_args(Meaning)):
        raise ValueError("a stage means none of what it may")
    if len(counts) == 0 or len(meanings) != len(counts) or sizes.shape[1] != 2:
        raise ValueError("the stages are not counted rightly")
    if len(sizes) and (sizes.min() < 1 or sizes.max() > 1 << 31):
        raise ValueError("a set of vectors is empty or too large")
    if counts.min() < 0 or counts.max() > pomdp.states or counts.sum() != len(sizes):
        raise ValueError("the sets of vectors are not counted rightly")
    wanted = [int(sizes[:, 0].sum()), int(sizes[:, 1].sum()), int((sizes[:, 0] * sizes[:, 1]).sum())]
    if [len(states), len(actions), len(vectors)] != wanted:
        raise ValueError("the sets of vectors have not the sizes they are said to have")
    _check_range("a state", states, 0, pomdp.states)
    _check_range("an action", actions, 0, len(pomdp.actions))
    sets = [
        AlphaSet(states[s : s + i], vectors[v : v + i * n].reshape(n, i), actions[a : a + n])
        for i, n, s, a, v in zip(
            *sizes.T.tolist(), _starts(sizes[:, 0]), _starts(sizes[:, 1]),
            _starts(sizes[:, 0] * sizes[:, 1]), strict=True,
        )
    ]  # fmt: skip
    stages = []
    for meaning, first, count in zip(meanings, _starts(counts), counts.tolist(), strict=True):
        stage = AlphaVectors(pomdp.states, tuple(sets[first : first + count]), meaning)
        _check_stage(stage, pomdp)
        stages.append(stage)
    return tuple(stages)


def _starts(counts: IntArray) -> list[int]:
    starts: list[int] = (np.cumsum(counts) - counts).tolist()
    return starts


def _check_stage(stage: AlphaVectors, pomdp: ArrayPOMDP) -> None:
    """Each set over ascending states with one y, each y in one set."""
    known: set[int] = set()
    for part in stage.sets:
        seen = pomdp.observed[part.states]
        if np.any(seen != seen[0]) or np.any(np.diff(part.states) <= 0):
            raise ValueError("a set of vectors is over states that are told apart, or out of order")
        if int(seen[0]) in known:
            raise ValueError("two sets of vectors are for states that are not told apart")
        known.add(int(seen[0]))


def _graph(archive: Archive, pomdp: ArrayPOMDP) -> PolicyGraph:
    actions, start = archive.array("actions", "integers"), archive.array("start", "integers")
    flat = archive.array("successors", "integers")
    if len(actions) == 0 or len(start) <= int(pomdp.observed.max()):
        raise ValueError("a policy graph has no node, or not enough first nodes")
    _check_range("an action", actions, 0, len(pomdp.actions))
    _check_range("a first node", start, -1, len(actions))
    _check_range("a node", flat, -1, len(actions))
    widths = np.array([len(names) for names in pomdp.observations])[actions] * len(start)
    if len(flat) != widths.sum():
        raise ValueError("a policy graph has not a successor for everything that may be observed")
    tables = np.split(flat, np.cumsum(widths)[:-1])
    return PolicyGraph(actions, tuple(table.reshape(-1, len(start)) for table in tables), start)


def _entropy(archive: Archive, pomdp: ArrayPOMDP) -> EntropyPolicy:
    actions = archive.array("actions", "integers", 2)
    if actions.shape[0] != pomdp.states or actions.shape[1] < 1:
        raise ValueError("an action is missing for a state, or there are no bins")
    _check_range("an action", actions, 0, len(pomdp.actions))
    return EntropyPolicy(actions)


def _state_policy(head: Mapping[str, Any], archive: Archive, pomdp: ArrayPOMDP) -> StatePolicy:
    actions = archive.array("actions", "integers", 2)
    staged = head["staged"]
    if not isinstance(staged, bool) or len(actions) < 1 or (len(actions) > 1 and not staged):
        raise ValueError("the stages of a policy are not counted rightly")
    if actions.shape[1] != pomdp.states:
        raise ValueError("a policy for another number of states")
    if len(np.unique(pomdp.observed)) != pomdp.states:
        raise ValueError("a policy of states, which the model does not let see")
    _check_range("an action", actions, -1, len(pomdp.actions))
    for number, matrices in enumerate(pomdp.kernel):
        applies = sum(np.diff(matrix.indptr) for matrix in matrices) > 0
        if np.any((actions == number) & ~applies):
            raise ValueError(f"the policy takes {pomdp.actions[number]!r} where it does not apply")
    return StatePolicy(actions, staged)


def _check_range(what: str, numbers: IntArray, least: int, end: int) -> None:
    if numbers.size and not (numbers.min() >= least and numbers.max() < end):
        raise ValueError(f"{what} has a number that is out of range")

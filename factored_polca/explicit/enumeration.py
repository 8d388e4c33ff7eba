"""A model's MDP by enumeration of its states, in exact rationals.

States are the tuples of the product of the features' values in file order, the last feature running
fastest.  For each applicable action a at a non-terminal state x

    T(x, a, x') = prod_i P_a(x_i' | x, parents among x'),   features in a topological order,
    R(x, a)     = sum over x' of T(x, a, x') * sum of the terms' values at (x, x', o), o in expectation.

Only what can happen counts: a fault at a terminal state, at a state where the action does not
apply, or in a context of probability 0 is no fault.  Plain and slow on purpose: this is one of two
independent readings of a model (`factored_polca.symbolic` is the other), and the oracle of the tests.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from fractions import Fraction
from itertools import product
from typing import Final, Generic, TypeAlias, TypeVar

from factored_polca.explicit.evaluate import Assignment, distribution, evaluate
from factored_polca.explicit.exact_mdp import ExactMDP, Row
from factored_polca.models.check import check
from factored_polca.models.errors import Fault, LimitReached, ModelError
from factored_polca.models.expressions import (
    Constant,
    Expression,
    ExpressionLike,
    as_expression,
    references,
)
from factored_polca.models.model import Action, Model, resolve, uniform
from factored_polca.models.scalars import Undefined, Value, describe, scalar

MAXIMUM_STATES: Final = 200_000
"""Largest number of states that is enumerated unless a caller says otherwise."""

Path: TypeAlias = tuple[str, ...]
Result = TypeVar("Result")


class Faults:
    """The first fault found at each place of the model."""

    def __init__(self) -> None:
        self.first: dict[Path, Fault] = {}

    def add(self, path: Path, reason: str, assignment: Assignment) -> None:
        shown = ", ".join(
            f"{name}{chr(39) * primed}={describe(scalar(value))}"
            for (name, primed), value in assignment.items()
        )
        self.first.setdefault(path, Fault(f"{reason}, at {shown}" if shown else reason, path))

    def raise_if_any(self) -> None:
        if self.first:
            raise ModelError(self.first.values())


class Memo(Generic[Result]):
    """A function of a state that reads only the references of an expression, computed once each."""

    def __init__(self, expression: Expression, compute: Callable[[Assignment], Result]) -> None:
        read = sorted((r.name, r.primed) for r in references(expression))
        self.read = tuple(read)
        self.compute = compute
        self.known: dict[tuple[object, ...], Result] = {}

    def __call__(self, assignment: Assignment) -> Result:
        values = [assignment[key] for key in self.read]
        # The type belongs to the key: True and 1 are different values but equal in Python.
        key = tuple((type(value), value) for value in values)
        if key not in self.known:
            self.known[key] = self.compute(assignment)
        return self.known[key]

    @property
    def reads_next(self) -> bool:
        return any(primed for _, primed in self.read)


DistributionMemo: TypeAlias = Memo[tuple[Fraction, ...] | Undefined]
NumberMemo: TypeAlias = Memo[Fraction | Undefined]


def _distribution_memo(model: Model, expression: Expression, values: tuple[Value, ...]) -> DistributionMemo:
    parameters = dict(model.parameters)
    return Memo(expression, lambda x: distribution(expression, values, x, parameters))


def _number_memo(model: Model, expression: Expression) -> NumberMemo:
    parameters = dict(model.parameters)

    def compute(x: Assignment) -> Fraction | Undefined:
        value = evaluate(expression, x, parameters)
        if isinstance(value, bool):  # a condition counts as 0 or 1
            return Fraction(int(value))
        if isinstance(value, (Fraction, Undefined)):
            return value
        shown = describe(value) if isinstance(value, str) else "a distribution"
        return Undefined(f"a number is needed, not {shown}")

    return Memo(expression, compute)


def condition_memo(model: Model, expression: Expression) -> Memo[bool | Undefined]:
    """A condition of the model as a function of a state."""
    parameters = dict(model.parameters)

    def compute(x: Assignment) -> bool | Undefined:
        value = evaluate(expression, x, parameters)
        if isinstance(value, (bool, Undefined)):
            return value
        return Undefined("a condition must be true or false")

    return Memo(expression, compute)


class ActionReader:
    """The rows and expected rewards of one action."""

    def __init__(
        self, model: Model, action: Action, terms: Sequence[tuple[Path, Expression]], faults: Faults
    ) -> None:
        self.path: Path = ("actions", action.name)
        self.features = model.features
        self.faults = faults
        effects = dict(action.effects)
        self.effects = {
            f.name: _distribution_memo(model, effects[f.name], f.values)
            for f in model.features
            if f.name in effects
        }
        parents = {name: {n for n, primed in memo.read if primed} for name, memo in self.effects.items()}
        self.order = _topological([f.name for f in model.features], parents)
        self.terms = [(path, _number_memo(model, term)) for path, term in terms]
        senses = dict(action.senses)
        self.channels = {
            o.name: (
                o.values,
                _distribution_memo(model, senses.get(o.name, Constant(scalar(o.null))), o.values),
            )
            for o in model.observations
        }

    def row(self, state: Assignment) -> Row | None:
        """T(x, a, .), or None where there is a fault."""
        values = {f.name: f.values for f in self.features}
        partial: list[tuple[dict[tuple[str, bool], Value], Fraction]] = [(dict(state), Fraction(1))]
        for name in self.order:
            extended = []
            for assignment, chance in partial:
                if name not in self.effects:
                    assignment[name, True] = assignment[name, False]
                    extended.append((assignment, chance))
                    continue
                cpd = self.effects[name](assignment)
                if isinstance(cpd, Undefined):
                    self.faults.add((*self.path, "effects", name), cpd.reason, assignment)
                    return None
                for value, share in zip(values[name], cpd, strict=True):
                    if share:
                        extended.append(({**assignment, (name, True): value}, chance * share))
            partial = extended
        row: Row = {}
        for assignment, chance in partial:
            number = 0
            for feature in self.features:
                digit = feature.index(assignment[feature.name, True])
                assert digit is not None
                number = number * len(feature.values) + digit
            row[number] = row.get(number, Fraction(0)) + chance
        return row

    def observe(self, before: Assignment, after: Assignment) -> dict[tuple[int, ...], Fraction] | None:
        """The joint distribution of the channels' value numbers after a step, or None at a fault."""
        x = {**before, **{(name, True): value for (name, _), value in after.items()}}
        joint: dict[tuple[int, ...], Fraction] = {(): Fraction(1)}
        for name, (_, memo) in self.channels.items():
            chances = memo(x)
            if isinstance(chances, Undefined):
                self.faults.add((*self.path, "senses", name), chances.reason, x)
                return None
            joint = {
                (*seen, value): share * chance
                for seen, share in joint.items()
                for value, chance in enumerate(chances)
                if chance
            }
        return joint

    def reward(self, state: Assignment, row: Row, states: Sequence[Assignment]) -> Fraction:
        """R(x, a): the terms' expected sum."""
        total = Fraction(0)
        for path, term in self.terms:
            observed = [name for name in self.channels if (name, False) in term.read]
            if not term.reads_next and not observed:
                total += self._expected(path, term, state, observed)
                continue
            for t, chance in row.items():
                after = {(name, True): value for (name, _), value in states[t].items()}
                total += chance * self._expected(path, term, {**state, **after}, observed)
        return total

    def _expected(self, path: Path, term: NumberMemo, x: Assignment, observed: list[str]) -> Fraction:
        """The term's mean over the observation features that are not yet in `x`."""
        if not observed:
            value = term(x)
            if isinstance(value, Undefined):
                self.faults.add((*self.path, *path), value.reason, x)
                return Fraction(0)
            return value
        name, *others = observed
        values, memo = self.channels[name]
        chances = memo(x)
        if isinstance(chances, Undefined):
            self.faults.add((*self.path, "senses", name), chances.reason, x)
            return Fraction(0)
        return sum(
            (
                chance * self._expected(path, term, {**x, (name, False): value}, others)
                for value, chance in zip(values, chances, strict=True)
                if chance
            ),
            Fraction(0),
        )


def _topological(names: Sequence[str], parents: Mapping[str, set[str]]) -> list[str]:
    """`names` with each after its parents; `check` has refused circles."""
    order: list[str] = []
    while len(order) < len(names):
        order += [n for n in names if n not in order and parents.get(n, set()) <= set(order)]
    return order


def list_states(
    model: Model, maximum_states: int
) -> tuple[tuple[tuple[Value, ...], ...], list[dict[tuple[str, bool], Value]]]:
    """The states by number: as tuples of values, and as assignments.

    Raises:
        ModelError: structural faults of the model.
        LimitReached: more than `maximum_states` states.
    """
    errors = [fault for fault in check(model) if fault.severity == "error"]
    if errors:
        raise ModelError(errors)
    if model.states > maximum_states:
        raise LimitReached(
            f"{model.name}: {model.states} states are more than the {maximum_states} that may be "
            "enumerated; raise maximum_states or use the symbolic reading",
            stage="enumeration",
        )
    combinations = tuple(product(*(feature.values for feature in model.features)))
    keys = [(feature.name, False) for feature in model.features]
    return combinations, [dict(zip(keys, values, strict=True)) for values in combinations]


def enumerate_model(
    model: Model,
    *,
    actions: Sequence[str] | None = None,
    terminal: ExpressionLike | None = None,
    rewards: Mapping[str, Sequence[ExpressionLike]] | None = None,
    maximum_states: int = MAXIMUM_STATES,
) -> ExactMDP:
    """The exact MDP of `model`.

    `actions` names the actions to read, in order (None: all).  `terminal` stands in place of the
    model's condition.  `rewards` gives each action's reward terms in place of the model's and the
    action's own; an action it does not mention then has none.

    Raises:
        ModelError: structural faults, and those met at an applicable action of a non-terminal state
            or in the initial belief, each at the first state where it shows.
        LimitReached: the model has more than `maximum_states` states.
        KeyError: an unknown action; the message lists those there are.
    """
    combinations, states = list_states(model, maximum_states)
    faults = Faults()
    ending = model.terminal if terminal is None else resolve(model, as_expression(terminal))
    ends = conditions_at(condition_memo(model, ending), states, ("terminal",), faults)
    chosen = [model.action(name) for name in actions] if actions is not None else list(model.actions)
    read = [_read_action(model, action, reward_terms(model, action, rewards), states, ends, faults)
            for action in chosen]  # fmt: skip
    initial = initial_belief(model, states, faults)
    faults.raise_if_any()
    return ExactMDP(
        features=model.features,
        state_values=combinations,
        actions=tuple(action.name for action in chosen),
        rows=tuple(rows for rows, _, _ in read),
        rewards=tuple(values for _, values, _ in read),
        applicable=tuple(mask for _, _, mask in read),
        terminal=ends,
        initial=initial,
        discount=model.discount,
    )


def reward_terms(
    model: Model, action: Action, rewards: Mapping[str, Sequence[ExpressionLike]] | None = None
) -> list[tuple[Path, Expression]]:
    """The reward terms of an action with their places: those given, or the model's and its own."""
    if rewards is not None:
        terms = [resolve(model, as_expression(term)) for term in rewards.get(action.name, ())]
    else:
        terms = [*model.rewards, *action.rewards]
    return [(("reward", str(index)), term) for index, term in enumerate(terms)]


def conditions_at(
    memo: Memo[bool | Undefined], states: Sequence[Assignment], path: Path, faults: Faults
) -> tuple[bool, ...]:
    """A condition at each state, False where it is a fault."""
    values: list[bool] = []
    for state in states:
        value = memo(state)
        if isinstance(value, Undefined):
            faults.add(path, value.reason, state)
            value = False
        values.append(value)
    return tuple(values)


def _read_action(
    model: Model,
    action: Action,
    terms: Sequence[tuple[Path, Expression]],
    states: Sequence[Assignment],
    ends: Sequence[bool],
    faults: Faults,
) -> tuple[tuple[Row, ...], tuple[Fraction, ...], tuple[bool, ...]]:
    reader = ActionReader(model, action, terms, faults)
    condition = condition_memo(model, action.applicable)
    rows: list[Row] = []
    rewards: list[Fraction] = []
    applicable: list[bool] = []
    for state, ended in zip(states, ends, strict=True):
        applies = False if ended else condition(state)
        if isinstance(applies, Undefined):
            faults.add(("actions", action.name, "applicable"), applies.reason, state)
            applies = False
        row = reader.row(state) if applies else None
        rows.append(row or {})
        rewards.append(reader.reward(state, row, states) if row else Fraction(0))
        applicable.append(applies)
    return tuple(rows), tuple(rewards), tuple(applicable)


def initial_belief(model: Model, states: Sequence[Assignment], faults: Faults) -> tuple[Fraction, ...]:
    """b0 at each state: the network's factors from parents to children, then the others."""
    given = dict(model.initial.distributions)
    if not model.initial.factors:
        given = {f.name: given.get(f.name, uniform(f)) for f in model.features}
    cpds = {f.name: _distribution_memo(model, given[f.name], f.values) for f in model.features
            if f.name in given}  # fmt: skip
    parents = {name: {n for n, _ in memo.read} & set(cpds) for name, memo in cpds.items()}
    factors = [_number_memo(model, factor) for factor in model.initial.factors]
    features = {f.name: f for f in model.features}

    def weights(state: Assignment) -> Iterator[tuple[Path, Fraction | Undefined]]:
        for name in _topological(list(cpds), parents):
            row = cpds[name](state)
            digit = features[name].index(state[name, False])
            assert digit is not None
            yield ("initial", name), row if isinstance(row, Undefined) else row[digit]
        for index, factor in enumerate(factors):
            yield ("initial", "factors", str(index)), factor(state)

    belief: list[Fraction] = []
    for state in states:
        weight = Fraction(1)
        for path, value in weights(state):
            if isinstance(value, Fraction) and value < 0:
                value = Undefined(f"the weight {value} is negative")
            if isinstance(value, Undefined):
                faults.add(path, value.reason, state)
                value = Fraction(0)
            weight *= value
            if not weight:
                break  # a state that the belief has excluded needs no further factor
        belief.append(weight)
    total = sum(belief, Fraction(0))
    if total != 1 and not any(path[0] == "initial" for path in faults.first):
        faults.add(("initial",), f"the initial belief sums to {total}, not to 1", {})
    return tuple(belief)

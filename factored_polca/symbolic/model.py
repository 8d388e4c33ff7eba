"""A model as diagrams.

The variables are interleaved: the feature at position i of the order has level 2i now and level
2i + 1 next.  For each action a and each feature it changes, a *row diagram* maps the parents to the
number of a row of exact probabilities; features an action does not change have none.  Observations
have row diagrams over (x, x') likewise, and the levels below all features (`observations`).  Reward
terms are diagrams over x of exact rationals, expectations over o and x' taken:

    R_a(x) = sum over terms r of E[r(x, x', o) | x, a].

Where a is not applicable (app_a = applicable and not terminal) rows and rewards mean nothing, so
faults count only where app_a holds, and there only in contexts of positive probability; elsewhere
undefined entries are replaced by harmless ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np

from factored_polca.diagrams import (
    INDEX,
    Diagram,
    Manager,
    choose,
    cofactors,
    leaves,
    relabel,
    restrict,
    states_for_leaves,
    support,
)
from factored_polca.models import Fault, Feature, Model, ModelError, TaskHierarchy, check
from factored_polca.models.expressions import ZERO, Expression, Reference, references
from factored_polca.models.scalars import Undefined, describe
from factored_polca.symbolic.expressions import Distribution, ExpressionCompiler, Variable, row_of, used
from factored_polca.symbolic.initial import compile_initial
from factored_polca.symbolic.names import LevelNames
from factored_polca.symbolic.observations import (
    compile_observations,
    expect_observations,
    restrict_to_possible,
)
from factored_polca.symbolic.order import variable_order
from factored_polca.symbolic.rows import (
    Row,
    RowDiagram,
    Term,
    as_number,
    elimination_order,
    mean,
    numbered,
    possible,
)


@dataclass(frozen=True)
class SymbolicAction:
    """An action as diagrams.

    `rows` maps changed features to their row diagrams; `elimination` lists all features, children of
    synchronic arcs before their parents; `app` is where the action is applicable and x not terminal.
    `rewards` are expectations over x' and o; `sampled_rewards` the same terms as functions of (x, x').
    `observations` maps the channels that the action senses to their row diagrams over (x, x').
    """

    name: str
    rows: dict[int, RowDiagram]
    elimination: tuple[int, ...]
    app: Diagram
    rewards: tuple[Term, ...]
    sampled_rewards: tuple[Term, ...]
    observations: dict[int, RowDiagram] = field(default_factory=dict)

    @property
    def synchronic(self) -> bool:
        """Whether some next feature has another next feature as a parent."""
        return any(row.parents_next for row in self.rows.values())


@dataclass(frozen=True)
class SymbolicModel:
    """A model compiled to diagrams of one manager; make it with `compile_model`.

    `initial` holds b0 as row diagrams over next variables: a feature's parents are other features
    of the same, first, time slice.  Models over one manager whose actions differ need a `variant` number
    each: what the manager remembers of regressions it remembers by action and variant.
    """

    model: Model
    order: tuple[str, ...]
    manager: Manager
    compiler: ExpressionCompiler
    terminal: Diagram
    actions: tuple[SymbolicAction, ...]
    initial: dict[int, RowDiagram]
    warnings: tuple[Fault, ...] = ()
    positions: tuple[int, ...] = field(default=())  # [feature] -> position in the order
    variant: int = 0

    def __repr__(self) -> str:
        return f"<SymbolicModel {self.model.name}: order {', '.join(self.order)}>"

    def now(self, feature: int) -> int:
        """The level of a feature in the present state."""
        return 2 * self.positions[feature]

    def next(self, feature: int) -> int:
        """The level of a feature in the next state."""
        return 2 * self.positions[feature] + 1

    @property
    def now_levels(self) -> list[int]:
        """The levels of the features in the present state, by feature."""
        return [self.now(i) for i in range(len(self.model.features))]

    def columns(self) -> list[int]:
        """For each level the column of its feature in an array of states [row, feature].

        Next variables use columns n, n + 1, ... (an array of pairs of states is [row, 2n]), and
        observations, which no finished diagram tests, those from 2n on.
        """
        count = len(self.model.features)
        result = list(range(2 * count + len(self.model.observations)))
        for i in range(count):
            result[self.now(i)] = i
            result[self.next(i)] = count + i
        return result

    def state(self, by_level: Sequence[int]) -> tuple[int, ...]:
        """A state as value numbers by feature, from values by level."""
        return tuple(int(by_level[self.now(i)]) for i in range(len(self.model.features)))

    def state_text(self, by_level: Sequence[int]) -> str:
        """A state as `x=3, y=on`."""
        values = self.state(by_level)
        pairs = zip(self.model.features, values, strict=True)
        return ", ".join(f"{f.name}={_show(f.values[v])}" for f, v in pairs)


def _show(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def compile_model(
    model: Model,
    *,
    order: str | Sequence[str] = "auto",
    tasks: TaskHierarchy | None = None,
    memory_limit: int | None = None,
    deadline: float | None = None,
    parameters: Mapping[str, Fraction] | None = None,
) -> SymbolicModel:
    """Compile `model`, checking its structure and its probabilities.

    Args:
        order: the name of a heuristic (`factored_polca.symbolic.order.ORDERS`) or the features' names
            from the top level down.
        tasks: a hierarchy whose conditions the order shall serve too.
        memory_limit: bytes for the diagrams.
        deadline: `time.monotonic()` value at which to stop.
        parameters: values of parameters in place of the model's, symbols among them.

    Raises:
        ModelError: with every fault found.
        MemoryLimit: diagrams larger than allowed.
    """
    faults = [fault for fault in check(model) if fault.severity == "error"]
    if faults:
        raise ModelError(faults)
    names = variable_order(model, order, tasks) if isinstance(order, str) else tuple(order)
    if sorted(names) != sorted(feature.name for feature in model.features):
        raise ValueError("a variable order must list every feature once")
    features = {feature.name: index for index, feature in enumerate(model.features)}
    position = [0] * len(names)
    for place, name in enumerate(names):
        position[features[name]] = place
    sizes = [size for name in names for size in [len(model.feature(name).values)] * 2]
    sizes += [len(channel.values) for channel in model.observations]
    manager = Manager(sizes, memory_limit=memory_limit)
    manager.deadline = deadline
    manager.describe = LevelNames(model, names).describe
    levels = {
        Reference(name, primed): 2 * position[index] + primed
        for name, index in features.items()
        for primed in (False, True)
    }
    levels |= {Reference(o.name): 2 * len(names) + i for i, o in enumerate(model.observations)}
    variables: list[Variable] = [*model.features, *model.observations]
    compiler = ExpressionCompiler(
        manager, variables, levels, {**dict(model.parameters), **(parameters or {})}
    )
    return _Build(model, names, tuple(position), manager, compiler).finish()


def compile_condition(
    symbolic: SymbolicModel, expression: Expression, path: tuple[str, ...], where: Diagram
) -> Diagram:
    """The condition `expression` over present features as a diagram with leaves 0 and 1.

    Raises:
        ModelError: where it is neither true nor false at a state in `where`.
    """
    build = _Build.again(symbolic)
    result = build.condition(expression, path, where)
    if build.faults:
        raise ModelError(build.faults)
    return result


def compile_term(
    symbolic: SymbolicModel, expression: Expression, path: tuple[str, ...], action: int, where: Diagram
) -> Term:
    """A reward term over x and x' under action number `action`, its expectation over x' taken.

    Raises:
        ModelError: where it is no number at a state in `where`.
    """
    build = _Build.again(symbolic)
    compiled = symbolic.actions[action]
    term = build.sampled_term(expression, path, where, compiled.rows, compiled.observations)
    if build.faults:
        raise ModelError(build.faults)
    return build.expected(term, compiled.rows, compiled.elimination)


class _Build:
    """Compiles the parts of a model and collects faults."""

    def __init__(
        self,
        model: Model,
        order: tuple[str, ...],
        positions: tuple[int, ...],
        manager: Manager,
        compiler: ExpressionCompiler,
    ) -> None:
        self.model, self.order, self.positions = model, order, positions
        self.manager, self.compiler = manager, compiler
        self.faults: list[Fault] = []
        self.suspects: list[tuple[Variable, Diagram, Diagram, tuple[str, ...]]] = []
        self.known_rows: dict[tuple[tuple[object, ...], Expression], RowDiagram] = {}
        self.known_terms: dict[Expression, Term] = {}
        self.false, self.true = manager.constant(0), manager.constant(1)

    @classmethod
    def again(cls, symbolic: SymbolicModel) -> _Build:
        """To compile further parts of a finished model."""
        return cls(symbolic.model, symbolic.order, symbolic.positions, symbolic.manager, symbolic.compiler)

    def finish(self) -> SymbolicModel:
        terminal = self.condition(self.model.terminal, ("terminal",), self.true)
        actions = tuple(self.action(index, terminal) for index in range(len(self.model.actions)))
        initial = compile_initial(self)
        if self.faults:
            raise ModelError(dict.fromkeys(self.faults))  # a term of all actions is wrong once
        return SymbolicModel(
            self.model, self.order, self.manager, self.compiler, terminal, actions, initial,
            positions=self.positions,
        )  # fmt: skip

    def condition(self, expression: Expression, path: tuple[str, ...], where: Diagram) -> Diagram:
        true, strange = self.compiler.condition(expression)
        bad = strange & where
        if bad != self.false:
            self.report(self.compiler.compile(expression), bad, path, "the condition", "true or false")
        return true

    def report(self, diagram: Diagram, bad: Diagram, path: tuple[str, ...], what: str, wanted: str) -> None:
        """Record one fault with the first state where `diagram` is wrong."""
        leaf_order = leaves(bad)
        state = states_for_leaves(bad)[leaf_order.index(1)]
        number = restrict(diagram, {level: int(v) for level, v in enumerate(state)}).value
        value = self.compiler.value(int(number))
        tested = sorted(set(support(diagram)))
        context = ", ".join(self.level_text(level, int(state[level])) for level in tested)
        if isinstance(value, Undefined):
            reason = value.reason
        elif isinstance(value, Distribution):
            reason = "a distribution"
        else:
            reason = f"the value {describe(value)}"
        where = f" at {context}" if context else ""
        self.faults.append(Fault(f"{what} is wrong{where}: {reason}", path, hint=f"needed is {wanted}"))

    def level_text(self, level: int, value: int) -> str:
        name, values = LevelNames(self.model, self.order).describe(level)
        return f"{name}={_show(values[value])}"

    # -- actions ---------------------------------------------------------------------------

    def action(self, index: int, terminal: Diagram) -> SymbolicAction:
        action = self.model.actions[index]
        path = ("actions", action.name)
        live = ~terminal
        app = self.condition(action.applicable, (*path, "applicable"), live) & live
        numbers = {feature.name: i for i, feature in enumerate(self.model.features)}
        rows: dict[int, RowDiagram] = {}
        for name, effect in action.effects:
            if effect == Reference(name):
                continue
            number = numbers[name]
            rows[number] = self.rows(
                number, self.model.features[number], effect, (*path, "effects", name), app
            )
        self.settle_suspects(rows)
        observations = compile_observations(self, action, app, rows)
        elimination = elimination_order(self.positions, rows)
        terms: list[tuple[Expression, tuple[str, ...]]]
        terms = [(term, ("reward", str(i))) for i, term in enumerate(self.model.rewards)]
        terms += [(term, (*path, "reward", str(i))) for i, term in enumerate(action.rewards)]
        terms = [(expression, where) for expression, where in terms if expression != ZERO]
        sampled = tuple(self.sampled_term(e, where, app, rows, observations) for e, where in terms)
        rewards = tuple(self.expected(term, rows, elimination) for term in sampled)
        return SymbolicAction(action.name, rows, elimination, app, rewards, sampled, observations)

    def rows(
        self, index: int, variable: Variable, given: Expression, path: tuple[str, ...], where: Diagram
    ) -> RowDiagram:
        """The row diagram of an effect, or of what is sensed, for the variable numbered `index`.

        Where it is none it becomes a suspect: see `settle_suspects`.
        """
        key = (variable.values, given)
        if key in self.known_rows:  # the effect of another action, and no suspect
            known = self.known_rows[key]
            return RowDiagram(index, known.diagram, known.rows, known.parents_next)
        compiled = self.compiler.compile(given)
        fallback = tuple(Fraction(int(v == 0)) for v in range(len(variable.values)))
        numbers: dict[Row, int] = {}
        images = np.zeros(len(self.compiler.table.values), dtype=np.uint64)
        bad = np.zeros(len(images), dtype=np.uint64)
        for entry in sorted(used(compiled)):
            row = row_of(variable, self.compiler.value(entry))
            if isinstance(row, Undefined):
                bad[entry] = 1
                row = fallback
            images[entry] = numbers.setdefault(row, len(numbers))
        if bad.any():
            wrong = relabel(compiled, bad, INDEX) & where
            if wrong != self.false:
                self.suspects.append((variable, compiled, wrong, path))
        primed = {r.name for r in references(given) if r.primed}
        parents = tuple(i for i, f in enumerate(self.model.features) if f.name in primed)
        row_diagram = RowDiagram(index, relabel(compiled, images, INDEX), tuple(numbers), parents)
        if not bad.any():
            self.known_rows[key] = row_diagram
        return row_diagram

    def settle_suspects(self, rows: dict[int, RowDiagram]) -> None:
        """Report the rows that are wrong where next values of positive probability lead."""
        for variable, compiled, wrong, path in self.suspects:
            happens = self.happening(wrong, rows)
            if happens != self.false:
                self.report_row(variable, compiled, happens, path)
        self.suspects.clear()

    def happening(self, condition: Diagram, rows: dict[int, RowDiagram]) -> Diagram:
        """The part of a condition over (x, x') where the next values that it tests are possible."""
        at = {2 * position + 1: index for index, position in enumerate(self.positions)}
        waiting = [at[level] for level in support(condition) if level in at]
        seen: set[int] = set()
        while waiting:
            index = waiting.pop()
            if index in seen:
                continue
            seen.add(index)
            level = 2 * self.positions[index] + 1
            if index in rows:
                condition = condition & possible(rows[index], level)
                waiting += rows[index].parents_next
            else:
                for value in range(len(self.model.features[index].values)):
                    now = self.manager.indicator(level - 1, [value])
                    following = self.manager.indicator(level, [value])
                    condition = condition & ~(now ^ following)
        return condition

    def report_row(
        self, variable: Variable, compiled: Diagram, wrong: Diagram, path: tuple[str, ...]
    ) -> None:
        """Record the first context where a row is no distribution over the variable's values."""
        state = states_for_leaves(wrong)[leaves(wrong).index(1)]
        number = restrict(compiled, {level: int(v) for level, v in enumerate(state)}).value
        row = row_of(variable, self.compiler.value(int(number)))
        assert isinstance(row, Undefined)
        tested = sorted(set(support(compiled)))
        context = ", ".join(self.level_text(level, int(state[level])) for level in tested)
        where = f" at {context}" if context else ""
        hint = f"values of {variable.name!r} are {', '.join(_show(v) for v in variable.values[:12])}"
        if "sum to" in row.reason:
            hint = "make the row sum to exactly 1; 0.333 is not 1/3"
        name = f"{variable.name}'" if isinstance(variable, Feature) else variable.name
        self.faults.append(Fault(f"the distribution of {name}{where}: {row.reason}", path, hint))

    def sampled_term(
        self,
        expression: Expression,
        path: tuple[str, ...],
        where: Diagram,
        rows: dict[int, RowDiagram],
        observations: dict[int, RowDiagram],
    ) -> Term:
        """A reward term as a function of (x, x'), o in expectation; a condition counts as 0 or 1."""
        if expression in self.known_terms:  # of another action, with no fault anywhere
            return expect_observations(self, self.known_terms[expression], observations)
        compiled = self.compiler.compile(expression)
        entries = used(compiled)
        values = [self.compiler.value(entry) for entry in entries]
        if all(isinstance(value, (Fraction, bool)) for value in values):
            term = numbered(compiled, lambda n: as_number(self.compiler.value(n)))
            self.known_terms[expression] = term
            return expect_observations(self, term, observations)
        bad = np.zeros(max(entries) + 1, dtype=np.uint64)
        for entry, value in zip(entries, values, strict=True):
            bad[entry] = not isinstance(value, (Fraction, bool))
        wrong = restrict_to_possible(self, relabel(compiled, bad, INDEX) & where, observations)
        wrong = self.happening(wrong, rows)
        if wrong != self.false:
            self.report(compiled, wrong, path, "the reward", "a number")
        term = numbered(compiled, lambda n: as_number(self.compiler.value(n)))
        return expect_observations(self, term, observations)

    def expected(self, term: Term, rows: dict[int, RowDiagram], elimination: tuple[int, ...]) -> Term:
        """The expectation over x' of a term."""
        tested = set(support(term.diagram))
        if not any(level % 2 for level in tested if level < 2 * len(self.order)):
            return term
        for index in elimination:
            level = 2 * self.positions[index] + 1
            if level in tested:
                term = self.expectation(term, index, level, rows.get(index))
                tested = set(support(term.diagram))
        return term

    def expectation(self, term: Term, index: int, level: int, row: RowDiagram | None) -> Term:
        """The term with the next value of one feature summed out."""
        if row is not None:
            return mean(term, level, row)
        parts = cofactors(term.diagram, level)
        result = parts[-1]
        for value in range(len(parts) - 1):
            result = choose(self.manager.indicator(level - 1, [value]), parts[value], result)
        return Term(result, term.values)

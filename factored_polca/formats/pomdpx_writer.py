"""Writer of POMDPX, factored; the format is described in `factored_polca.formats.pomdpx`.

`pomdpx_columns` says which state variables a model becomes, `pomdpx_entries` how tables are made.  Only
tables are written (type TBL): the format's own program does not read diagrams.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Final
from xml.sax.saxutils import escape

from factored_polca.formats.decimals import number_text
from factored_polca.formats.pomdpx_belief import belief_entries
from factored_polca.formats.pomdpx_columns import (
    Column,
    spell,
    with_memories,
    without_ends,
)
from factored_polca.formats.pomdpx_entries import (
    MAXIMUM_ENTRIES,
    Entry,
    Parent,
    TooManyEntries,
    Walk,
    cluster_entries,
    entry_lines,
)
from factored_polca.formats.spudd_model_trees import sum_terms
from factored_polca.formats.spudd_rows import context
from factored_polca.formats.spudd_trees import ExpansionLimit, Forest, TreeLimit, reason
from factored_polca.models.check import check
from factored_polca.models.errors import Fault, ModelError
from factored_polca.models.expressions import FALSE, TRUE, Constant, Expression, Reference
from factored_polca.models.model import Model
from factored_polca.models.scalars import scalar

ANY: Final = "*"


def write_pomdpx(model: Model) -> str:
    """`model` in POMDPX.

    Raises:
        ModelError: the model is not right, or the format can't express it; says where and why.
    """
    faults = [fault for fault in check(model) if fault.severity == "error"]
    for action in model.actions:
        if not faults and action.applicable != TRUE:
            place = ("actions", action.name, "applicable")
            hint = "say what the action does elsewhere, or use the native format"
            faults.append(Fault("actions of POMDPX are applicable everywhere", place, hint))
    if faults:
        raise ModelError(faults)
    try:
        return "\n".join(_Writer(model).lines()) + "\n"
    except TooManyEntries:
        problem = f"more than {MAXIMUM_ENTRIES} entries"
    except ExpansionLimit:
        problem = "the sums of the initial belief take too long"
    except TreeLimit as limit:
        problem = str(limit)
    hint = "POMDPX has tables: use the native format, or write the quotient"
    raise ModelError([Fault(f"the model is too large to be written as tables: {problem}", hint=hint)])


@dataclass
class _Table:
    """The entries of one variable, in the order of the file."""

    name: str
    labels: Sequence[str]  # of the variable itself, () of a reward
    entries: list[Entry] = field(default_factory=list)


class _Writer:
    def __init__(self, model: Model) -> None:
        self.original = model
        self.model = with_memories(without_ends(model))
        self.clusters, self.names = spell(self.model)
        self.columns: list[Column] = [c for cluster in self.clusters for c in cluster.columns]
        values = {f.name: f.values for f in self.model.features}
        self.forest = Forest(values | {o.name: o.values for o in self.model.observations})
        self.walk = Walk(self.forest)
        self.parameters = dict(self.model.parameters)
        self.parents: dict[Reference, Parent] = {}
        for column in self.columns:
            for name, primed in ((column.now, False), (column.next, True)):
                references = tuple(Reference(f.name, primed) for f in column.members)
                parent = Parent(name, references, column.joints, column.labels)
                self.parents |= dict.fromkeys(references, parent)
        for o in self.model.observations:
            reference = Reference(o.name)
            joints = [(v,) for v in o.values]
            self.parents[reference] = Parent(
                self.names.channels[o.name], (reference,), joints, self.names.values[o.name]
            )

    # -- the document ------------------------------------------------------------------------

    def lines(self) -> Iterator[str]:
        model, names = self.original, self.names
        yield '<?xml version="1.0" encoding="UTF-8"?>'
        for line in self._notes():
            yield f"<!-- {_comment(line)} -->"
        yield '<pomdpx version="1.0" id="factored">'
        yield f"<Description>{_plain(model.description or model.name)}</Description>"
        yield f"<Discount>{number_text(model.discount)}</Discount>"
        if model.horizon is not None:
            yield f"<Horizon>{model.horizon}</Horizon>"
        beliefs = self._beliefs()
        transitions, senses, rewards = self._transitions(), self._senses(), self._rewards()
        yield "<Variable>"
        full = model.observability == "full"
        for column in self.columns:
            seen = ' fullyObs="true"' if column.observed or full else ""
            yield f'<StateVar vnamePrev="{column.now}" vnameCurr="{column.next}"{seen}>'
            yield f"{_values(column.labels)}</StateVar>"
        for name, spelled in names.channels.items():
            yield f'<ObsVar vname="{spelled}">{_values(names.values[name])}</ObsVar>'
        yield f'<ActionVar vname="{names.acting}">{_values(tuple(names.actions.values()))}</ActionVar>'
        yield from (f'<RewardVar vname="{table.name}"/>' for table in rewards)
        yield "</Variable>"
        yield from self._section("InitialStateBelief", beliefs)
        yield from self._section("StateTransitionFunction", transitions)
        if senses:
            yield from self._section("ObsFunction", senses)
        yield from self._section("RewardFunction", rewards)
        yield "</pomdpx>"

    def _notes(self) -> Iterator[str]:
        yield self.original.name
        for line in self.names.changed:
            yield f"written otherwise: {line}"
        if self.original.terminal != FALSE:
            yield "the model's terminal states are absorbing here, with reward 0 for every action"
        added = self.model.features[len(self.original.features) :]
        for memory in added:
            yield f"{memory.name} carries a value to the next step, for an observation depends on it"

    # -- tables ------------------------------------------------------------------------------

    def _adopt(self, expression: Expression) -> Expression:
        return self.forest.adopt(expression, self.parameters)

    def _beliefs(self) -> list[_Table]:
        found = {}
        for column, entries in belief_entries(self.walk, self.model, self.columns):
            found[column.now] = _Table(column.now, column.labels, entries)
        return [found[column.now] for column in self.columns]

    def _by_action(self, functions: Sequence[Sequence[Expression]]) -> Iterator[tuple[str, int]]:
        """(spelling, number) of each action; `*` and the first one where all have the same functions."""
        if all([*map(id, one)] == [*map(id, functions[0])] for one in functions):
            yield ANY, 0
            return
        yield from ((self.names.actions[a.name], k) for k, a in enumerate(self.model.actions))

    def _transitions(self) -> list[_Table]:
        effects = [dict(action.effects) for action in self.model.actions]
        tables: list[_Table] = []
        for cluster in self.clusters:
            found = {column: _Table(column.next, column.labels) for column in cluster.columns}
            functions = [
                [self._adopt(given.get(f.name, Reference(f.name))) for f in cluster.members]
                for given in effects
            ]
            for action, k in self._by_action(functions):
                place = ("actions", self.model.actions[k].name, "effects", cluster.members[0].name)
                known = dict(zip((f.name for f in cluster.members), functions[k], strict=True))
                for column, entry in cluster_entries(self.walk, cluster, known, action, place):
                    found[column].entries.append(entry)
            tables += found.values()
        return tables

    def _senses(self) -> list[_Table]:
        tables = []
        for channel in self.model.observations:
            null = Constant(scalar(channel.null))
            functions = [
                [self._adopt(dict(action.senses).get(channel.name, null))] for action in self.model.actions
            ]
            name = channel.name
            table = _Table(self.names.channels[name], self.names.values[name])
            for action, k in self._by_action(functions):
                place = ("actions", self.model.actions[k].name, "senses", name)
                for path, (rest,) in self.walk.paths(functions[k]):
                    row = self.walk.row(rest, name, channel.values, path, place)
                    table.entries.append(Entry(action, path, row))
            tables.append(table)
        return tables

    def _rewards(self) -> list[_Table]:
        """A table for each of the model's terms, one for the terms of actions over the same variables."""
        terms: list[list[tuple[str, Expression, tuple[str, ...]]]] = []
        for number, term in enumerate(sum_terms(self.model.rewards)):
            terms.append([(ANY, self._adopt(term), ("reward", str(number)))])
        special: dict[int, dict[str, Expression]] = {}
        for action in self.model.actions:
            for term in sum_terms(action.rewards):
                function = self._adopt(term)
                mine = special.setdefault(self.forest.support(function), {})
                known = mine.get(action.name)
                mine[action.name] = (
                    function if known is None else self.forest.operation("add", (known, function))
                )
        for functions in special.values():
            terms.append([
                (self.names.actions[name], function, ("actions", name, "reward"))
                for name, function in functions.items()
            ])  # fmt: skip
        tables: list[_Table] = []
        for part in terms:
            entries = [entry for term in part for entry in self._numbers(*term)]
            if entries:
                tables.append(_Table(self.names.rewards(len(tables)), (), entries))
        return tables or [_Table(self.names.rewards(0), (), [Entry(ANY, (), Fraction(0))])]

    def _numbers(self, action: str, function: Expression, place: tuple[str, ...]) -> Iterator[Entry]:
        for path, (rest,) in self.walk.paths([function]):
            if not (isinstance(rest, Constant) and isinstance(rest.value, Fraction)):
                where = f" where {context(path)}" if path else ""
                raise ModelError([Fault(f"no number{where}: {reason(rest)}", place)])
            if rest.value:
                yield Entry(action, path, rest.value)

    # -- text --------------------------------------------------------------------------------

    def _section(self, title: str, tables: Sequence[_Table]) -> Iterator[str]:
        function = "Func" if title == "RewardFunction" else "CondProb"
        numbers = "ValueTable" if title == "RewardFunction" else "ProbTable"
        belief = title == "InitialStateBelief"
        yield f"<{title}>"
        for table in tables:
            own = next((c for c in self.columns if c.next == table.name), None)
            parents = self._parents(table.entries, own)
            listed = [*([] if belief else [self.names.acting]), *(p.name for p in parents)]
            yield f"<{function}><Var>{table.name}</Var><Parent>{' '.join(listed) or 'null'}</Parent>"
            yield '<Parameter type="TBL">'
            for entry in table.entries:
                yield from entry_lines(entry, parents, table.labels, own.now if own else "", numbers)
            yield f"</Parameter></{function}>"
        yield f"</{title}>"

    def _parents(self, entries: Sequence[Entry], own: Column | None) -> list[Parent]:
        """The variables that entries mention, in the order of the file; an own value before comes last."""
        used = {reference for entry in entries for reference, _ in entry.path}
        if own is not None:  # also where it makes no difference: `pomdpsol` wants each variable somewhere
            used.add(Reference(own.members[0].name))
        found = {id(self.parents[reference]): self.parents[reference] for reference in used}
        order = {name: k for k, name in enumerate(dict.fromkeys(p.name for p in self.parents.values()))}
        last = own.now if own is not None else ""
        return sorted(found.values(), key=lambda p: (p.name == last, order[p.name]))


def _values(labels: Sequence[str]) -> str:
    return f"<ValueEnum>{' '.join(labels)}</ValueEnum>"


def _plain(text: str) -> str:
    return escape("".join(c if c.isprintable() else " " for c in text))


def _comment(text: str) -> str:
    clean = "".join(c if c.isprintable() else " " for c in text)[:500]
    while "--" in clean:
        clean = clean.replace("--", "- -")
    return clean.removesuffix("-")

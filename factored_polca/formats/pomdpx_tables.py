"""Tables of a POMDPX file: layered entries turned into a sparse decision tree.

An entry gives, for each parent and for the variable itself, a value, `*` (all values) or `-` (all
values, listed in its table; the last `-` runs fastest).  The value of a cell is that of the last
entry that covers it, 0 if none does.  A table over all parents is never made.  Instead

    node(L) = row(L)                                      nothing is left to decide
            = switch x {v: node(entries of L for x = v)}  x is what the last entry of L still asks

where L lists the entries, last first, that agree with what has been decided, cut after the first
one that covers all that is left.  Equal lists with equal questions left are one node.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from math import prod
from typing import Final, NamedTuple

from factored_polca.formats.pomdpx_document import (
    Element,
    Faults,
    Place,
    check_attributes,
    error,
    no_children,
    only,
    quoted,
)
from factored_polca.formats.pomdpx_rows import Context, Numbers, Rows, read_number
from factored_polca.formats.pomdpx_variables import Variable
from factored_polca.formats.spudd_trees import MAXIMUM_DEPTH, TreeLimit
from factored_polca.models.expressions import Expression

ALL: Final = -1
"""`*` in a pattern."""
LISTED: Final = -2
"""`-` in a pattern."""
KEYWORDS: Final = ("identity", "uniform")

_WILD: Final = {"*": ALL, "-": LISTED}


class Entry(NamedTuple):
    """One <Entry>: a pattern over the table's variables and its numbers."""

    pattern: tuple[int, ...]  # a value's number, ALL or LISTED, for each variable
    asks: int  # bit i: variable i must have a value of its own
    lists: int  # bit i: variable i is LISTED
    strides: dict[int, int]  # for each LISTED variable
    table: tuple[Fraction, ...]
    identity: bool
    place: Place


Layer = tuple[int, int]
"""The number of an entry, and the index into its table so far."""


@dataclass
class Table:
    """A table over `variables`; the last one is the row's, unless `target` is None."""

    rows: Rows
    variables: Sequence[Variable]
    target: Variable | None
    entries: Sequence[Entry]
    place: Place
    memo: dict[tuple[tuple[Layer, ...], int], Expression] = field(default_factory=dict)
    decided: int = field(init=False)  # bit i: variable i is decided last of all, in the row
    actions: int = field(init=False)

    def __post_init__(self) -> None:
        self.decided = 0 if self.target is None else 1 << (len(self.variables) - 1)
        kinds = enumerate(self.variables)
        self.actions = sum(1 << i for i, variable in kinds if variable.kind == "action")

    def tree(self) -> Expression:
        """The table as a decision tree; action variables are decided first.

        Raises:
            TreeLimit: it needs more steps, nodes or levels than the limits allow.
        """
        layers = tuple((number, 0) for number in reversed(range(len(self.entries))))
        return self._node(layers, self.decided, ())

    def _node(self, layers: tuple[Layer, ...], decided: int, context: Context) -> Expression:
        forest = self.rows.forest
        left = 0
        for depth, (number, _) in enumerate(layers):
            entry = self.entries[number]
            left |= (entry.asks | entry.lists) & ~decided
            if not entry.asks & ~decided and (self.target is None or entry.pattern[-1] < 0):
                layers = layers[: depth + 1]
                break
        forest.count(len(layers) + 1)
        key = (layers, left)
        known = self.memo.get(key)
        if known is None:
            if len(context) > MAXIMUM_DEPTH:
                raise TreeLimit(f"trees nested deeper than {MAXIMUM_DEPTH} levels")
            if left:
                known = self._switch(self._question(layers, left, decided), layers, decided, context)
            else:
                known = self._leaf(layers, context)
            self.memo[key] = known
        return known

    def _question(self, layers: Sequence[Layer], left: int, decided: int) -> int:
        """The number of the variable to decide next."""
        bits = left & self.actions
        if not bits:
            asked = (self.entries[number].asks & ~decided for number, _ in layers)
            bits = next((bits for bits in asked if bits), left)
        return (bits & -bits).bit_length() - 1

    def _switch(self, asked: int, layers: Sequence[Layer], decided: int, context: Context) -> Expression:
        variable = self.variables[asked]
        own: dict[int, list[Layer]] = {}
        common: list[Layer] = []
        listed = False
        for layer in layers:
            value = self.entries[layer[0]].pattern[asked]
            if value >= 0:
                own.setdefault(value, []).append(layer)
            else:
                common.append(layer)
                listed |= value == LISTED
        decided |= 1 << asked
        cases: list[Expression] = []
        rest: Expression | None = None
        for value in range(len(variable.values)):
            below = (*context, (variable, value))
            if value in own or listed:
                self.rows.forest.count(len(common) + 1)
                agreeing = self._shifted(common, asked, value) if listed else common
                merged = sorted([*own.get(value, ()), *agreeing], reverse=True)
                cases.append(self._node(tuple(merged), decided, below))
            else:
                if rest is None:
                    rest = self._node(tuple(common), decided, below)
                cases.append(rest)
        if self.target is None:
            return self.rows.forest.switch(variable.reference, cases)
        return self.rows.switch(variable, cases)

    def _shifted(self, layers: Sequence[Layer], asked: int, value: int) -> list[Layer]:
        return [(n, offset + value * self.entries[n].strides.get(asked, 0)) for n, offset in layers]

    def _leaf(self, layers: Sequence[Layer], context: Context) -> Expression:
        if self.target is None:
            first = self.entries[layers[0][0]].table[layers[0][1]] if layers else Fraction(0)
            return self.rows.forest.constant(first)
        weights: dict[int, Fraction] = {}
        for number, offset in layers:
            entry = self.entries[number]
            if entry.identity:
                weights.setdefault(offset, Fraction(1))
            elif entry.pattern[-1] >= 0:
                weights.setdefault(entry.pattern[-1], entry.table[offset])
            else:
                size = len(self.target.values)
                self.rows.forest.count(size)
                stride = entry.strides.get(len(entry.pattern) - 1, 0)
                for value in range(size):
                    weights.setdefault(value, entry.table[offset + value * stride])
        place = self.entries[layers[0][0]].place if layers else self.place
        return self.rows.row(weights, self.target, context, place)


@dataclass
class TableReader:
    """Reads the entries of one <Parameter type="TBL">."""

    variables: Sequence[Variable]  # the parents, then what the table is about
    children: int  # how many of the last variables have their probabilities here; 0 for rewards
    numbers: Numbers
    faults: Faults

    def entries(self, parameter: Element) -> list[Entry]:
        """All entries; what is wrong with one is added to the faults.

        Raises:
            ModelError: something else than entries.
        """
        found = []
        for element in only(parameter, ("Entry",)):
            with self.faults.gathering():
                found.append(self._entry(element))
        return found

    def _entry(self, element: Element) -> Entry:
        check_attributes(element, ())
        self.numbers.forest.count(len(self.variables))
        titles = ("Instance", "ProbTable") if self.children else ("Instance", "ValueTable", "ProbTable")
        parts = {child.name: child for child in only(element, titles)}
        if len(parts) < 2 or len(element.children) != 2 or "Instance" not in parts:
            raise error("an entry has one <Instance> and one table", element.place,
                        f"<Instance>...</Instance><{titles[1]}>...</{titles[1]}>")  # fmt: skip
        instance = parts.pop("Instance")
        table = next(iter(parts.values()))
        for part in (instance, table):
            check_attributes(part, ())
            no_children(part)
        pattern = self._pattern(instance)
        lists = [i for i, value in enumerate(pattern) if value == LISTED]
        asks = sum(1 << i for i, value in enumerate(pattern) if value >= 0)
        words = table.words()
        if len(words) == 1 and words[0] in KEYWORDS:
            return self._keyword(words[0], table, pattern, asks, lists)
        strides: dict[int, int] = {}
        count = 1
        for i in reversed(lists):
            strides[i] = count
            count *= len(self.variables[i].values)
        values = self._table(table, words, count, lists)
        bits = sum(1 << i for i in lists)
        return Entry(pattern, asks, bits, strides, values, False, table.place)

    def _pattern(self, instance: Element) -> tuple[int, ...]:
        words = instance.words()
        if len(words) != len(self.variables):
            listed = " ".join(variable.name for variable in self.variables[:12])
            raise error(f"Instance has {len(words)} values for {len(self.variables)} variables",
                        instance.place, f"one for each of: {listed}")  # fmt: skip
        pattern = []
        for position, (word, variable) in enumerate(zip(words, self.variables, strict=True)):
            value = variable.number_of(word)
            if value is None:
                value = _WILD.get(word)
            if value is None:
                raise error(f"{quoted(word)} is no value of {quoted(variable.name)}",
                            instance.place_of_word(position),
                            f"its values are {variable.listed()}, or '*', or '-'")  # fmt: skip
            pattern.append(value)
        return tuple(pattern)

    def _table(
        self, table: Element, words: Sequence[str], count: int, lists: Sequence[int]
    ) -> tuple[Fraction, ...]:
        if len(words) != count:
            names = ", ".join(self.variables[i].name for i in lists[:12])
            hint = f"one for each joint value of {names}" if lists else "one, for there is no '-'"
            shown = count if count < 10**9 else "more than 10^9"
            raise error(f"{table.name} has {len(words)} numbers; {shown} are needed", table.place, hint)
        self.numbers.forest.count(len(words))
        read = self.numbers.probability if self.children else self.numbers.read
        values = []
        for index, word in enumerate(words):
            try:
                values.append(read(word))
            except ValueError:
                place = table.place_of_word(index)
                values.append(read_number(self.numbers, word, place, probability=bool(self.children)))
        return tuple(values)

    def _keyword(
        self, word: str, table: Element, pattern: tuple[int, ...], asks: int, lists: Sequence[int]
    ) -> Entry:
        place = table.place_of_word(0)
        if not self.children:
            raise error(f"{word!r} in the table of a reward", place, "rewards are numbers")
        parents, own = pattern[: -self.children], pattern[-self.children :]
        if word == "uniform":
            if any(value >= 0 for value in own):
                raise error("'uniform' for one value of the variable", place,
                            "write '-' for the variable in Instance")  # fmt: skip
            size = prod(len(variable.values) for variable in self.variables[-self.children :])
            wild = tuple(max(value, ALL) for value in pattern)
            return Entry(wild, asks, 0, {}, (Fraction(1, size),), False, place)
        variable = self.variables[-1]
        chosen = [i for i, value in enumerate(parents) if value == LISTED]
        if len(own) != 1 or own[0] != LISTED or len(chosen) != 1:
            raise error("'identity' needs '-' for the variable and for one parent", place,
                        "and a value or '*' for each other parent")  # fmt: skip
        parent = self.variables[chosen[0]]
        if len(parent.values) != len(variable.values):
            raise error(f"'identity' between {quoted(parent.name)} and {quoted(variable.name)}, which have "
                        f"{len(parent.values)} and {len(variable.values)} values", place)  # fmt: skip
        return Entry(pattern, asks, 1 << chosen[0], {chosen[0]: 1}, (), True, place)

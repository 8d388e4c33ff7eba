"""Ground terms of RDDL: numbered, shared, and folded as they are made.

    t ::= c | now f | next f | act f | random f        constants; ground fluents, by name
        | and | or | not | add | multiply | ...        operators
        | indicator t                                  0 or 1 of a truth value
        | if t t t | function name t ...
        | bernoulli t | discrete (t ...)               a draw

A term's kind is `BOOL`, `NUMBER` or the name of an enumerated type.  Constants are folded at once: so
non-fluents, whose values are known, leave no trace, and what is left mentions true parents only.

Each *occurrence* of a draw is a draw of its own, independent of all others given the fluents.  So two
occurrences may share a number, but no rule below may drop or double an occurrence: rules such as
a and a = a hold for terms without draws alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, Final

from factored_polca.formats.rddl_functions import NoValue, applied
from factored_polca.models.errors import ModelError
from factored_polca.models.scalars import MAXIMUM_BITS, Scalar, Undefined, apply_operator

Term = int

BOOL: Final = "truth value"
NUMBER: Final = "numeric value"
"""Kinds; with their blanks they are no names of types."""

ACTS: Final = 1
DRAWS: Final = 2
"""Flags of terms: some part is an action-fluent, some part is a draw."""

MAXIMUM_TERMS: Final = 1_000_000

REFERENCES: Final = frozenset(["now", "next", "act", "random"])
COMPARISONS: Final = frozenset(["equal", "less", "less_equal"])


def bounded(value: Fraction) -> Fraction:
    """`value`, unless it is too long to go on with."""
    if max(value.numerator.bit_length(), value.denominator.bit_length()) > MAXIMUM_BITS:
        raise ModelError(f"a number of more than {MAXIMUM_BITS} bits comes up")
    return value


@dataclass(frozen=True, slots=True)
class Row:
    """One term: `data` is a constant's value, a fluent's name, a function's name or labels."""

    op: str
    parts: tuple[Term, ...]
    data: Any
    kind: str
    flags: int


@dataclass
class Terms:
    """The terms of one model; grows as terms are made, never changes one."""

    rows: list[Row] = field(default_factory=list)
    rounded: set[str] = field(default_factory=set)  # functions whose values were rounded
    _numbers: dict[tuple[Any, ...], Term] = field(default_factory=dict)
    _acts: dict[Term, frozenset[str]] = field(default_factory=dict)

    def __getitem__(self, term: Term) -> Row:
        return self.rows[term]

    def _make(self, op: str, parts: tuple[Term, ...], data: Any, kind: str, flags: int = 0) -> Term:
        key = (op, parts, type(data), data, kind)
        found = self._numbers.get(key)
        if found is None:
            if len(self.rows) >= MAXIMUM_TERMS:
                raise ModelError(f"grounding makes more than {MAXIMUM_TERMS:,} terms: too many objects")
            for part in parts:
                flags |= self.rows[part].flags
            found = self._numbers[key] = len(self.rows)
            self.rows.append(Row(op, parts, data, kind, flags))
        return found

    # -- leaves ------------------------------------------------------------------------------------

    def constant(self, value: Scalar, kind: str) -> Term:
        """A value of that kind."""
        return self._make("constant", (), value, kind)

    def number(self, value: Fraction | int) -> Term:
        """A number."""
        return self._make("constant", (), Fraction(value), NUMBER)

    def truth(self, value: bool) -> Term:
        """A truth value."""
        return self._make("constant", (), value, BOOL)

    def reference(self, op: str, name: str, kind: str) -> Term:
        """A ground fluent."""
        return self._make(op, (), name, kind, ACTS if op == "act" else 0)

    def undefined(self, reason: str, kind: str) -> Term:
        """What has no value; it does no harm where it does not count."""
        return self._make("undefined", (), reason, kind)

    def value(self, term: Term) -> Scalar | None:
        """The value of a constant, None of other terms."""
        row = self.rows[term]
        value: Scalar | None = row.data if row.op == "constant" else None
        return value

    def fixed(self, term: Term) -> bool:
        """Whether a term has no draw."""
        return not self.rows[term].flags & DRAWS

    # -- logic -------------------------------------------------------------------------------------

    def conjunction(self, parts: Iterable[Term]) -> Term:
        """All of `parts`."""
        return self._logic("and", parts, True)

    def disjunction(self, parts: Iterable[Term]) -> Term:
        """At least one of `parts`."""
        return self._logic("or", parts, False)

    def _logic(self, op: str, parts: Iterable[Term], neutral: bool) -> Term:
        kept: list[Term] = []
        seen: set[Term] = set()
        for part in self._flat(op, parts):
            value = self.value(part)
            if value is neutral:
                continue
            if value is not None:
                return part
            if self.fixed(part):
                if part in seen:
                    continue
                seen.add(part)
                if self.negation(part) in seen:
                    return self.truth(not neutral)
            kept.append(part)
        if len(kept) < 2:
            return kept[0] if kept else self.truth(neutral)
        return self._make(op, tuple(kept), None, BOOL)

    def _flat(self, op: str, parts: Iterable[Term]) -> Iterable[Term]:
        for part in parts:
            row = self.rows[part]
            if row.op == op:
                yield from row.parts
            else:
                yield part

    def negation(self, part: Term) -> Term:
        """Not `part`."""
        row = self.rows[part]
        if row.op == "constant":
            return self.truth(not row.data)
        if row.op == "not":
            return row.parts[0]
        return self._make("not", (part,), None, BOOL)

    # -- numbers -----------------------------------------------------------------------------------

    def as_number(self, part: Term) -> Term:
        """A truth value as 0 or 1; numbers stay."""
        row = self.rows[part]
        if row.kind != BOOL:
            return part
        if row.op == "constant":
            return self.number(int(row.data))
        return self._make("indicator", (part,), None, NUMBER)

    def sum(self, parts: Iterable[Term]) -> Term:
        """The sum of numbers."""
        total, kept = Fraction(0), list[Term]()
        for part in self._flat("add", parts):
            value = self.value(part)
            if value is None:
                kept.append(part)
            else:
                total = bounded(total + Fraction(value))
        if total or not kept:
            kept.insert(0, self.number(total))
        return kept[0] if len(kept) == 1 else self._make("add", tuple(kept), None, NUMBER)

    def product(self, parts: Iterable[Term]) -> Term:
        """The product of numbers; 0 times anything is 0."""
        total, kept = Fraction(1), list[Term]()
        for part in self._flat("multiply", parts):
            value = self.value(part)
            if value is None:
                kept.append(part)
            else:
                total = bounded(total * Fraction(value))
        if total == 0:
            return self.number(0)
        if total != 1 or not kept:
            kept.insert(0, self.number(total))
        return kept[0] if len(kept) == 1 else self._make("multiply", tuple(kept), None, NUMBER)

    def negative(self, part: Term) -> Term:
        """Minus `part`."""
        return self.product([self.number(-1), part])

    def less_one(self, part: Term) -> Term:
        """1 - part."""
        return self.sum([self.number(1), self.negative(part)])

    def operator(self, op: str, parts: tuple[Term, ...]) -> Term:
        """`divide`, `minimum`, `maximum` or a comparison."""
        kind = BOOL if op in COMPARISONS else NUMBER
        values = [self.value(part) for part in parts]
        known = [value for value in values if value is not None]
        if len(known) == len(parts):
            result = apply_operator(op, known)
            if isinstance(result, Undefined):
                return self.undefined(result.reason, kind)
            return self.constant(result, kind)
        if op == "equal":
            a, b = parts
            if a == b and self.fixed(a):
                return self.truth(True)
            if self.rows[a].kind == BOOL:
                for one, other in ((a, b), (b, a)):
                    value = self.value(one)
                    if value is not None:
                        return other if value else self.negation(other)
            parts = (min(parts), max(parts))
        elif op == "divide" and values[1] is not None:
            divisor = Fraction(values[1])
            if not divisor:
                return self.undefined("division by zero", kind)
            return self.product([self.number(1 / divisor), parts[0]])
        elif op in ("minimum", "maximum"):
            parts = tuple(dict.fromkeys(parts)) if all(map(self.fixed, parts)) else parts
            if len(parts) == 1:
                return parts[0]
        return self._make(op, parts, None, kind)

    def choice(self, condition: Term, then: Term, otherwise: Term) -> Term:
        """`then` where `condition` holds, `otherwise` elsewhere; both of one kind."""
        value = self.value(condition)
        if value is not None:
            return then if value else otherwise
        fixed = self.fixed(then) and self.fixed(otherwise)
        if then == otherwise and fixed:
            return then
        if self.rows[condition].op == "not":
            return self.choice(self.rows[condition].parts[0], otherwise, then)
        kind = self.rows[then].kind
        if kind == BOOL and fixed:
            yes, no = self.value(then), self.value(otherwise)
            if yes is not None and no is not None:
                return condition if yes else self.negation(condition)
            if yes is not None:
                chosen = self.disjunction if yes else self.conjunction
                return chosen([condition if yes else self.negation(condition), otherwise])
            if no is not None:
                chosen = self.disjunction if no else self.conjunction
                return chosen([self.negation(condition) if no else condition, then])
        if kind == NUMBER and fixed:
            ends = (self.value(then), self.value(otherwise))
            if ends in ((1, 0), (0, 1)):
                return self.as_number(condition if ends[0] else self.negation(condition))
        return self._make("if", (condition, then, otherwise), None, kind)

    def function(self, name: str, parts: tuple[Term, ...]) -> Term:
        """A function of `rddl_functions`."""
        values = [self.value(part) for part in parts]
        if all(value is not None for value in values):
            try:
                result = applied(name, [Fraction(v) for v in values if v is not None])
            except NoValue as error:
                return self.undefined(str(error), NUMBER)
            if result.rounded:
                self.rounded.add(name)
            return self.number(result.value)
        return self._make("function", parts, name, NUMBER)

    # -- draws -------------------------------------------------------------------------------------

    def bernoulli(self, chance: Term) -> Term:
        """True with that probability."""
        value = self.value(chance)
        if value in (0, 1):
            return self.truth(bool(value))
        return self._make("bernoulli", (chance,), None, BOOL, DRAWS)

    def discrete(self, labels: tuple[Scalar, ...], chances: tuple[Term, ...], kind: str) -> Term:
        """One of `labels`, each with its probability."""
        return self._make("discrete", chances, labels, kind, DRAWS)

    # -- the whole ---------------------------------------------------------------------------------

    def again(self, row: Row, parts: tuple[Term, ...]) -> Term:
        """The same term with other parts, folded anew."""
        match row.op:
            case "and" | "or":
                return self._logic(row.op, parts, row.op == "and")
            case "not":
                return self.negation(parts[0])
            case "add":
                return self.sum(parts)
            case "multiply":
                return self.product(parts)
            case "indicator":
                return self.as_number(parts[0])
            case "if":
                return self.choice(*parts)
            case "function":
                return self.function(row.data, parts)
            case "bernoulli":
                return self.bernoulli(parts[0])
            case "discrete":
                return self.discrete(row.data, parts, row.kind)
        return self.operator(row.op, parts)

    def parts_first(self, roots: Iterable[Term], inside: Callable[[Row], bool]) -> list[Term]:
        """The terms in `roots` that pass `inside`, each once, every part before its whole."""
        seen: set[Term] = set()
        order: list[Term] = []
        work = [(root, False) for root in roots]
        while work:
            term, done = work.pop()
            if done:
                order.append(term)
            elif term not in seen and inside(self.rows[term]):
                seen.add(term)
                work.append((term, True))
                work.extend((part, False) for part in self.rows[term].parts)
        return order

    def replaced(self, root: Term, leaves: Mapping[str, Term], op: str, flag: int = 0) -> Term:
        """`root` with the references `op f` for the fluents f in `leaves` replaced."""
        new: dict[Term, Term] = {}
        for term in self.parts_first([root], lambda row: not flag or bool(row.flags & flag)):
            row = self.rows[term]
            if row.op == op:
                new[term] = leaves.get(row.data, term)
            elif row.parts:
                parts = tuple(new.get(part, part) for part in row.parts)
                new[term] = term if parts == row.parts else self.again(row, parts)
        return new.get(root, root)

    def acts(self, root: Term) -> frozenset[str]:
        """The action-fluents in `root`."""
        for term in self.parts_first([root], lambda row: bool(row.flags & ACTS)):
            if term not in self._acts:
                row = self.rows[term]
                found = frozenset([row.data]) if row.op == "act" else frozenset[str]()
                self._acts[term] = found.union(*(self._acts.get(p, frozenset()) for p in row.parts))
        return self._acts.get(root, frozenset())

    def mentioned(self, roots: Iterable[Term]) -> set[tuple[str, str]]:
        """The references in `roots`, as (op, fluent)."""
        rows = (self.rows[term] for term in self.parts_first(roots, lambda row: True))
        return {(row.op, row.data) for row in rows if row.op in REFERENCES}

"""Decision graphs as text in SPUDD's language; shared parts of large ones become `dd NAME ... enddd`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Final

from factored_polca.formats.spudd_names import Names
from factored_polca.models.expressions import Constant, Expression, Lottery, Reference, Switch
from factored_polca.models.features import position
from factored_polca.models.scalars import Value

MAXIMUM_DIGITS: Final = 400
"""Characters of a number that readers of the language take."""
MAXIMUM_INLINE: Final = 2_000
"""Nodes of a tree that is written without naming its shared parts."""
LINE: Final = 100
"""Characters of a tree that is written on one line."""


def decimal_text(value: Fraction) -> str | None:
    """`value` as an exact decimal, or None if it has none of at most `MAXIMUM_DIGITS` characters."""
    rest = value.denominator
    if max(rest.bit_length(), value.numerator.bit_length()) > 4 * MAXIMUM_DIGITS:
        return None
    twos = (rest & -rest).bit_length() - 1
    rest >>= twos
    fives = 0
    while rest % 5 == 0:
        rest //= 5
        fives += 1
    if rest != 1:
        return None
    places = max(twos, fives)
    digits = str(abs(value.numerator) * 10**places // value.denominator).rjust(places + 1, "0")
    text = f"{digits[:-places]}.{digits[-places:]}" if places else digits
    text = f"-{text}" if value < 0 else text
    return text if len(text) <= MAXIMUM_DIGITS else None


@dataclass
class Layout:
    """Writes trees; the names of shared parts are numbered through the file.

    `rows` says whether a distribution is written as a list of probabilities or as a tree over the
    next value.  Leaves are constants, or lotteries over all values of the tree's target.
    """

    names: Names
    values: dict[str, tuple[Value, ...]]
    observations: frozenset[str]
    rows: bool
    spare: Iterator[str] = field(init=False)

    def __post_init__(self) -> None:
        self.spare = self.names.of_trees()

    def tree(self, start: str, tree: Expression, target: Reference | None, before: list[str]) -> list[str]:
        """The lines of `tree`, after the text `start`; the trees it names are added to `before`."""
        order = _postorder(tree)
        sizes: dict[int, int] = {}  # nodes of the written tree, a named part counting as one
        uses: dict[int, int] = {}
        for node in order:
            sizes[id(node)] = _size(node, sizes)
            for case in _cases(node):
                uses[id(case)] = uses.get(id(case), 0) + 1
        named: dict[int, str] = {}
        if sizes[id(tree)] > MAXIMUM_INLINE:
            for node in order:
                sizes[id(node)] = _size(node, sizes)
                if isinstance(node, Switch) and uses.get(id(node), 0) > 1:
                    name = next(self.spare)
                    # in a dd a list of probabilities has no variable to belong to
                    before.append(f"dd {name}")
                    before += self._lines("  ", "  ", node, target, sizes, named, rows=False)
                    before.append("enddd")
                    named[id(node)] = name
                    sizes[id(node)] = 1
        indent = " " * (len(start) - len(start.lstrip()))
        return self._lines(start, indent, tree, target, sizes, named, rows=self.rows)

    def _lines(
        self,
        start: str,
        indent: str,
        node: Expression,
        target: Reference | None,
        sizes: dict[int, int],
        named: dict[int, str],
        *,
        rows: bool,
    ) -> list[str]:
        if not isinstance(node, Switch) or id(node) in named or sizes[id(node)] * 6 < LINE:
            text = self._inline(node, target, named, rows)
            if len(text) <= LINE or not isinstance(node, Switch) or id(node) in named:
                return [start + text]
        lines = [f"{start}({self._tested(node.reference)}"]
        labels = self.names.values[node.reference.name]
        for value, case in node.cases:
            label = labels[self._index(node.reference.name, value)]
            deeper = indent + "  "
            lines += self._lines(f"{deeper}({label} ", deeper, case, target, sizes, named, rows=rows)
            lines[-1] += ")"
        lines[-1] += ")"
        return lines

    def _inline(self, node: Expression, target: Reference | None, named: dict[int, str], rows: bool) -> str:
        if id(node) in named:
            return f"({named[id(node)]})"
        if isinstance(node, Constant):
            return f"({_number(node)})"
        if isinstance(node, Lottery):
            chances = [_number(chance) for _, chance in node.outcomes]
            if rows:
                return f"({' '.join(chances)})"
            assert target is not None, "only a tree with a target has distributions"
            labels: Sequence[str] = self.names.values[target.name]
            branches = [f"({label} ({chance}))" for label, chance in zip(labels, chances, strict=True)]
            return f"({self._tested(target)} {' '.join(branches)})"
        assert isinstance(node, Switch)
        labels = self.names.values[node.reference.name]
        parts = []
        for value, case in node.cases:
            label = labels[self._index(node.reference.name, value)]
            parts.append(f"({label} {self._inline(case, target, named, rows)})")
        return f"({self._tested(node.reference)} {' '.join(parts)})"

    def _index(self, variable: str, value: Value) -> int:
        index = position(self.values[variable], value)
        assert index is not None, "a decision is over the variable's own values"
        return index

    def _tested(self, reference: Reference) -> str:
        after = reference.primed or reference.name in self.observations
        return self.names.variables[reference.name] + ("'" if after else "")


def _number(node: Expression) -> str:
    assert isinstance(node, Constant)
    assert isinstance(node.value, Fraction)
    text = decimal_text(node.value)
    assert text is not None, "numbers were checked to be decimals"
    return text


def _cases(node: Expression) -> list[Expression]:
    return [case for _, case in node.cases] if isinstance(node, Switch) else []


def _postorder(tree: Expression) -> list[Expression]:
    """The distinct nodes of `tree`, each after its cases."""
    found: dict[int, Expression] = {}
    stack: list[tuple[Expression, bool]] = [(tree, False)]
    while stack:
        node, ready = stack.pop()
        if id(node) in found:
            continue
        if ready:
            found[id(node)] = node
        else:
            stack.append((node, True))
            stack.extend((case, False) for case in _cases(node))
    return list(found.values())


def _size(node: Expression, sizes: dict[int, int]) -> int:
    if isinstance(node, Lottery):
        return 1 + len(node.outcomes)
    return 1 + sum(sizes[id(case)] for case in _cases(node))

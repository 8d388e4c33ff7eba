"""Sets of states as binary decision diagrams of `dd`: CUDD where it is there, else `dd.autoref`.

A feature with d values takes ceil(log2 d) bits now and as many next, value v as the binary number v,
the most significant bit on top, in the order of the manager's levels.  Codes from d on stand for no
value.  A *set* holds none of them; a *condition* may say anything there.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from factored_polca.diagrams import Diagram, MemoryLimit
from factored_polca.diagrams.operations import Walk
from factored_polca.symbolic.model import SymbolicModel

LEAST_MEMORY = 1 << 26
"""Bytes that CUDD may use however low the manager's limit is."""


class BooleanSets:
    """The BDD variables of a symbolic model's levels, and conversions to diagrams and back.

    Functions of `dd` have no types; they are `Any` here.  `library` names the module in use.
    """

    def __init__(self, symbolic: SymbolicModel, library: str | None = None) -> None:
        self.manager = symbolic.manager
        self.library, self._module = _load(library)
        self.bdd: Any = self._module.BDD()
        self.bdd.configure(reordering=False)
        self.memory_limit = max(LEAST_MEMORY, self.manager.memory_limit)
        if self.library == "dd.cudd":
            self.bdd.configure(max_memory=self.memory_limit)
        self.bits: list[list[str]] = [
            [f"{'xy'[level % 2]}{level // 2}_{bit}" for bit in range((size - 1).bit_length())]
            for level, size in enumerate(self.manager.sizes)
        ]
        self._level = {name: level for level, names in enumerate(self.bits) for name in names}
        self.bdd.declare(*self._level)

    @contextmanager
    def running(self) -> Iterator[None]:
        """Room for the recursion of `dd.autoref`, which goes one call deeper for each bit.

        Raises:
            MemoryLimit: in place of the null pointer that CUDD answers at its limit.
        """
        before = sys.getrecursionlimit()
        sys.setrecursionlimit(max(before, 1_000 + 10 * len(self._level)))
        try:
            yield
        except ValueError as error:
            if "NULL" not in str(error):
                raise
            limit = f"{self.memory_limit / 2**20:,.0f} MiB"
            raise MemoryLimit(f"the sets of states fill the memory limit of {limit}") from None
        finally:
            sys.setrecursionlimit(before)

    def valid(self, levels: Iterable[int]) -> Any:
        """The set in which the code at each of `levels` stands for a value."""
        result = self.bdd.true
        for level in sorted(levels, reverse=True):
            if len(self.bits[level]) and self.manager.sizes[level] < 2 ** len(self.bits[level]):
                size = self.manager.sizes[level]
                result &= self._branch(level, [self.bdd.true] * size)
        return result

    def from_diagram(self, diagram: Diagram) -> Any:
        """A diagram with leaves 0 and 1 as a condition: false at codes without a value that it tests.

        Raises:
            ValueError: another leaf than 0 or 1.
        """
        walk = Walk(diagram)
        pool, leaf_level = self.manager.pool, self.manager.leaf_level
        if not set(walk.leaf_payloads().tolist()) <= {0, 1}:
            raise ValueError("only a diagram with the leaves 0 and 1 is a set of states")
        payloads = iter(walk.leaf_payloads().tolist())
        made: list[Any] = []
        for node, level in zip(walk.nodes.tolist(), walk.levels.tolist(), strict=True):
            if level == leaf_level:
                made.append(self.bdd.true if next(payloads) else self.bdd.false)
            else:
                children = pool[pool[node + 2 : node + 2 + self.manager.sizes[level]] + 1]
                made.append(self._branch(level, [made[child] for child in children.tolist()]))
        return made[-1]

    def _branch(self, level: int, children: Sequence[Any]) -> Any:
        """The condition that branches at `level` to `children`, one for each value."""
        parts = [*children, *[self.bdd.false] * (2 ** len(self.bits[level]) - len(children))]
        for name in reversed(self.bits[level]):
            bit = self.bdd.var(name)
            parts = [
                low if low == high else self.bdd.ite(bit, high, low)
                for low, high in zip(parts[::2], parts[1::2], strict=True)
            ]
        return parts[0]

    def to_diagram(self, function: Any) -> Diagram:
        """A set or condition as a diagram with leaves 0 and 1."""
        manager = self.manager
        # A function's number is its own only while the function is held: the memo holds it.
        memo: dict[int, tuple[Any, Diagram]] = {}
        for constant, value in ((self.bdd.false, 0), (self.bdd.true, 1)):
            memo[int(constant)] = (constant, manager.constant(value))
        waiting = [function]
        while waiting:
            top = waiting[-1]
            if int(top) in memo:
                waiting.pop()
                continue
            level = self._level[top.var]
            children = [self._cofactor(top, level, value) for value in range(manager.sizes[level])]
            missing = [child for child in children if int(child) not in memo]
            waiting.extend(missing)
            if not missing:
                branches = [memo[int(child)][1] for child in children]
                memo[int(top)] = (top, manager.variable(level, branches))
        return memo[int(function)][1]

    def _cofactor(self, function: Any, level: int, value: int) -> Any:
        """`function` with the code of `value` at its top level."""
        names = self.bits[level]
        for place, name in enumerate(names):
            if function.var == name:
                chosen = function.high if value >> (len(names) - 1 - place) & 1 else function.low
                function = ~chosen if function.negated else chosen
        return function

    def and_exists(self, a: Any, b: Any, levels: Iterable[int]) -> Any:
        """The condition that a and b hold for some values at `levels`."""
        names = [name for level in levels for name in self.bits[level]]
        if not names:
            return a & b
        if hasattr(self._module, "and_exists"):
            return self._module.and_exists(a, b, names)
        return self.bdd.exist(names, a & b)

    def move(self, function: Any, levels: Mapping[int, int]) -> Any:
        """The same condition of other variables: level i becomes `levels[i]`, of the same size."""
        pairs = levels.items()
        names = {a: b for i, j in pairs for a, b in zip(self.bits[i], self.bits[j], strict=True)}
        return self.bdd.let(names, function) if names else function


def _load(library: str | None) -> tuple[str, Any]:
    """The module of `dd` to use: the one asked for, or the first that can be imported."""
    names = ("dd.cudd", "dd.autoref")
    if library is not None:
        return library, importlib.import_module(library)
    try:
        return names[0], importlib.import_module(names[0])
    except ImportError:
        return names[1], importlib.import_module(names[1])

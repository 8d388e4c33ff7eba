"""Which guards can hold together: questions about conditions over features, decided within limits.

Most guards of one action in one module differ in a test such as x = 1 against x = 2: what each guard
allows for a single variable is compared first. What this leaves open is searched: the conjunction of both
guards is restricted to each value of a feature that it needs, until it is true or has been false
everywhere. A search that reaches its limit answers yes; then commands stay separate actions, which is
right in any case.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from functools import partial

from factored_polca.formats.spudd_trees import ExpansionLimit, Forest, TreeLimit
from factored_polca.models.expressions import Constant, Expression, Operation, conjunction
from factored_polca.models.features import Feature
from factored_polca.models.scalars import Value


class Guards:
    """Answers about conditions over `features`; parameters have their values."""

    def __init__(self, features: Sequence[Feature], parameters: Mapping[str, Fraction]) -> None:
        self._values = {feature.name: feature.values for feature in features}
        self._parameters = parameters
        self._allowed: dict[Expression, dict[str, frozenset[Value]]] = {}
        self._forest = Forest(self._values)
        self._gave_up = False

    def allowed(self, guard: Expression) -> Mapping[str, frozenset[Value]]:
        """For features that a part of the conjunction `guard` tests alone, the values that pass."""
        known = self._allowed.get(guard)
        if known is None:
            try:
                known = self._tests(guard)
            except TreeLimit:
                known = {}
            self._allowed[guard] = known
        return known

    def _tests(self, guard: Expression) -> dict[str, frozenset[Value]]:
        is_and = isinstance(guard, Operation) and guard.operator == "and"
        parts = guard.arguments if is_and and isinstance(guard, Operation) else (guard,)
        result: dict[str, frozenset[Value]] = {}
        forest = self._forest
        for part in parts:
            node = forest.adopt(part, self._parameters)
            names = forest.mentioned(forest.support(node))
            if len(names) != 1:
                continue
            (reference,) = names
            name, values = reference.name, self._values[reference.name]
            passing = frozenset(
                value for value in values if forest.restrict(node, reference, value) != Constant(False)
            )
            result[name] = passing & result[name] if name in result else passing
        return result

    def exclusive(self, first: Expression, second: Expression) -> bool:
        """Whether the two guards never hold together, as far as the limits tell."""
        one, other = self.allowed(first), self.allowed(second)
        if any(not values & other[name] for name, values in one.items() if name in other):
            return True
        return not self.satisfiable(conjunction([first, second]))

    def satisfiable(self, condition: Expression) -> bool:
        """Whether the condition may hold somewhere; yes past the limits."""
        if self._gave_up:
            return True
        try:
            node = self._forest.adopt(condition, self._parameters)
            return self._forest.limited(partial(self._search, node)) == Constant(True)
        except ExpansionLimit:
            return True
        except TreeLimit:
            self._gave_up = True
            return True

    def _search(self, root: Expression) -> Expression:
        forest = self._forest
        seen = {id(root)}
        stack = [root]
        while stack:
            node = stack.pop()
            if isinstance(node, Constant):
                if node.value is not False:
                    return forest.constant(True)
                continue
            reference = forest.first_reference(node)
            if reference is None:  # it has no value: told when the model is compiled
                return forest.constant(True)
            for value in self._values[reference.name]:
                part = forest.restrict(node, reference, value)
                if id(part) not in seen:
                    seen.add(id(part))
                    stack.append(part)
        return forest.constant(False)

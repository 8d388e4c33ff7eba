"""The names that expressions of a model may use, and what they stand for."""

from __future__ import annotations

from dataclasses import dataclass

from factored_polca.models.expressions import Constant, Expression, Parameter, Reference


@dataclass(frozen=True, slots=True)
class Scope:
    """The names an expression may use: features, observation features, parameters, named values."""

    features: frozenset[str] = frozenset()
    observations: frozenset[str] = frozenset()
    parameters: frozenset[str] = frozenset()
    values: frozenset[str] = frozenset()
    allow_next: bool = True

    def resolve(self, reference: Reference) -> Expression | str:
        """What a name stands for, or the message that it stands for nothing."""
        name = reference.name
        if name in self.features:
            if reference.primed and not self.allow_next:
                return f"{name}' (the next state) can't be used here"
            return reference
        if reference.primed:
            return f"{name}' : there is no feature {name!r}; {self._known()}"
        if name in self.observations:
            return reference
        if name in self.parameters:
            return Parameter(name)
        if name in self.values:
            return Constant(name)
        return f"unknown name {name!r}; {self._known()}"

    def _known(self) -> str:
        groups = (
            ("features", self.features),
            ("observations", self.observations),
            ("parameters", self.parameters),
            ("values", self.values),
        )
        parts = []
        for title, names in groups:
            if names:
                listed = sorted(names)
                shown = ", ".join(listed[:12]) + (", ..." if len(listed) > 12 else "")
                parts.append(f"{title}: {shown}")
        return "known " + "; ".join(parts) if parts else "no names are known here"

"""What an index of T, O and R ranges over: actions, states or observations, by name or by number."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from factored_polca.models.expressions import Constant
from factored_polca.models.scalars import Value, describe, scalar


@dataclass(frozen=True)
class Index:
    """The word for an index, what its values are numbered by, its values, and the constants for these.

    Values are numbered by their names and by their numbers themselves.  Where the file gives a count
    they are 0, 1, ...
    """

    word: str
    numbers: Mapping[str, int]
    values: tuple[Value, ...]
    constants: tuple[Constant, ...]

    @classmethod
    def of(cls, word: str, names: Sequence[str] | int) -> Index:
        """The index whose values have these names, or are counted by this number."""
        values: tuple[Value, ...] = tuple(range(names) if isinstance(names, int) else names)
        numbers = {str(number): number for number in range(len(values))}
        numbers |= {name: number for number, name in enumerate(values) if isinstance(name, str)}
        return cls(word, numbers, values, tuple(Constant(scalar(value)) for value in values))

    def __len__(self) -> int:
        return len(self.values)

    def show(self, number: int) -> str:
        """Value number `number` with the word for it."""
        return f"{self.word} {describe(scalar(self.values[number]))!r}"

    def allowed(self) -> str:
        """What may stand for this index, for messages."""
        numbers = f"0 to {len(self) - 1}" if len(self) > 1 else "0"
        names = [name for name in self.values[:12] if isinstance(name, str)]
        if not names:
            return f"{self.word}s are {numbers}"
        return f"{self.word}s are {', '.join(names)}{', ...' * (len(self) > 12)}; or {numbers}"

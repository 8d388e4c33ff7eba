"""The entries of a file in Cassandra's format as layers of the tables T, O and R.

An entry with all indices is one number, with one less a row, with two less a matrix.  A matrix gives
a layer for each of its rows; `identity`, `uniform` and `reset` give one layer, however large they are.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from fractions import Fraction
from typing import Final

from factored_polca.formats.cassandra_layers import ANY, Layer, Row, Steps
from factored_polca.formats.cassandra_names import Index
from factored_polca.formats.cassandra_numbers import Numbers
from factored_polca.formats.cassandra_preamble import Preamble, index_of
from factored_polca.formats.cassandra_tokens import Token, Tokens
from factored_polca.models.expressions import ZERO, Constant

_NAMED: Final = {"T": "transition", "O": "observation", "R": "reward"}


@dataclass
class Entries:
    """The layers of each table, in the order of the file."""

    tokens: Tokens
    numbers: Numbers
    preamble: Preamble
    steps: Steps
    layers: dict[str, list[Layer]] = field(default_factory=lambda: {"T": [], "O": [], "R": []})

    def read(self) -> None:
        """Read all entries, to the end of the file.

        Raises:
            ModelError: something is not right.
            StepLimit: too much work.
        """
        while self.tokens.token.kind != "end":
            self._entry(self.tokens.take())

    def _indices(self, table: str) -> tuple[Index, ...]:
        """What the indices of `table` range over."""
        p = self.preamble
        match table, p.observations:
            case "T", _:
                return (p.actions, p.states, p.states)
            case "O", Index() as observations:
                return (p.actions, p.states, observations)
            case "R", Index() as observations:
                return (p.actions, p.states, p.states, observations)
        return (p.actions, p.states, p.states)

    def _entry(self, token: Token) -> None:
        if token.kind == "number":
            hint = "what stands before it is complete: next is an entry, 'T:', 'O:' or 'R:'"
            raise self.tokens.error(f"unexpected {token}", token.start, hint)
        if token.text not in _NAMED or token.kind != "word":
            hint = "entries begin with 'T:', 'O:' or 'R:'"
            if token.text in ("discount", "values", "states", "actions", "observations", "start"):
                hint = "it must stand before the first T, O or R"
            raise self.tokens.error(f"unexpected {token}", token.start, hint)
        if token.text == "O" and self.preamble.observations is None:
            hint = "without 'observations:' the file is an MDP, which has no O"
            raise self.tokens.error("an observation probability without observations", token.start, hint)
        indices = self._indices(token.text)
        index = self._index(token, indices)
        layers = self.layers[token.text]
        before = len(layers)
        missing = len(indices) - len(index)
        if missing == 0:
            layers.append(self._cell(token, index))
        elif missing == 1:
            layers.append(Layer(index, ANY, self._row(token, indices[-1]), token.start))
        else:
            layers += self._matrix(token, index, indices)
        self.steps.count(len(layers) - before)

    def _index(self, token: Token, indices: tuple[Index, ...]) -> tuple[int, ...]:
        """The indices given, each after a colon."""
        tokens = self.tokens
        found: list[int] = []
        while tokens.at(":"):
            colon = tokens.token.start
            word = tokens.after_colon()
            if len(found) < len(indices):
                found.append(index_of(tokens, word, indices[len(found)]))
            elif token.text == "R" and self.preamble.observations is None and word.text == "*":
                break
            else:
                listed = " : ".join(index.word for index in indices)
                hint = f"{token.text}: {listed}, then a number"
                raise tokens.error(f"an index too many for {token.text}", colon, hint)
        least = len(indices) - 2
        if len(found) < least:
            words = " : ".join(index.word for index in indices[:least])
            raise tokens.error(f"expected ':' and more indices, found {tokens.token}",
                               hint=f"{token.text} has at least {token.text}: {words}")  # fmt: skip
        return tuple(found)

    # -- numbers, rows, matrices -------------------------------------------------------------

    def _cell(self, token: Token, index: tuple[int, ...]) -> Layer:
        read = self.numbers.rewards if token.text == "R" else self.numbers.probabilities
        found = read(1)
        if not found:
            raise self.tokens.error(f"expected a number, found {self.tokens.token}")
        content: Constant | Row = Row(found[0], {}) if index[-1] == ANY else found[0]
        return Layer(index[:-1], index[-1], content, token.start)

    def _row(self, token: Token, columns: Index) -> Row:
        return self._keyword(token, columns) or self._numbers(token, columns, "")

    def _matrix(self, token: Token, index: tuple[int, ...], indices: tuple[Index, ...]) -> list[Layer]:
        rows, columns = indices[-2:]
        if self.tokens.at("identity") and token.text != "R":
            if len(rows) != len(columns):
                raise self.tokens.error(
                    f"'identity' with {len(rows)} rows and {len(columns)} columns",
                    hint="only a square matrix can be the identity",
                )
            self.tokens.take()
            unit = Row(ZERO, {}, diagonal=self.numbers.constant(Fraction(1)))
            return [Layer((*index, ANY), ANY, unit, token.start)]
        same = self._keyword(token, columns)
        if same is not None:
            return [Layer((*index, ANY), ANY, same, token.start)]
        return [
            Layer(
                (*index, k),
                ANY,
                self._numbers(token, columns, f", row {k + 1} of {len(rows)}"),
                token.start,
            )
            for k in range(len(rows))
        ]

    def _keyword(self, token: Token, columns: Index) -> Row | None:
        """The row that a word stands for, None if the next token is none."""
        if self.tokens.token.kind != "word":
            return None
        if token.text != "R" and self.tokens.accept("uniform"):
            return Row(self.numbers.constant(Fraction(1, len(columns))), {})
        if token.text == "T" and self.tokens.accept("reset"):
            return self.preamble.start
        return None

    def _numbers(self, token: Token, columns: Index, which: str) -> Row:
        read = self.numbers.rewards if token.text == "R" else self.numbers.probabilities
        found = read(len(columns))
        if len(found) < len(columns):
            words = {"T": "'uniform', 'identity' or 'reset'", "O": "'uniform' or 'identity'", "R": ""}
            hint = f"{_NAMED[token.text]} rows have a number for each {columns.word}"
            if words[token.text] and not found:
                hint += f"; or one of {words[token.text]}"
            message = f"expected {len(columns)} numbers{which}, found {len(found)} and then"
            raise self.tokens.error(f"{message} {self.tokens.token}", hint=hint)
        cells = {column: number for column, number in enumerate(found) if number is not ZERO}
        return Row(ZERO, cells)

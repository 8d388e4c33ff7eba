"""The preamble of a file in Cassandra's format: discount, sign of the rewards, indices, start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Final

from factored_polca.formats.cassandra_layers import ANY, Row, StepLimit, Steps
from factored_polca.formats.cassandra_names import Index
from factored_polca.formats.cassandra_numbers import Numbers
from factored_polca.formats.cassandra_tokens import Token, Tokens
from factored_polca.models.check import MAXIMUM_VALUES
from factored_polca.models.expressions import ZERO, Constant

MAXIMUM_ACTIONS: Final = 10_000
"""Actions in one file."""

SECTIONS: Final = "'discount:', 'values:', 'states:', 'actions:', 'observations:' and 'start:'"
_WORDS: Final = {"states": "state", "actions": "action", "observations": "observation"}


@dataclass(frozen=True)
class Preamble:
    """What a file says before its entries; `observations` is None in an MDP.

    `start` holds the weights of the states as the file gives them, `start_place` is where, None
    where it does not.
    """

    discount: Fraction
    states: Index
    actions: Index
    observations: Index | None
    start: Row
    start_place: int | None


def read_preamble(tokens: Tokens, numbers: Numbers, steps: Steps) -> Preamble:
    """The preamble, up to the first entry or the end; values of an index count as steps.

    Raises:
        ModelError: it is not right, or something is missing.
    """
    return _Reader(tokens, numbers, steps).preamble()


@dataclass
class _Reader:
    tokens: Tokens
    numbers: Numbers
    steps: Steps
    seen: set[str] = field(default_factory=set)
    discount: Fraction | None = None
    indices: dict[str, Index] = field(default_factory=dict)
    start: tuple[Token, str, list[Token]] | None = None

    def preamble(self) -> Preamble:
        tokens = self.tokens
        while tokens.token.kind != "end" and not (
            tokens.token.text in ("T", "O", "R") and tokens.at_header()
        ):
            self._section(tokens.take())
        if self.discount is None:
            hint = "give one before the first T, O or R, for example: discount: 0.95"
            raise tokens.error("the file has no discount", hint=hint)
        for section in ("states", "actions"):
            if section not in self.indices:
                hint = f"before the first T, O or R: '{section}:' and a count, or the names"
                raise tokens.error(f"the file has no {section}", hint=hint)
        place = None if self.start is None else self.start[0].start
        return Preamble(
            self.discount, self.indices["states"], self.indices["actions"],
            self.indices.get("observations"), self._start(), place,
        )  # fmt: skip

    def _section(self, token: Token) -> None:
        if token.kind == "number":
            hint = "lists of names end with the next section; the names of a list can't be numbers"
            raise self.tokens.error(f"unexpected {token}", token.start, hint)
        if token.text not in ("discount", "values", "start", *_WORDS):
            hint = f"sections are {SECTIONS}; then entries begin with 'T:', 'O:' or 'R:'"
            raise self.tokens.error(f"unexpected {token}", token.start, hint)
        if token.text in self.seen:
            raise self.tokens.error(f"a second {token}", token.start, "it may be given once")
        self.seen.add(token.text)
        form = ""
        if token.text == "start" and (self.tokens.at("include") or self.tokens.at("exclude")):
            form = self.tokens.take().text
        self.tokens.expect(":", f"after {form or token.text!r}")
        match token.text:
            case "discount":
                self._discount()
            case "values":
                self._values()
            case "start":
                self.start = (token, form, self._until_header())
            case section:
                self.indices[section] = self._index(section, token)

    def _discount(self) -> None:
        token = self.tokens.take()
        self.discount = self.numbers.value(token)
        if not 0 <= self.discount <= 1:
            raise self.tokens.error(f"the discount is {token}", token.start, "0 <= discount <= 1")

    def _values(self) -> None:
        if self.tokens.at("cost"):
            self.numbers.cost = True
        elif not self.tokens.at("reward"):
            raise self.tokens.error(f"expected 'reward' or 'cost', found {self.tokens.token}")
        self.tokens.take()

    def _until_header(self) -> list[Token]:
        found = []
        while not self.tokens.at_header():
            found.append(self.tokens.take())
        return found

    # -- states, actions, observations -------------------------------------------------------

    def _index(self, section: str, start: Token) -> Index:
        most = MAXIMUM_ACTIONS if section == "actions" else MAXIMUM_VALUES
        listed = self._until_header()
        if not listed:
            hint = "give how many there are, or their names"
            raise self.tokens.error(f"there are no {section}", start.start, hint)
        if len(listed) == 1 and listed[0].kind == "number":
            count = self._integer(listed[0], most + 1)
            if count is None or count < 1:
                raise self.tokens.error(f"{listed[0]} {section}", listed[0].start, "at least 1")
            self._limit(count, most, section, listed[0])
            return Index.of(_WORDS[section], count)
        self._limit(len(listed), most, section, start)
        if all(self._integer(token, most) == k for k, token in enumerate(listed)):
            return Index.of(_WORDS[section], len(listed))
        names: dict[str, None] = {}
        for token in listed:
            if token.kind != "word":
                hint = "a name begins with a letter; numbers stand for those that have no name"
                if token.text == ":":
                    hint = f"sections are {SECTIONS}"
                raise self.tokens.error(f"{token} among the names of {section}", token.start, hint)
            if token.text in names:
                raise self.tokens.error(f"{section} lists {token} twice", token.start)
            names[token.text] = None
        return Index.of(_WORDS[section], list(names))

    def _limit(self, count: int, most: int, section: str, token: Token) -> None:
        if count > most:
            raise self.tokens.error(f"more than {most} {section}", token.start, f"at most {most} are read")
        try:
            self.steps.count(count)
        except StepLimit:
            raise self.tokens.error(f"too much work before {section}", token.start) from None

    @staticmethod
    def _integer(token: Token, most: int) -> int | None:
        """The count or index that `token` is, at most `most`; None if it is none."""
        digits = token.text.removeprefix("+")
        if token.kind != "number" or not digits.isdigit():
            return None
        return int(digits) if len(digits.lstrip("0")) < 10 else most

    # -- the start ---------------------------------------------------------------------------

    def _start(self) -> Row:
        states = self.indices["states"]
        even = Row(self.numbers.constant(Fraction(1, len(states))), {})
        if self.start is None:
            return even
        token, form, listed = self.start
        if not listed:
            hint = "probabilities, 'uniform' or a state"
            raise self.tokens.error("'start' says nothing", token.start, hint)
        if form:
            named = dict.fromkeys(self._state(state) for state in listed)
            count = len(named) if form == "include" else len(states) - len(named)
            if not count:
                raise self.tokens.error("'start exclude' leaves no state", token.start)
            share = self.numbers.constant(Fraction(1, count))
            return Row(*((ZERO, dict.fromkeys(named, share)) if form == "include" else
                         (share, dict.fromkeys(named, ZERO))))  # fmt: skip
        if len(listed) == 1:
            only = listed[0]
            if only.text == "uniform":
                return even
            if only.kind != "number" or (only.text.isdigit() and (len(states) > 1 or only.text == "0")):
                return Row(ZERO, {self._state(only): self.numbers.constant(Fraction(1))})
        return self._weights(listed)

    def _weights(self, listed: Sequence[Token]) -> Row:
        """The row of probabilities."""
        size = len(self.indices["states"])
        cells: dict[int, Constant] = {}
        for number, token in enumerate(listed[:size]):
            weight = self.numbers.probability(token)
            if weight is not ZERO:
                cells[number] = weight
        if len(listed) != size:
            place = listed[min(size, len(listed) - 1)].start
            message = f"'start' gives {len(listed)} numbers for {size} states"
            raise self.tokens.error(message, place, "a probability for each state")
        return Row(ZERO, cells)

    def _state(self, token: Token) -> int:
        number = index_of(self.tokens, token, self.indices["states"])
        if number == ANY:
            raise self.tokens.error("'*' as a start state", token.start, "use: start: uniform")
        return number


def index_of(tokens: Tokens, token: Token, index: Index) -> int:
    """The number that `token` has in `index`, or `ANY` for a wildcard.

    Raises:
        ModelError: it is none of its values.
    """
    known = index.numbers.get(token.text)
    if known is not None:
        return known
    if token.text == "*":
        return ANY
    digits = token.text.removeprefix("+")
    if digits.isascii() and digits.isdecimal():
        known = index.numbers.get(digits.lstrip("0") or "0")
        if known is not None:
            return known
    raise tokens.error(f"{token} is no {index.word}", token.start, index.allowed())

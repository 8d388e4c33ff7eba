"""Reader of Cassandra's format; the format is described in `factored_polca.formats.cassandra`.

One pass from left to right makes layers of the entries.  The tables are made at the end, action by
action; actions that no entry names by themselves share theirs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from factored_polca.formats.cassandra_entries import Entries
from factored_polca.formats.cassandra_layers import (
    MAXIMUM_STEPS,
    Layer,
    StepLimit,
    Steps,
    diagonal,
    slices,
    with_rows,
)
from factored_polca.formats.cassandra_numbers import Numbers
from factored_polca.formats.cassandra_preamble import read_preamble
from factored_polca.formats.cassandra_rows import Distributions, Ledger, RowFaults, Rows
from factored_polca.formats.cassandra_tables import Decisions
from factored_polca.formats.cassandra_tokens import Tokens
from factored_polca.models.errors import Fault, ModelError
from factored_polca.models.expressions import ZERO, Expression, Reference
from factored_polca.models.features import Feature
from factored_polca.models.model import Action, InitialBelief, Model, Observation, replace_fields

STATE: Final = "state"
OBSERVATION: Final = "observation"
"""The names of the feature and of the observation feature."""


def read_pomdp_with_warnings(text: str, name: str) -> tuple[Model, tuple[Fault, ...]]:
    """The model that `text` describes, called `name`, and what a careful reader should know.

    The one warning there may be tells of rows divided by sums near 1.

    Raises:
        ModelError: the text is not right, or asks for more work than the limits allow; every fault
            has a line and a column.
    """
    return _Reader(text).model(name)


class _Reader:
    def __init__(self, text: str) -> None:
        self.tokens = Tokens(text)
        self.numbers = Numbers(self.tokens)
        self.steps = Steps()
        self.preamble = read_preamble(self.tokens, self.numbers, self.steps)
        self.ledger = Ledger(self.tokens.fault)
        self.decisions = Decisions(self.steps)
        self.place = self.tokens.token.start  # what is being worked on, for messages
        self.entries = Entries(self.tokens, self.numbers, self.preamble, self.steps)

    def model(self, name: str) -> tuple[Model, tuple[Fault, ...]]:
        try:
            self.entries.read()
            initial = self._initial()
            effects, senses = self._effects(), self._senses()
            rewards = self._rewards() if not self.ledger.faults else []
        except StepLimit:
            raise self.tokens.error(
                f"the tables need more than {MAXIMUM_STEPS} steps", self.place,
                "fewer wildcards among the entries for single states, or whole rows, need less",
            ) from None  # fmt: skip
        except RowFaults:
            raise ModelError(self.ledger.faults) from None
        if self.ledger.faults:
            raise ModelError(self.ledger.faults)
        return self._assembled(name, initial, effects, senses, rewards), tuple(self.ledger.warnings())

    def _assembled(
        self,
        name: str,
        initial: InitialBelief,
        effects: Sequence[Expression],
        senses: Sequence[Expression],
        rewards: Sequence[Expression],
    ) -> Model:
        preamble = self.preamble
        observations = preamble.observations
        model = Model(
            name,
            [Feature(STATE, preamble.states.values)],
            (),
            discount=preamble.discount,
            observability="full" if observations is None else "partial",
            observations=() if observations is None else [Observation(OBSERVATION, observations.values)],
        )
        shared = all(reward is rewards[0] for reward in rewards)
        actions = []
        for number, value in enumerate(preamble.actions.values):
            persists = effects[number] == Reference(STATE)
            own = () if shared or rewards[number] is ZERO else (rewards[number],)
            actions.append(
                Action(
                    str(value),
                    () if persists else [(STATE, effects[number])],
                    rewards=own,
                    senses=() if observations is None else [(OBSERVATION, senses[number])],
                )
            )
        common = (rewards[0],) if shared and rewards[0] is not ZERO else ()
        # names are resolved already: resolving them again would walk over every table
        return replace_fields(model, actions=tuple(actions), rewards=common, initial=initial)

    # -- tables ------------------------------------------------------------------------------

    def _initial(self) -> InitialBelief:
        start, states = self.preamble.start, self.preamble.states
        if not start.cells:
            return InitialBelief()  # uniform
        rows = Rows("the start distribution", 1, self.preamble.start_place or 0)
        return InitialBelief(
            [(STATE, Distributions(states, self.steps, self.ledger).distribution(start, rows))]
        )

    def _effects(self) -> list[Expression]:
        states = self.preamble.states
        distributions = Distributions(states, self.steps, self.ledger)

        def effect(layers: Sequence[Layer], what: str, count: int) -> Expression:
            if len(layers) == 1 and diagonal(layers) is not None:
                return Reference(STATE)
            layers = with_rows(layers, len(states), self.steps)

            def row(given: str) -> Rows:
                return Rows(f"transitions of {what} from {given}", count, self.place)

            chosen, other = distributions.of_each(slices(layers, 1, self.steps), states, row)
            return self.decisions.persistent(Reference(STATE), states, chosen, other)

        return self._by_action("T", effect)

    def _senses(self) -> list[Expression]:
        states, observations = self.preamble.states, self.preamble.observations
        if observations is None:
            return []
        distributions = Distributions(observations, self.steps, self.ledger)

        def sensed(layers: Sequence[Layer], what: str, count: int) -> Expression:
            layers = with_rows(layers, len(states), self.steps)

            def row(given: str) -> Rows:
                return Rows(f"observations of {what} at the next {given}", count, self.place)

            chosen, other = distributions.of_each(slices(layers, 1, self.steps), states, row)
            return self.decisions.decision(Reference(STATE, primed=True), states, chosen, other)

        return self._by_action("O", sensed)

    def _rewards(self) -> list[Expression]:
        preamble = self.preamble
        path = [(Reference(STATE), preamble.states), (Reference(STATE, primed=True), preamble.states)]
        if preamble.observations is not None:
            path.append((Reference(OBSERVATION), preamble.observations))

        def reward(layers: Sequence[Layer], what: str, count: int) -> Expression:
            return self.decisions.rewards(layers, path)

        return self._by_action("R", reward)

    def _by_action(
        self, table: str, made: Callable[[Sequence[Layer], str, int], Expression]
    ) -> list[Expression]:
        """For each action, what `made` gives of its layers, its name and how many actions share them."""
        actions = self.preamble.actions
        layers = self.entries.layers[table]
        self.place = layers[0].start if layers else len(self.tokens.text)
        found = slices(layers, 0, self.steps)
        result: dict[int, Expression] = {}
        for number, part in found.named():
            self.place = part[-1].start
            result[number] = made(part, actions.show(number), 1)
        count = len(actions) - len(result)
        if count:
            rest = found.others()
            self.place = rest[-1].start if rest else len(self.tokens.text)
            other = made(rest, actions.show(found.first_other()), count)
            result = {number: result.get(number, other) for number in range(len(actions))}
        return [result[number] for number in range(len(actions))]

"""Storm as an oracle: what stormpy builds from a PRISM program, as plain data; its quotients and values."""

from __future__ import annotations

import tempfile
from collections import Counter
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest

stormpy = pytest.importorskip("stormpy", reason="needs the extra `storm`")

State = tuple[tuple[str, Any], ...]
"""Variables and their values, in the order of the names."""

Choices = Counter[tuple[Fraction, frozenset[tuple[State, Fraction]]]]
"""The choices of a state as reward and row; labels left out."""


def parse(text: str) -> Any:
    """A program."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.prism"
        path.write_text(text, encoding="utf-8")
        return stormpy.parse_prism_program(str(path))


def fraction(number: Any) -> Fraction:
    """Storm's rational as ours."""
    over, _, under = str(number).partition("/")
    return Fraction(int(over), int(under or 1))


def full_model(text: str, kind: str = "Rational") -> Any:
    """The sparse model of the reachable states, with names of actions and values of variables."""
    options = stormpy.BuilderOptions(build_full=True)
    return stormpy.build_model[getattr(stormpy, kind)](parse(text), options=options)


def explored(text: str, structure: str) -> tuple[dict[State, Choices], set[State]]:
    """The choices of each reachable state, exactly, with the rewards of a structure; and the deadlocks.

    In a deadlock Storm stays, as PRISM does, but earns nothing, where PRISM counts the state's reward.
    """
    program = parse(text)
    model = full_model(text)
    groups = [(program.global_integer_variables, program.global_boolean_variables)]
    groups += [(module.integer_variables, module.boolean_variables) for module in program.modules]
    valuations = model.state_valuations
    names: list[tuple[str, Any, bool]] = []
    for integers, truths in groups:
        names += [(v.name, v.expression_variable, False) for v in integers]
        names += [(v.name, v.expression_variable, True) for v in truths]
    names.sort(key=lambda entry: entry[0])

    def state(number: int) -> State:
        return tuple(
            (
                name,
                bool(valuations.get_boolean_value(number, variable))
                if truth
                else int(valuations.get_value(number, variable)),
            )
            for name, variable, truth in names
        )

    states = [state(number) for number in range(model.nr_states)]
    rewards = model.reward_models[structure]
    result: dict[State, Choices] = {}
    for s in model.states:
        found: Choices = Counter()
        for action in s.actions:
            reward = Fraction(0)
            if rewards.has_state_rewards:
                reward += fraction(rewards.get_state_reward(s.id))
            if rewards.has_state_action_rewards:
                choice = model.transition_matrix.get_row_group_start(s.id) + action.id
                reward += fraction(rewards.get_state_action_reward(choice))
            row = frozenset((states[entry.column], fraction(entry.value)) for entry in action.transitions)
            found[reward, row] += 1
        result[states[s.id]] = found
    return result, {states[s] for s in model.labeling.get_states("deadlock")}


def blocks(text: str) -> int:
    """Blocks of Storm's sparse bisimulation, which tells actions by their names, exactly."""
    options = stormpy.transformations.BisimulationOptions()
    options.action_sensitive = True
    options.preserve_choice_labels = True
    options.preserve_choice_origins = False
    options.preserve_all_rewards = True
    options.state_label_preservation = stormpy.transformations.StateLabelPreservation.NONE
    model = full_model(text, "RationalFunction")
    return int(stormpy.transformations.perform_bisimulation(model, [], options=options).nr_states)


def largest_reward(text: str) -> Fraction:
    """The largest expected total reward from the initial state, exactly."""
    program = parse(text)
    properties = stormpy.parse_properties('R{"reward"}max=? [ C ]', program)
    model = stormpy.build_model[stormpy.Rational](program, properties)
    (start,) = model.initial_states
    return fraction(stormpy.model_checking(model, properties[0]).get_value(start))

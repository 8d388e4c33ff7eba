"""pyRDDLGym's simulator as an oracle: what it says of single steps, as probabilities.

Its `Bernoulli` is made to give its probability in place of a draw.  Where a draw stands at the end of a
branch, as in every competition domain, the value of a definition is then the probability that it is true.
It evaluates whole arrays over all objects with numpy: nothing of it is shared with our reader.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np


@cache
def parser() -> Any:
    """pyRDDLGym's parser."""
    from ply import yacc
    from pyRDDLGym.core.parser.parser import RDDLParser

    made = RDDLParser()
    made.build(debug=False, write_tables=False, errorlog=yacc.NullLogger())
    return made


class Oracle:
    """One instance, read by pyRDDLGym."""

    def __init__(self, text: str) -> None:
        from pyRDDLGym.core.compiler.model import RDDLLiftedModel
        from pyRDDLGym.core.simulator import RDDLSimulator

        self.rddl = RDDLLiftedModel(parser().parse(text))
        self.simulator = RDDLSimulator(self.rddl)
        self.simulator._sample_bernoulli = self._probability

    def _probability(self, expression: Any, values: Any) -> Any:
        return self.simulator._sample(expression.args[0], values)

    def array(self, fluent: str, values: Mapping[str, Any]) -> Any:
        """The array of a lifted fluent, from values by our ground names."""
        shape = tuple(len(self.rddl.type_to_objects[kind]) for kind in self.rddl.variable_params[fluent])
        result = np.zeros(shape, dtype=bool)
        for name, value in values.items():
            base, arguments = split(name)
            if base == fluent:
                result[tuple(self.rddl.object_to_index[a] for a in arguments)] = value
        return result

    def put(self, state: Mapping[str, Any], action: str) -> None:
        """Set the present state and a joint action, by our names."""
        chosen = {} if action == "noop" else dict.fromkeys(action.split(" + "), True)
        for fluent in self.rddl.state_fluents:
            self.simulator.subs[fluent] = self.array(fluent, state)
        for fluent in self.rddl.action_fluents:
            self.simulator.subs[fluent] = self.array(fluent, chosen)

    def put_next(self, state: Mapping[str, Any]) -> None:
        """Set the next state."""
        for fluent, primed in self.rddl.next_state.items():
            self.simulator.subs[primed] = self.array(fluent, state)

    def chance(self, name: str, *, primed: bool) -> float:
        """The probability that a ground state-fluent is true next, or that an observ-fluent is."""
        base, arguments = split(name)
        _, expression = self.rddl.cpfs[f"{base}'" if primed else base]
        value = np.asarray(self.simulator._sample(expression, self.simulator.subs), dtype=float)
        index = tuple(self.rddl.object_to_index[a] for a in arguments)
        return float(value[index] if value.ndim else value)

    def reward(self) -> float:
        """The reward of the step."""
        return float(self.simulator.sample_reward())


def split(name: str) -> tuple[str, list[str]]:
    """`f(a,b)` as f and [a, b]."""
    match = re.fullmatch(r"([^(]+)(?:\((.*)\))?", name)
    assert match is not None
    return match[1], match[2].split(",") if match[2] else []


def texts(folder: str, instance: int) -> list[str]:
    """The domain and an instance of a folder of rddlrepository's competitions."""
    import rddlrepository

    place = Path(rddlrepository.__file__).parent / "archive" / "competitions" / folder
    names = ("domain.rddl", f"instance{instance}.rddl")
    return [(place / name).read_text(encoding="utf-8", errors="replace") for name in names]

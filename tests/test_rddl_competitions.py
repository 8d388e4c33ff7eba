"""The discrete competition domains of 2011 and 2014, one step at a time against pyRDDLGym's simulator.

At random states and actions every state-fluent's chance, every observ-fluent's and the reward must be those
that the simulator computes (in floats: hence the tolerance, some rounding errors of numbers of size 100).
"""

from __future__ import annotations

import random
from fractions import Fraction

import pytest

pytest.importorskip("pyRDDLGym")
pytest.importorskip("rddlrepository")

from rddl_in_process import run
from rddl_oracle import Oracle, texts

from factored_polca.explicit.evaluate import distribution, evaluate
from factored_polca.formats import rddl_process
from factored_polca.formats.rddl import read_rddl_with_warnings
from factored_polca.models.expressions import Reference

FOLDERS = [
    f"{year}/{name}/{kind}"
    for year, names in (
        ("IPPC2011", ("CooperativeRecon", "CrossingTraffic", "Elevators", "GameOfLife", "Navigation",
                      "SkillTeaching", "SysAdmin", "Traffic")),
        ("IPPC2014", ("AcademicAdvising", "Tamarisk", "TriangleTireworld", "Wildfire")),
    )
    for name in names
    for kind in ("MDP", "POMDP")
]  # fmt: skip
TOLERANCE = 1e-11


@pytest.fixture(autouse=True)
def _parsed_here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rddl_process, "_run", run)


@pytest.mark.parametrize("folder", FOLDERS)
def test_steps_have_the_simulator_s_probabilities(folder: str) -> None:
    both = texts(folder, 1)
    model, _, _ = read_rddl_with_warnings(both, ("domain", "instance"))
    oracle = Oracle("\n".join(text.replace("\r", "") for text in both) + "\n")
    rng = random.Random(folder)
    for _ in range(12):
        action = rng.choice(model.actions)
        density = rng.choice((0.1, 0.5, 0.9))
        state = {f.name: rng.random() < density for f in model.features}
        after = {f.name: rng.random() < density for f in model.features}
        oracle.put(state, action.name)
        now = {(name, False): value for name, value in state.items()}
        both_states = now | {(name, True): value for name, value in after.items()}
        effects = dict(action.effects)
        for feature in model.features:
            row = distribution(effects.get(feature.name, Reference(feature.name)), feature.values, now)
            assert isinstance(row, tuple), row
            assert float(row[1]) == pytest.approx(oracle.chance(feature.name, primed=True), abs=TOLERANCE)
        oracle.put_next(after)
        senses = dict(action.senses)
        for channel in model.observations:
            row = distribution(senses[channel.name], channel.values, both_states)
            assert isinstance(row, tuple), row
            assert float(row[1]) == pytest.approx(oracle.chance(channel.name, primed=False), abs=TOLERANCE)
        terms = [evaluate(term, both_states) for term in (*model.rewards, *action.rewards)]
        reward = sum(Fraction(term) for term in terms)
        assert float(reward) == pytest.approx(oracle.reward(), abs=TOLERANCE)

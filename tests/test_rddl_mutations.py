"""What the parsing process says is not trusted: mutated answers give a model or a fault, nothing else.

The answers for small texts are mutated: parts of expressions, declarations and definitions are replaced by
others or by strange ones.  The seed is fixed; MUTATIONS in the environment says how many there are.
"""

from __future__ import annotations

import json
import os
import random
from collections import Counter
from typing import Any

import pytest

pytest.importorskip("pyRDDLGym")

from rddl_texts import BOX, LIFT, WALK, rddl

from factored_polca.formats.rddl import built
from factored_polca.formats.rddl_fault import GroundingFault
from factored_polca.formats.rddl_process import parsed
from factored_polca.models import ModelError

MUTATIONS = int(os.environ.get("MUTATIONS", "500"))

MIXED = rddl(
    """c : { state-fluent, colour, default = @red }; k : { state-fluent, int, default = 0 };
    i : { interm-fluent, bool, level = 1 }; j : { derived-fluent, real, level = 1 };
    b : { action-fluent, bool, default = false }; n : { action-fluent, int, default = 0 };
    o : { observ-fluent, colour };""",
    """c' = if (i) then switch (c) { case @red : Discrete(colour, @red : 0.5, @blue : 0.5), default : @red }
        else UnnormDiscrete_{?x : colour} [1 + (?x == c)];
    k' = min[3, max[0, k + n]];
    i = Bernoulli(1 / (1 + exp[j]));
    j = 0.5 * k;
    o = if (b) then c' else @red;""",
    "k - 2 * i + pow[2, k]",
    types="colour : { @red, @blue };",
    sections="action-preconditions { n >= -1; n <= 1; }; termination { k == 3; };",
    concurrent="2",
)
STRANGE = ["?x", "@red", "x'", "1e9", "-1", "9" * 50, "0." + "1" * 900, "sum", "pow", "exp", "Bernoulli"]
STRANGE += ["=>", "negate", "", "a b", "__class__", "<b>", "../x"]


def mutate(data: dict[str, Any], others: list[str], rng: random.Random) -> None:
    """Change one thing."""
    kind = rng.randrange(10)
    if kind < 6:
        node = rng.choice(data["nodes"])
        field = rng.randrange(6)
        node[field] = json.loads(json.dumps(rng.choice(data["nodes"])[field]))
        if kind == 5:
            node[2] = rng.choice(STRANGE)
    elif kind == 6:
        node = rng.choice(data["nodes"])
        node[3] = node[3][:-1] if rng.random() < 0.5 else node[3] * 2
    elif kind == 9:
        key = rng.choice(list(data))
        data[key] = json.loads(rng.choice(others))[key]
    else:
        rows = data["fluents" if kind == 7 else "cpfs"]
        field = rng.randrange(len(rows[0]))
        rng.choice(rows)[field] = json.loads(json.dumps(rng.choice(rows)[field]))


def test_a_mutated_answer_is_a_model_or_a_fault() -> None:
    answers = [json.dumps(parsed(text)) for text in (LIFT, WALK, BOX, MIXED)]
    rng = random.Random(2718)
    outcomes: Counter[str] = Counter()
    for _ in range(MUTATIONS):
        data = json.loads(rng.choice(answers))
        for _ in range(rng.choice((1, 1, 2, 4))):
            mutate(data, answers, rng)
        try:
            built(data)
            outcomes["model"] += 1
        except (ModelError, GroundingFault):
            outcomes["fault"] += 1
    assert min(outcomes.values()) > MUTATIONS // 5  # both do happen

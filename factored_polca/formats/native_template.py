"""A commented starter model, for people who begin a new file."""

from __future__ import annotations

from factored_polca.formats.toml_text import toml_string

_TEMPLATE = """\
# A model for factored_polca, in the native format.  Everything after # is a comment.
#
# This one works as it is: a porter walks along a corridor of five cells, takes a parcel at the
# gate (cell 0) and leaves it at the store (cell 4).  Change it into your own, then run the
# command `check` on it.

name = @NAME@
description = "A porter brings a parcel from the gate to the store."

discount = 0.95             # exact: 19/20.  Fractions are texts: "19/20"
observability = "full"      # or "partial", with [observations] and what each action senses

# An episode ends where this holds; from then on nothing happens and nothing is earned.
terminal = "parcel == store"

# The reward of a step: one expression, or a list of expressions that are added up.
# parcel is the value now, parcel' the value after the step.
reward = ["-1", "20 if parcel' == store else 0"]

# Numbers that can be changed without editing the file.
[parameters]
slip = 0.1                  # the chance that a step fails

# The variables whose joint values are the states, in their order: a range, a list or "boolean".
[features]
cell = "0..4"
parcel = ["gate", "hand", "store"]

# Where it starts: a value, a distribution {value: probability, ...}, or "uniform".
[initial]
cell = "uniform"
parcel = "gate"

# Each action says how features change.  A feature that an action doesn't mention stays as it is.
# A distribution lists values with their probabilities, which sum to exactly 1.
[actions.forward]
effects.cell = "{cell + 1: 1 - slip, cell: slip} if cell < 4 else cell"

[actions.back]
effects.cell = "{cell - 1: 1 - slip, cell: slip} if cell > 0 else cell"

[actions.take]
applicable = "cell == 0 and parcel == gate"
effects.parcel = "hand"

# Without `applicable` an action can be chosen everywhere; here it costs where it makes no sense.
[actions.leave]
effects.parcel = "switch(cell, 4: store, else: hand) if parcel == hand else parcel"
reward = "0 if cell == 4 and parcel == hand else -10"

# Subtasks, for hierarchical planning; leave them all out for a flat model.  A task chooses among
# primitive actions and other tasks.  It ends where its own terminal condition or the model's holds.
[tasks.Deliver]
actions = ["Fetch", "Bring"]

[tasks.Fetch]
actions = ["forward", "back", "take"]
terminal = "parcel != gate"
# A reward of the task's own, in place of the model's (adds_reward = true adds the two):
pseudo_reward = -1

[tasks.Bring]
actions = ["forward", "back", "leave"]
terminal = "parcel != hand"
"""


def template(name: str) -> str:
    """The text of a small, sound model called `name` with tasks, explained by comments."""
    return _TEMPLATE.replace("@NAME@", toml_string(name))

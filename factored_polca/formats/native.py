"""The native format: a model and its tasks as TOML (toml.io), with a small expression language.

    name = "errand"                    # the file's name where it is missing
    description = "..."
    discount = 0.95                    # exactly 19/20; "1/3" for other fractions
    horizon = 40                       # leave it out for an infinite horizon
    observability = "partial"          # or "full", which is the default
    terminal = "place == home and full"
    reward = ["-1", "10 if full' else 0"]        # one expression over x, x', o, or a list added up
    initial_factors = ["..."]          # further factors of the initial belief

    [parameters]                       # numbers; `read_native(..., overrides)` changes them
    slip = 0.1

    [features]                         # their order is the order of the variables
    full = "boolean"                   # false, true
    height = "0..4"                    # 0, 1, 2, 3, 4
    place = ["home", "shop"]           # texts, integers, true and false
    door = { values = ["open", "shut"], observed = true }

    [observations]
    light = ["on", "off", "none"]
    sound = { values = [0, 1, 2], null = 0 }     # `null`: what actions report that don't sense it

    [initial]                          # feature -> its distribution; "uniform" is one
    height = "uniform"
    place = "{home: 3/4, shop: 1/4}"

    [actions.climb]
    effects.height = "{height + 1: 1 - slip, height: slip} if height < 4 else height"
    senses.light = "{on: 0.9, off: 0.1} if full' else off"
    applicable = "place == home"       # fully observed models only
    reward = "-height"                 # added to the model's

    [tasks.Up]
    actions = ["climb", "Rest"]        # primitive actions and other tasks
    terminal = "height == 4"
    pseudo_reward = ["-1", { climb = "-2", jump = ["-2", "-height"] }]
    adds_reward = true                 # the model's reward counts too
    observes = ["light"]
    solver = "..."

Expressions are texts in the language of `factored_polca.models.language`; where an expression is
expected a TOML number, true or false will do.  `pseudo_reward` is a term for all actions, a table
with the terms of single actions, or a list of both.  `initial_factors` stands outside [initial]
because there every key is a feature.  Every key is known or an error.
"""

from factored_polca.formats.document import Document
from factored_polca.formats.native_reader import read_native, read_native_tasks
from factored_polca.formats.native_template import template
from factored_polca.formats.native_writer import write_native

__all__ = ["Document", "read_native", "read_native_tasks", "template", "write_native"]

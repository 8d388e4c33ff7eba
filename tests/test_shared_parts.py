"""What actions share is looked at once, and an expression with too many values ends in a limit, counted."""

from __future__ import annotations

import sys

import pytest

from factored_polca.models import Action, Feature, LimitReached, Model, boolean, check, lottery
from factored_polca.models import check as check_function
from factored_polca.models.expressions import Switch
from factored_polca.models.model import replace_fields
from factored_polca.symbolic import compile_model, expressions


def test_a_table_that_many_actions_share_is_checked_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """300 actions over one table of 300 rows: the visits grow with their sum, not with their product."""
    module = sys.modules[check_function.__module__]
    x = Feature("x", range(300))
    rows = tuple((v, lottery({(v + 1) % 300: "0.5", v: "0.5"})) for v in range(300))
    table = Switch(x.now, rows)
    model = Model("m", [x], (), discount="0.9")  # names are resolved: readers of formats share their tables
    model = replace_fields(model, actions=tuple(Action(f"a{k}", {x: table}) for k in range(300)))
    visits = 0
    whole = module.children

    def counting(expression: object) -> object:
        nonlocal visits
        visits += 1
        return whole(expression)

    monkeypatch.setattr(module, "children", counting)
    assert check(model) == []
    assert visits < 10_000  # a row has some five parts, each seen twice


def test_a_product_of_many_factors_ends_in_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its values double with each factor: 2^20 here."""
    monkeypatch.setattr(expressions, "MAXIMUM_TABLE", 5_000)
    features = [boolean(f"x{k}") for k in range(20)]
    product = " * ".join(f"({k + 2}.5 if x{k} else 1)" for k in range(20))
    model = Model("m", features, [Action("a")], rewards=product, discount="0.9")
    with pytest.raises(LimitReached, match="more than 5,000 different values, as a product") as caught:
        compile_model(model)
    assert caught.value.stage == "compiling the model"

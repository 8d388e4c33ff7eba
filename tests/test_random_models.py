"""The random models and hierarchies of the tests are sound, varied and deterministic."""

from __future__ import annotations

from random_models import random_model, random_tasks

from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.explicit.minimiser import minimise
from factored_polca.explicit.subtask import primitives_below
from factored_polca.models import (
    Constant,
    check,
    check_tasks,
    parse,
    to_text,
)
from factored_polca.models.expressions import references

SEEDS = range(60)


def test_random_models_are_sound_varied_and_deterministic() -> None:
    kinds = dict.fromkeys(
        ("full", "between", "terminal", "inapplicable", "backward arc", "rounds", "factors", "network"), 0
    )
    for seed in SEEDS:
        model = random_model(seed, max_states=64)
        assert model == random_model(seed, max_states=64)
        assert check(model) == []
        mdp = enumerate_model(model)
        partition = minimise(mdp)
        distinct = mdp.states - max(0, sum(mdp.terminal) - 1)
        kinds["full"] += partition.blocks == distinct
        kinds["between"] += 1 + any(mdp.terminal) < partition.blocks < distinct
        kinds["rounds"] += partition.rounds > 1
        kinds["terminal"] += any(mdp.terminal)
        assert not all(mdp.terminal)
        applying = [[mask[s] for mask in mdp.applicable] for s in range(mdp.states) if not mdp.terminal[s]]
        assert all(any(masks) for masks in applying)
        kinds["inapplicable"] += not all(all(masks) for masks in applying)
        order = [feature.name for feature in model.features]
        kinds["backward arc"] += any(
            order.index(reference.name) > order.index(name)
            for action in model.actions
            for name, effect in action.effects
            for reference in references(effect)
            if reference.primed
        )
        kinds["factors"] += bool(model.initial.factors)
        kinds["network"] += any(references(e) for _, e in model.initial.distributions)
        for text in [to_text(effect) for action in model.actions for _, effect in action.effects]:
            assert to_text(parse(text)) == text
    assert all(count >= 4 for count in kinds.values()), kinds
    assert kinds["between"] >= len(SEEDS) // 2


def test_random_models_can_have_parameters() -> None:
    models = [random_model(seed, parameters=True) for seed in SEEDS[:20]]
    assert all(check(model) == [] and enumerate_model(model).states == model.states for model in models)
    assert any("p" in to_text(e) for model in models for action in model.actions for _, e in action.effects)


def test_random_hierarchies_are_sound_and_varied() -> None:
    shared = deep = 0
    for seed in SEEDS:
        model = random_model(seed, max_states=16)
        hierarchy = random_tasks(seed, model)
        assert hierarchy == random_tasks(seed, model)
        assert check_tasks(model, hierarchy) == []
        assert 2 <= len(hierarchy.tasks) <= 4
        (root,) = hierarchy.roots()
        names = {task.name for task in hierarchy.tasks}
        children = [action for task in hierarchy.tasks for action in task.actions if action in names]
        shared += len(children) > len(set(children))
        deep += any(set(task.actions) & names for task in hierarchy.tasks if task is not root)
        assert set(root.actions) & names
        assert set(root.actions) - names
        assert set(primitives_below(model, hierarchy, root.name)) <= {a.name for a in model.actions}
        for task in hierarchy.tasks:
            assert task is root or (task.has_pseudo_reward and task.terminal != Constant(False))
    assert shared >= 5
    assert deep >= 10

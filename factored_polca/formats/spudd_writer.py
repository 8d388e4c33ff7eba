"""Writer of SPUDD's language; the language is described in `factored_polca.formats.spudd`.

Every expression is expanded into a decision tree over features (Shannon), so any model can be
written whose trees stay small.  Rows of an MDP are written as lists of probabilities, as SPUDD's own
examples have them, those of a POMDP as trees over the next value, which Symbolic Perseus needs.  The
language has decimals only: where a row has a probability such as 1/3, the file says `unnormalised`
and gives whole-number weights.  It has no terminal states: they are written as absorbing with
reward 0 for every action, which gives each state and belief the same value.  Nor has it observed features:
where the start leaves no doubt of their value, an observation `see_x` reports x after each step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from factored_polca.formats.spudd_model_trees import ModelTrees, require_decimal
from factored_polca.formats.spudd_names import spell
from factored_polca.formats.spudd_rows import decimal
from factored_polca.formats.spudd_text import Layout
from factored_polca.formats.spudd_trees import Assignment, TreeLimit
from factored_polca.models.check import check
from factored_polca.models.errors import Fault, ModelError
from factored_polca.models.expressions import TRUE, Constant, Expression, Lottery, Reference
from factored_polca.models.features import Feature
from factored_polca.models.model import Action, Model, Observation, replace_fields

Path = tuple[str, ...]
Leaf = Callable[[Expression, Assignment], Expression]


def write_spudd(model: Model) -> str:
    """`model` in SPUDD's language.

    Raises:
        ModelError: the model is not right, or the language can't express it; every fault names the
            place in the model and the reason.
    """
    faults = [fault for fault in check(model) if fault.severity == "error"] or list(_refusals(model))
    if faults:
        raise ModelError(faults)
    model = _with_reports(model)
    try:
        return _text(model, ModelTrees(model))
    except TreeLimit as limit:
        raise ModelError(f"the model is too large to be written as decision trees: {limit}") from None


def _refusals(model: Model) -> Iterable[Fault]:
    """What the language can't express, apart from numbers."""
    native = "use the native format"
    for action in model.actions:
        if action.applicable != TRUE:
            path: Path = ("actions", action.name, "applicable")
            yield Fault("SPUDD's actions are applicable everywhere", path,
                        f"say what the action does elsewhere, or {native}")  # fmt: skip
    variables: list[tuple[str, Feature | Observation]] = [("features", f) for f in model.features]
    variables += [("observations", o) for o in model.observations]
    for kind, variable in variables:
        if len(variable.values) < 2:
            yield Fault("SPUDD's variables have two values or more", (kind, variable.name), "leave it out")
    if model.observability == "full":
        return
    for feature in model.features:
        if feature.observed and not _foretold(model, feature):
            message = "the language has no observed features, and no observation before the first action"
            hint = f"give {feature.name} one value at the start: an observation will report it from then on"
            yield Fault(message, ("features", feature.name), hint)


def _foretold(model: Model, feature: Feature) -> bool:
    """Whether the initial belief gives `feature` one value, written as such."""
    given = dict(model.initial.distributions).get(feature.name)
    if isinstance(given, Lottery):
        return len(given.outcomes) == 1
    return isinstance(given, Constant)


def _with_reports(model: Model) -> Model:
    """`model` with an observation for each observed feature of a partially observed model."""
    observed = [f for f in model.features if f.observed]
    if model.observability == "full" or not observed:
        return model
    taken = {f.name for f in model.features} | {o.name for o in model.observations}
    names = {}
    for feature in observed:
        name = f"see_{feature.name}"
        while name in taken:
            name += "_"
        taken.add(name)
        names[feature.name] = name
    channels = [Observation(names[f.name], f.values, null=f.values[0]) for f in observed]
    actions = [
        Action(
            a.name,
            a.effects,
            applicable=a.applicable,
            rewards=a.rewards,
            senses=[*a.senses, *((names[f.name], f.next) for f in observed)],
        )
        for a in model.actions
    ]
    features = tuple(Feature(f.name, f.values) for f in model.features)
    observations = (*model.observations, *channels)
    return replace_fields(model, features=features, actions=tuple(actions), observations=observations)


def _text(model: Model, trees: ModelTrees) -> str:
    names = spell(model)
    full = model.observability == "full"
    layout = Layout(names, trees.values, frozenset(o.name for o in model.observations), rows=full)
    lines = [*_head(model, trees.ends, names.changed)]
    sections: list[tuple[str, Sequence[Feature | Observation]]] = [("variables", model.features)]
    if not full:
        sections.append(("observations", model.observations))
    for word, variables in sections:
        lines.append(f"({word}")
        lines += [f"  ({names.variables[v.name]} {' '.join(names.values[v.name])})" for v in variables]
        lines.append(")")
    if trees.initial:
        lines += _combined(layout, "init", trees.initial, "*", lines)
    if trees.unnormalised:
        lines.append("unnormalised")
    for action, parts in zip(model.actions, trees.actions, strict=True):
        body = [f"action {names.actions[action.name]}"]
        for feature in model.features:
            spelled = names.variables[feature.name]
            if feature.name in parts.effects:
                target = Reference(feature.name, primed=True)
                body += layout.tree(f"  {spelled} ", parts.effects[feature.name], target, lines)
            else:
                body.append(f"  {spelled} (SAME{spelled})")
        if parts.senses:
            body.append("  observe")
            for name, tree in parts.senses.items():
                body += layout.tree(f"    {names.variables[name]} ", tree, Reference(name), lines)
            body.append("  endobserve")
        if parts.costs:
            body += _combined(layout, "  cost", parts.costs, "+", lines)
        lines += [*body, "endaction"]
    rewards = _combined(layout, "reward", trees.rewards, "+", lines)
    lines += rewards
    lines.append(f"discount {require_decimal(model.discount, ('discount',))}")
    lines.append("tolerance 0.001" if model.horizon is None else f"horizon {model.horizon}")
    return "\n".join(lines) + "\n"


def _combined(
    layout: Layout, word: str, trees: Sequence[Expression], symbol: str, before: list[str]
) -> list[str]:
    """`word` and the sum or product of `trees`; what it names is added to `before`."""
    if len(trees) == 1:
        return layout.tree(f"{word} ", trees[0], None, before)
    indent = " " * (len(word) - len(word.lstrip()))
    lines = [f"{word} [{symbol}"]
    for tree in trees:
        lines += layout.tree(f"{indent}  ", tree, None, before)
    return [*lines, f"{indent}]"]


def _head(model: Model, ends: bool, changed: Sequence[str]) -> Iterable[str]:
    yield _comment(f"{model.name}: {model.description}" if model.description else model.name)
    for line in changed:
        yield _comment(f"written otherwise: {line}")
    if model.parameters:
        yield _comment("parameters: " + ", ".join(f"{name} = {decimal(v)}" for name, v in model.parameters))
    if ends:
        yield _comment("the model's terminal states are absorbing here, with reward 0 for every action")
    if model.observability == "full" and (model.initial.distributions or model.initial.factors):
        yield _comment("'init' is Symbolic Perseus' addition: SPUDD itself reads the file without it")


def _comment(text: str) -> str:
    """One line; SPUDD ends a comment at a closing brace, so there is none in it."""
    clean = "".join(c if c.isprintable() and c not in "{}" else " " for c in text)
    return f"// {clean[:500]}".rstrip()

"""Objects with rows as data frames: one row for what the object lists, plain columns.

`FRAMED_BY` maps each class to the function that reads its columns; pandas is loaded by `frame` only.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np

from factored_polca.display.extras import library

Columns = Mapping[str, Sequence[Any]]
"""The cells of each column, by its name."""


def frame(thing: object) -> Any:
    """The rows of an object as a `pandas.DataFrame`.

    Raises:
        TypeError: nothing that has rows; the message lists what has.
        MissingLibrary: pandas is not installed.
    """
    return library("pandas", "frames", "a data frame").DataFrame(dict(columns(thing)))


def columns(thing: object) -> Columns:
    """The same as plain lists.

    Raises:
        TypeError: nothing that has rows; the message lists what has.
    """
    for kind in type(thing).__mro__:
        name = f"{kind.__module__}.{kind.__qualname__}".removeprefix("factored_polca.")
        if name in FRAMED_BY:
            return FRAMED_BY[name](thing)
    listed = ", ".join(sorted(name.rpartition(".")[2] for name in FRAMED_BY))
    raise TypeError(f"{type(thing).__name__} has no rows; what has: {listed}")


def by_column(rows: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Rows as columns, in the order in which their names first occur; None where a row lacks one."""
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: [row.get(name) for row in rows] for name in names}


def plan_columns(plan: Any) -> Columns:
    """A row for each task, children first; actions and observations by their numbers."""
    from factored_polca.display.hierarchy_view import task_rows

    rows = []
    for report in task_rows(plan):
        row = {}
        for key, value in report.items():
            if key == "observations":
                row["observations_before"] = sum(one["before"] for one in value.values())
                row["observations_after"] = sum(one["after"] for one in value.values())
            elif key == "parameters":
                row |= {f"parameters_{name}": count for name, count in value.items()}
            elif isinstance(value, (list, tuple)):
                row[key] = ", ".join(map(str, value)) if key == "observes" else len(value)
            else:
                row[key] = value
        rows.append(row)
    return by_column(rows)


def partition_columns(partition: Any) -> Columns:
    """A row for each block: its exact number of states, and its formula where a short one was found."""
    from factored_polca.display.partition_view import block_formulas

    told = list(block_formulas(partition, None, 10_000))
    where = [None if said.startswith("no short formula") else said for said in told]
    return {"block": list(range(partition.blocks)), "states": list(partition.sizes), "where": where}


def quotient_columns(quotient: Any) -> Columns:
    """A row for each transition between blocks: its action, probability and expected reward."""
    mdp = quotient.mdp
    blocks: list[int] = []
    names: list[str] = []
    targets: list[int] = []
    chances: list[float] = []
    rewards: list[float] = []
    for number, (name, matrix) in enumerate(zip(mdp.actions, mdp.transitions, strict=True)):
        entries = matrix.tocoo()
        order = np.lexsort((entries.col, entries.row))
        blocks += entries.row[order].tolist()
        targets += entries.col[order].tolist()
        chances += entries.data[order].tolist()
        names += [name] * len(order)
        rewards += mdp.rewards[number, entries.row[order]].tolist()
    return {"block": blocks, "action": names, "next": targets, "probability": chances, "reward": rewards}


def pomdp_quotient_columns(quotient: Any) -> Columns:
    """The same with the merged observation of each transition, by its label."""
    pomdp = quotient.pomdp
    rows = []
    for action, name in enumerate(pomdp.actions):
        for label, matrix in zip(pomdp.observations[action], pomdp.kernel[action], strict=True):
            entries = matrix.tocoo()
            for s, t, q in zip(
                entries.row.tolist(), entries.col.tolist(), entries.data.tolist(), strict=True
            ):
                reward = float(pomdp.rewards[action, s])
                rows.append((s, name, label, t, q, reward))
    rows.sort(key=lambda row: (pomdp.actions.index(row[1]), row[0], row[3]))
    names = ("block", "action", "observation", "next", "probability", "reward")
    return {name: [row[k] for row in rows] for k, name in enumerate(names)}


def reduction_columns(found: Any) -> Columns:
    """Those of its quotient."""
    return columns(found.quotient)


def minimisation_columns(found: Any) -> Columns:
    """Those of its partition."""
    return columns(found.partition)


def history_columns(solution: Any) -> Columns:
    """The bounds over time."""
    history = solution.history
    return {key: [getattr(b, key) for b in history] for key in ("seconds", "lower", "upper")}


def state_columns(solution: Any) -> Columns:
    """Value, bounds and choice of each state."""
    count = len(solution.values)
    arrays = {"value": solution.values, "lower": solution.lower, "upper": solution.upper}
    listed = {name: array.tolist() for name, array in arrays.items()}
    return {"state": list(range(count)), **listed, "choice": solution.policy.tolist()}


def episode_columns(runs: Any) -> Columns:
    """The return of each episode."""
    return {"episode": list(range(len(runs.returns))), "return": runs.returns.tolist()}


def comparison_columns(comparison: Any) -> Columns:
    """The returns of both in each episode, and their difference."""
    first, second = comparison.first_returns, comparison.second_returns
    return {
        "episode": list(range(len(first))),
        "first": first.tolist(),
        "second": second.tolist(),
        "difference": (first - second).tolist(),
    }


def trace_columns(trace: Any) -> Columns:
    """A row for each step; features, observations and beliefs have columns of their own."""
    rows = []
    for number, step in enumerate(trace.steps):
        row: dict[str, Any] = {"step": number} | {f"state.{name}": v for name, v in step.state.items()}
        row |= {"path": " > ".join(step.path), "action": step.action, "reward": step.reward}
        row |= {f"observed.{name}": value for name, value in (step.observation or {}).items()}
        for name, chances in step.beliefs.items():
            values = trace.model.feature(name).values
            row |= {f"belief.{name}={v}": float(q) for v, q in zip(values, chances, strict=True)}
        rows.append(row)
    return by_column(rows)


def parameters_columns(study: Any) -> Columns:
    """Figure 4a: the parameters of each task's model, in three readings."""
    keys = ("name", "none", "polca", "polca_plus")
    return {key: [getattr(task, key) for task in study.tasks] for key in keys}


def rewards_columns(study: Any) -> Columns:
    """Figure 4b: the mean cumulative reward of each policy after each step, and its standard error."""
    names: list[str] = []
    steps: list[int] = []
    means: list[float] = []
    errors: list[float] = []
    for one in study.earned:
        names += [one.name] * len(one.cumulative)
        steps += range(1, len(one.cumulative) + 1)
        means += one.cumulative.tolist()
        errors += one.cumulative_error.tolist()
    return {"policy": names, "step": steps, "cumulative_reward": means, "standard_error": errors}


def q_values_columns(study: Any) -> Columns:
    """Figure 4c: a row for each method and each of PolCA's counts: values stored, visited, the return."""
    rows = []
    for domain in study.to_data()["domains"]:
        name = domain["domain"]
        for one in domain["learners"]:
            row = {"domain": name, "method": one["name"], "discount": one["discount"]}
            row |= {"stored_values": one["stored_values"], "visited": one["visited"]}
            row |= {"return": one["final_return"], "episodes_to_optimum": one["episodes_to_optimum"]}
            rows.append(row)
        for one in domain["polca"]:
            for count in ("q_values", "q_applicable", "q_classes", "q_classes_shared"):
                row = {"domain": name, "method": f"PolCA {count}", "discount": one["discount"]}
                rows.append(row | {"stored_values": one[count], "return": one["return"]})
    return by_column(rows)


FRAMED_BY: Final[dict[str, Callable[[Any], Columns]]] = {
    "hierarchy.plan.HierarchicalPlan": plan_columns,
    "hierarchy.pomdp_plan.PomdpPlan": plan_columns,
    "hierarchy.executable.ExecutablePlan": plan_columns,
    "hierarchy.pomdp_executable.ExecutablePomdpPlan": plan_columns,
    "minimisation.partition.Partition": partition_columns,
    "minimisation.refine.Minimisation": minimisation_columns,
    "minimisation.reduction.Reduction": reduction_columns,
    "minimisation.quotient.Quotient": quotient_columns,
    "minimisation.pomdp_quotient.PomdpQuotient": pomdp_quotient_columns,
    "solvers.result.MDPSolution": state_columns,
    "solvers.pomdp_result.POMDPSolution": history_columns,
    "simulation.simulate.Simulation": episode_columns,
    "simulation.belief_runs.BeliefRuns": episode_columns,
    "simulation.trace.Trace": trace_columns,
    "simulation.comparison.Comparison": comparison_columns,
    "studies.parameters.ParameterStudy": parameters_columns,
    "studies.rewards.RewardStudy": rewards_columns,
    "studies.q_values.QValueStudy": q_values_columns,
}
"""Class -> the function that reads its rows."""

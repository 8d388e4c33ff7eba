"""Policies over beliefs as graphs with the belief on each node, and bounds over time."""

from __future__ import annotations

from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest
from belief_plans import corridor

import factored_polca as fp
from factored_polca import display
from factored_polca.display.belief_graph import brief, by_block, by_feature, policy_graph
from factored_polca.display.charts import Series, histogram, line_chart, nice_ticks
from factored_polca.display.solution_view import bounds_limits
from factored_polca.explicit.state_policy import StatePolicy
from factored_polca.hierarchy.policy_file import FlatPolicy
from factored_polca.minimisation.flat_model import flat_model
from factored_polca.solvers.pomdp_result import Bounds

TIGER = ("listen", "tiger: left 50 %, right 50 %")


def policy_for(name: str, method: str, **demand: Any) -> FlatPolicy:
    flat = flat_model(fp.compile_model(fp.load_domain(name).model))
    solution = fp.solve_pomdp(flat.pomdp, method, demand=fp.Demand(**demand))
    return FlatPolicy(flat, solution.policy, {"lower": solution.lower, "upper": solution.upper})


@pytest.mark.parametrize("method", ["auto", "sarsop"], ids=["policy graph", "vectors"])
def test_the_tiger_s_optimal_policy_is_its_five_nodes(method: str) -> None:
    """Listen until one side is two growls ahead: 0.85^2 / (0.85^2 + 0.15^2) = 0.9698."""
    policy = policy_for("tiger", method, gap=1e-3)
    graph = display.graph(policy)
    assert {node.lines for node in graph.nodes} == {
        TIGER,
        ("listen", "tiger: left 85 %, right 15 %"),
        ("listen", "tiger: right 85 %, left 15 %"),
        ("open_right", "tiger: left 97 %, right 3 %"),
        ("open_left", "tiger: right 97 %, left 3 %"),
    }
    by_key = {node.key: node for node in graph.nodes}
    arcs = {(by_key[e.source].lines, e.label): by_key[e.target].lines[0] for e in graph.edges}
    assert arcs[TIGER, "growl=left"] == "listen"
    assert graph.note == ""
    assert "19.37" in policy._repr_html_()


def test_a_policy_for_a_horizon_keeps_its_steps_apart() -> None:
    """With two steps to go the tiger's policy listens twice; each belief after a growl is met once."""
    model = fp.load_domain("tiger").model
    flat = flat_model(fp.compile_model(model))
    solution = fp.solve_pomdp(flat.pomdp, "exact", horizon=2)
    graph = policy_graph(
        flat.pomdp, solution.policy, by_feature(model.features, flat.states.astype(np.int64))
    )
    actions = [node.lines[0] for node in graph.nodes]
    assert actions.count("listen") == 3
    assert actions.count("nothing") == 3
    assert "open_left" not in actions


def test_an_episode_that_ends_is_an_arc_to_its_end() -> None:
    flat = flat_model(fp.compile_model(corridor(ending=True)))
    solution = fp.solve_pomdp(flat.pomdp, "sarsop", demand=fp.Demand(gap=0.1))
    graph = display.graph(FlatPolicy(flat, solution.policy))
    ended = [node for node in graph.nodes if node.kind == "terminal"]
    assert [node.lines for node in ended] == [("ended",)]
    assert any(edge.target == "ended" for edge in graph.edges)

    # `place` is seen at the start, 0 or 1: two beliefs begin
    begun = {node.lines[1:] for node in graph.nodes if "after 0 steps" in node.title}
    assert len(begun) == 1
    assert len([node for node in graph.nodes if "after 0 steps" in node.title]) == 2


def test_a_large_policy_is_cut_to_what_is_likeliest_reached() -> None:
    policy = policy_for("hallway", "sarsop", gap=1e-3, iterations=20)
    graph = display.graph(policy)
    assert len(graph.nodes) == 25
    assert "likeliest" in graph.note
    assert graph.nodes[-1].kind == "more"
    assert len(policy._repr_html_()) < 200_000


def test_a_policy_of_states_is_a_table_of_actions() -> None:
    flat = flat_model(fp.compile_model(fp.load_domain("taxi").model))
    found = fp.solve_mdp(flat.to_mdp())
    policy = FlatPolicy(flat, StatePolicy(found.policy[None, :]))
    shown = policy._repr_html_()
    assert "Pickup" in shown
    assert "such as" in shown
    assert "not reached" in shown
    first = display.graph(policy).nodes[0]
    assert first.lines == ("passenger",)
    assert "at most" in found._repr_html_()


def test_a_task_of_a_plan_shows_bounds_and_beliefs() -> None:
    domain = fp.load_domain("meds")
    found = fp.plan(domain.model, domain.tasks)
    for task in found.solved:
        shown = task._repr_html_()
        assert task.task.name in shown
        assert "Bounds over time" in shown or len(task.solution.history) < 2
        HTMLParser().feed(shown)
    boxes = {node.key: " ".join(node.lines) for node in display.graph(found).nodes}
    for task in found.solved:
        assert f"{task.reduction.partition.blocks} blocks" in boxes[task.task.name]
    assert found.root.to_mermaid().startswith("flowchart")


def test_beliefs_are_told_by_the_features_that_are_not_certain() -> None:
    features = [fp.Feature("place", ["a", "b"]), fp.boolean("lamp")]
    describe = by_feature(features, np.array([[0, 0], [0, 1], [1, 0]]))
    assert describe(np.array([0.25, 0.75, 0.0])) == ["lamp: true 75 %, false 25 %"]
    assert describe(np.array([0.5, 0.25, 0.25])) == ["place: a 75 %, b 25 %", "lamp: false 75 %, true 25 %"]
    assert describe(np.array([0.0, 0.0, 1.0])) == ["certain: place=b, lamp=false"]
    assert by_block(["x", "y"])(np.array([0.1, 0.9])) == ["90 % y", "10 % x"]


def test_channels_that_report_nothing_are_left_out_of_labels() -> None:
    assert brief("Speech=yes, Laser=none") == "Speech=yes"
    assert brief("Speech=none, Laser=none") == "none"


# -- charts ----------------------------------------------------------------------------------------------


def test_bounds_over_time_end_where_the_solver_ended() -> None:
    solution = fp.solve_pomdp(flat_model(fp.compile_model(fp.load_domain("cheese").model)).pomdp, "sarsop")
    shown = solution._repr_html_()
    assert "Bounds over time" in shown
    assert "time (seconds)" in shown
    low, high = bounds_limits(solution)
    last = solution.history[-1]
    assert low <= last.lower <= last.upper <= high


def test_a_first_bound_far_away_does_not_flatten_the_rest() -> None:
    from dataclasses import replace

    solution = fp.solve_pomdp(flat_model(fp.compile_model(fp.load_domain("tiger").model)).pomdp, "sarsop")
    history = (Bounds(0.0, -1e6, 30.0), Bounds(1.0, 19.0, 20.0))
    low, high = bounds_limits(replace(solution, history=history))
    # 3 * (30 - 20) on either side of the last bounds, at most to the first ones
    assert (low, high) == (19.0 - 30.0, 30.0)


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0, 1, [0, 0.2, 0.4, 0.6, 0.8, 1.0]),
        (-3, 14, [0, 5, 10]),
        (5, 5, [5]),
        (0, 250, [0, 50, 100, 150, 200, 250]),
    ],
)
def test_ticks_are_round(low: float, high: float, expected: list[float]) -> None:
    assert nice_ticks(low, high) == pytest.approx(expected)


def test_charts_hold_every_point_inside_their_frame() -> None:
    import re

    chart = line_chart([Series("a", [0, 1, 2], [5, -5, 1], "#000000")], "x", "y", "d", limits=(0.0, 4.0))
    (points,) = re.findall(r'points="([^"]*)"', chart)
    numbers = [tuple(map(float, p.split(","))) for p in points.split()]
    assert len(numbers) == 3
    assert all(0 <= x <= 520 and 14 <= y <= 180 for x, y in numbers)
    bars = histogram(np.array([1.0, 1.0, 2.0, 9.0]), "return", "episodes", "d", mean=3.25)
    assert "mean 3.25" in bars
    assert histogram(np.array([]), "", "", "") == ""
    assert line_chart([], "", "", "") == ""


def test_a_function_of_listed_states_becomes_its_diagram() -> None:
    """Random functions of random lists of states, read back one by one."""
    from itertools import product

    from factored_polca.diagrams import at
    from factored_polca.display.flat_policy_view import listed_function

    symbolic = fp.compile_model(fp.load_domain("taxi").model)
    sizes = [len(feature.values) for feature in symbolic.model.features]
    draw = np.random.default_rng(3)
    everything = np.array(list(product(*map(range, sizes))), dtype=np.int32)
    mine = draw.permutation(len(everything))[:200]
    values = draw.integers(0, 3, len(mine))
    diagram = listed_function(symbolic, everything[mine], values, 7)
    told = {tuple(everything[k].tolist()): int(v) for k, v in zip(mine, values, strict=True)}
    for state in everything.tolist():
        levels = {symbolic.now(k): v for k, v in enumerate(state)}
        assert at(diagram, levels) == told.get(tuple(state), 7)

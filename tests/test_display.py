"""What objects show of themselves: inline attributes only, names escaped, large ones cut with a summary."""

from __future__ import annotations

import importlib
import json
import re
import subprocess
import sys
from html.parser import HTMLParser
from typing import Any

import pytest

import factored_polca as fp
from factored_polca import display
from factored_polca.diagrams import FLOAT, Manager, at
from factored_polca.display.diagram_view import SHOWN_NODES
from factored_polca.drawn import Drawn, DrawnGraph
from factored_polca.models import Model

LARGEST = 200_000
"""Characters of what an object shows."""


class Reader(HTMLParser):
    """Elements, attributes and text of what is shown."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.text = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


TAGS = {
    "div", "b", "i", "table", "thead", "tbody", "tr", "th", "td",
    "svg", "g", "rect", "text", "path", "polygon", "polyline", "line", "circle", "title",
}  # fmt: skip


def shown(thing: Any) -> Reader:
    """What an object shows, found sound."""
    text = thing._repr_html_()
    assert len(text) < LARGEST
    read = Reader(text)
    assert read.open == []
    assert {tag for tag, _ in read.tags} <= TAGS
    for _, attributes in read.tags:
        assert not any(
            name.startswith("on") or name in ("href", "src", "id", "class") for name in attributes
        )
        assert "url(" not in (attributes.get("style") or "")
    return read


@pytest.fixture(scope="module")
def taxi() -> fp.HierarchicalPlan:
    domain = fp.load_domain("taxi")
    found = fp.plan(domain.model, domain.tasks)
    assert isinstance(found, fp.HierarchicalPlan)
    return found


def test_the_table_of_what_is_drawn_is_true() -> None:
    for name, module in display.DRAWN_BY.items():
        home, _, kind = name.rpartition(".")
        drawn = getattr(importlib.import_module(f"factored_polca.{home}"), kind)
        drawer = importlib.import_module(f"factored_polca.display.{module}")
        assert issubclass(drawn, Drawn), name
        assert callable(drawer.html)
        assert issubclass(drawn, DrawnGraph) <= hasattr(drawer, "graph"), name


def test_drawing_loads_neither_matplotlib_nor_pandas_nor_ipython() -> None:
    code = (
        "import sys, json, factored_polca as fp; d = fp.load_domain('taxi'); "
        "d.model._repr_html_(); d.tasks._repr_html_(); d.model.to_svg(); "
        "print(json.dumps(sorted(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = {name.partition(".")[0] for name in json.loads(done.stdout)}
    assert not loaded & {"matplotlib", "pandas", "IPython", "numba"}
    for module in ("factored_polca", "factored_polca.display"):
        code = f"import sys, json, {module}; print(json.dumps(sorted(sys.modules)))"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        loaded = {name.partition(".")[0] for name in json.loads(done.stdout)}
        assert module.partition(".")[0] in loaded
        assert not loaded & {"matplotlib", "pandas", "IPython", "numpy", "sympy", "networkx"}


def test_what_is_not_drawn_is_named() -> None:
    with pytest.raises(TypeError, match=r"int is not drawn; what is: .*Model"):
        display.html(3)


# -- models and hierarchies ----------------------------------------------------------------------------


def test_a_model_shows_its_parts_and_the_arcs_of_its_network() -> None:
    model = fp.load_domain("taxi").model
    read = shown(model)
    for name in ("taxi", "600 states", "passenger", "North", "0 … 4"):
        assert name in read.text
    graph = display.graph(model)
    arcs = {(edge.source, edge.target): edge.stroke for edge in graph.edges}
    # Where a passenger waits and is brought does not change where a wall lets the taxi go.
    assert arcs["now y", "next y"] == "solid"
    assert ("now passenger", "next x") not in arcs
    assert arcs["now x", "next passenger"] == "solid"
    assert arcs["now destination", "next destination"] == "dashed"
    assert ("now destination", "reward") in arcs


def test_a_network_of_one_action_has_its_arcs_only() -> None:
    from factored_polca.display.model_view import graph

    arcs = {(e.source, e.target): e.stroke for e in graph(fp.load_domain("taxi").model, ["Pickup"]).edges}
    assert arcs["now x", "next x"] == "dashed"
    assert ("now x", "next passenger") in arcs
    with pytest.raises(KeyError, match="no action 'Fly'"):
        graph(fp.load_domain("taxi").model, ["Fly"])


def test_a_partially_observed_model_shows_what_its_channels_depend_on() -> None:
    model = fp.load_domain("tiger").model
    arcs = {(edge.source, edge.target) for edge in display.graph(model).edges}
    assert ("next tiger", f"sees {model.observations[0].name}") in arcs
    assert model.observations[0].name in shown(model).text


def test_a_large_model_is_cut_and_says_so() -> None:
    flags = [fp.boolean(f"f{k}") for k in range(1000)]
    model = Model("large", flags, [fp.Action(f"a{k}", {flags[k]: True}) for k in range(300)])
    read = shown(model)
    assert "of 1,000 features" in read.text
    assert "… 284 more actions" in read.text
    assert f"about {str(2**1000)[0]}.{str(2**1000)[1:4]} × 10^301 states" in read.text


def test_the_features_names_are_text_everywhere() -> None:
    name = "<img src=x onerror=alert(1)>"
    feature = fp.Feature(name, ["<b>", "&amp;"])
    model = Model(
        "<script>alert(2)</script>", [feature],
        [fp.Action("<i>go</i>", {feature: fp.lottery({"&amp;": 1})}, rewards=1)],
        terminal=feature.is_("&amp;"),
    )  # fmt: skip
    tasks = fp.TaskHierarchy([fp.Task("<u>all</u>", ["<i>go</i>"], terminal=feature.is_("<b>"))])
    found = fp.plan(model)
    partition = found.root.reduction.partition  # type: ignore[union-attr]
    things = [model, tasks, found, partition, found.root, found.root.reduction, found.root.policy]
    for thing in things:
        shown(thing)
    assert name[:20] in shown(model).text
    assert "<b>" in shown(partition).text


def test_a_hierarchy_shows_tasks_with_their_actions() -> None:
    tasks = fp.load_domain("taxi").tasks
    assert tasks is not None
    graph = display.graph(tasks)
    boxes = {node.key: node.lines for node in graph.nodes}
    assert len(boxes) == 7
    assert "Pickup" in boxes["Get"]
    children = {edge.target for edge in graph.edges if edge.source == "Get"}
    assert children == {f"Navigate_{place}" for place in "RGYB"}
    assert boxes.keys() == {edge.target for edge in graph.edges} | {"Root"}
    shown(tasks)


def test_many_tasks_are_cut() -> None:
    names = [f"T{k}" for k in range(200)]
    tasks = fp.TaskHierarchy([fp.Task("Top", names), *(fp.Task(name, ["a"]) for name in names)])
    assert "60 of 201 tasks" in shown(tasks).text


def test_a_plan_shows_blocks_solver_and_value_of_each_task(taxi: fp.HierarchicalPlan) -> None:
    read = shown(taxi)
    assert "3.85738595" in read.text
    boxes = {node.key: node.lines for node in display.graph(taxi).nodes}
    for solved in taxi.solved:
        lines = " ".join(boxes[solved.task.name])
        assert f"{solved.reduction.partition.blocks} blocks" in lines
        assert solved.solution.method in lines
    # READMEs table, from a published domain: Root 55 blocks, value 3.857
    assert "55 blocks" in " ".join(boxes["Root"])
    assert "value 3.857" in " ".join(boxes["Root"])


def test_an_executable_plan_shows_what_was_reported_when_it_was_made(taxi: fp.HierarchicalPlan) -> None:
    with_report = fp.executable(taxi, fp.plan_report(taxi))
    assert "policy iteration" in shown(with_report).text
    assert "55 blocks" in " ".join(node.lines[-2] for node in display.graph(fp.executable(taxi)).nodes)


# -- diagrams ------------------------------------------------------------------------------------------


def test_a_diagram_names_features_where_it_comes_from_a_model(taxi: fp.HierarchicalPlan) -> None:
    graph = display.graph(taxi.root.defined)
    assert {node.lines for node in graph.nodes} == {("passenger",), ("0",), ("1",)}
    labels = {(edge.target, edge.label) for edge in graph.edges}
    assert {label for _, label in labels} == {"delivered", "not delivered"}
    assert graph.note == ""


def test_a_diagram_of_a_bare_manager_has_levels_and_values() -> None:
    manager = Manager([2, 3])
    diagram = manager.variable(0, [manager.constant(0.5, FLOAT), manager.constant(-2, FLOAT)])
    read = shown(diagram)
    assert "3 nodes, of which 2 leaves" in read.text
    assert {"level 0", "0.5", "−2"} <= {
        line for node in display.graph(diagram).nodes for line in node.lines
    }


def test_a_large_diagram_is_cut_to_its_top(taxi: fp.HierarchicalPlan) -> None:
    partition = taxi.root.reduction.partition.diagram
    read = shown(partition)
    graph = display.graph(partition)
    assert len(graph.nodes) == SHOWN_NODES + 1
    assert f"the {SHOWN_NODES} nodes nearest to the top" in read.text
    assert "more nodes" in read.text


# -- policies and quotients ---------------------------------------------------------------------------


def test_the_policy_of_taxi_s_root_is_three_branches(taxi: fp.HierarchicalPlan) -> None:
    graph = display.graph(taxi.root)
    texts = {node.key: node.lines[0] for node in graph.nodes}
    branches = {edge.label: texts[edge.target] for edge in graph.edges}
    assert branches == {"R, G, Y, B": "Get", "taxi": "Put", "delivered": "none"}
    shown(taxi.root)


def walk_tree(graph: Any, model: Model, state: dict[str, Any]) -> str:
    """The answer of a decision tree at a state, by its labels."""
    node = next(n for n in graph.nodes if n.key == "0")
    while node.kind == "test":
        feature = next(f for f in model.features if f.name == node.lines[0])
        arcs = [e for e in graph.edges if e.source == node.key]
        fitting = [e for e in arcs if fits(e.label, feature, state[feature.name])]
        assert len(fitting) == 1, (node, state)
        node = next(n for n in graph.nodes if n.key == fitting[0].target)
    return str(node.lines[0])


def fits(label: str, feature: fp.Feature, value: Any) -> bool:
    if label.startswith("not "):
        return not fits(label[4:], feature, value)
    if match := re.fullmatch(r"(\d+) … (\d+)", label):
        return int(match[1]) <= value <= int(match[2])
    return str(value) in label.split(", ")


def test_a_tree_answers_what_the_policy_does_in_every_state(taxi: fp.HierarchicalPlan) -> None:
    from itertools import product

    controller, model = fp.Controller(fp.executable(taxi)), taxi.model
    for name in ("Get", "Navigate_R"):
        graph = display.graph(taxi.task(name))
        assert not any(node.kind == "more" for node in graph.nodes)
        policy = fp.executable(taxi).policies[name]
        for values in product(*(f.values for f in model.features)):
            state = dict(zip((f.name for f in model.features), values, strict=True))
            levels = controller._levels(state)
            block = int(at(policy.partition.diagram, levels))
            chosen = int(policy.choice[block])
            expected = policy.actions[chosen] if chosen >= 0 else "none"
            assert walk_tree(graph, model, state) == expected


def test_a_large_tree_says_what_share_of_states_each_choice_has() -> None:
    found = fp.plan(fp.load_domain("taxi").model)
    graph = display.graph(found.root)
    assert len(graph.nodes) <= 60
    dashed = [node for node in graph.nodes if node.kind == "more"]
    assert dashed
    assert all("%" in node.lines[0] for node in dashed)
    assert "not unfolded" in shown(found.root).text


def test_a_small_quotient_is_a_graph_with_probabilities() -> None:
    toy = fp.load_domain("toy").model
    found = fp.reduce(fp.flat_process(fp.compile_model(toy)))
    read = shown(found)
    graph = display.graph(found)
    formulas = {node.lines[1]: node.key for node in graph.nodes}
    assert set(formulas) == {f"door == {value}" for value in ("red", "blue", "open", "passed")}
    arcs = {(edge.source, edge.target): edge.label for edge in graph.edges}
    assert arcs[formulas["door == red"], formulas["door == open"]] == "red_key"
    assert "exact but for a chance below" in read.text


def test_a_large_quotient_is_a_table() -> None:
    found = fp.reduce(fp.flat_process(fp.compile_model(fp.load_domain("taxi").model)))
    read = shown(found)
    assert "501 blocks for 600 states" in read.text
    assert "too many for a picture" in read.text
    assert "… 471 more blocks of" in read.text


def test_the_texts_for_graphviz_and_mermaid_come_from_the_objects(taxi: fp.HierarchicalPlan) -> None:
    assert taxi.to_dot().startswith("digraph {")
    assert taxi.to_mermaid().startswith("flowchart")
    assert taxi.model.to_svg().startswith("<svg xmlns=")
    assert 'label="Root\\n55 blocks' in taxi.to_dot()


def test_interchangeable_actions_are_said_to_be_so() -> None:
    model = fp.load_domain("sysadmin", {"size": 4}).model
    found = fp.plan(model, None, fp.Options(interchangeable=True))
    assert isinstance(found, fp.HierarchicalPlan)
    assert "actions count by what they do" in shown(found.root.reduction).text
    choices = {node.lines[0] for node in display.graph(found.root).nodes if node.kind == "action"}
    assert choices <= {action.name for action in model.actions}
    assert any(choice.startswith("reboot") for choice in choices)

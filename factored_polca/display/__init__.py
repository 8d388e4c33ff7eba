"""Objects that draw themselves: HTML and SVG for notebooks, DOT and Mermaid as text, plots.

`html`, `svg`, `dot` and `mermaid` draw what `DRAWN_BY` lists, each by the module that it names there, which
is loaded when something of its kind is drawn.  Nothing here is loaded with the package, and neither
matplotlib nor pandas nor IPython by drawing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from factored_polca.display.graphs import Graph

DRAWN_BY: Final = {
    "models.model.Model": "model_view",
    "models.tasks.TaskHierarchy": "hierarchy_view",
    "diagrams.diagram.Diagram": "diagram_view",
    "minimisation.partition.Partition": "partition_view",
    "minimisation.refine.Minimisation": "reduction_view",
    "minimisation.reduction.Reduction": "reduction_view",
    "minimisation.quotient.Quotient": "quotient_view",
    "minimisation.pomdp_quotient.PomdpQuotient": "quotient_view",
    "hierarchy.solved.SolvedTask": "task_view",
    "hierarchy.solved.StructuredTask": "task_view",
    "hierarchy.executable.TaskPolicy": "task_view",
    "hierarchy.pomdp_solved.SolvedPomdpTask": "belief_task_view",
    "hierarchy.symbolic_task.SymbolicPomdpTask": "symbolic_task_view",
    "hierarchy.policy_file.FlatPolicy": "flat_policy_view",
    "solvers.result.MDPSolution": "solution_view",
    "simulation.simulate.Simulation": "runs_view",
    "simulation.belief_runs.BeliefRuns": "runs_view",
    "simulation.comparison.Comparison": "comparison_view",
    "simulation.trace.Trace": "trace_view",
    "solvers.pomdp_result.POMDPSolution": "solution_view",
    "hierarchy.plan.HierarchicalPlan": "plan_view",
    "hierarchy.pomdp_plan.PomdpPlan": "plan_view",
    "hierarchy.executable.ExecutablePlan": "plan_view",
    "hierarchy.pomdp_executable.ExecutablePomdpPlan": "plan_view",
}
"""Class -> the module here that draws it: `html(thing)`, and `graph(thing)` for what is a graph."""


def _drawer(thing: object) -> Any:
    for kind in type(thing).__mro__:
        name = f"{kind.__module__}.{kind.__qualname__}".removeprefix("factored_polca.")
        if name in DRAWN_BY:
            return import_module(f"factored_polca.display.{DRAWN_BY[name]}")
    drawn = ", ".join(sorted(name.rpartition(".")[2] for name in DRAWN_BY))
    raise TypeError(f"{type(thing).__name__} is not drawn; what is: {drawn}")


def html(thing: object) -> str:
    """An object as HTML with inline attributes only.

    Raises:
        TypeError: nothing that is drawn; the message lists what is.
    """
    return str(_drawer(thing).html(thing))


def graph(thing: object) -> Graph:
    """The graph of an object.

    Raises:
        TypeError: nothing that is drawn as a graph.
    """
    drawer = _drawer(thing)
    if not hasattr(drawer, "graph"):
        raise TypeError(f"{type(thing).__name__} is not drawn as a graph")
    found: Graph = drawer.graph(thing)
    return found


def svg(thing: object) -> str:
    """The graph of an object as the text of an SVG file.

    Raises:
        TypeError: nothing that is drawn as a graph.
    """
    from factored_polca.display.pictures import graph_svg

    return graph_svg(graph(thing), alone=True)


def dot(thing: object) -> str:
    """The graph of an object in the language of Graphviz.

    Raises:
        TypeError: nothing that is drawn as a graph.
    """
    from factored_polca.display.dot_text import graph_dot

    return graph_dot(graph(thing))


def mermaid(thing: object) -> str:
    """The graph of an object as a Mermaid flowchart.

    Raises:
        TypeError: nothing that is drawn as a graph.
    """
    from factored_polca.display.mermaid_text import graph_mermaid

    return graph_mermaid(graph(thing))

"""Plan factored Markov decision processes with task hierarchies, by exact symbolic abstraction.

This package offers the names below without loading anything until one of them is used (PEP 562), so
that `import factored_polca` takes milliseconds.  Each name lives in the layer that `_HOME` says; the
layers and the directions in which they import one another are drawn in README.md.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from factored_polca.control import (
        Belief,
        Controller,
        Decision,
        Poll,
        choose_tracker,
        independent_belief,
    )
    from factored_polca.control.belief_controller import BeliefController, BeliefDecision, plan_tracker
    from factored_polca.control.certify import certify_plan
    from factored_polca.diagrams import Aborted, Diagram, Manager, MemoryLimit
    from factored_polca.explicit.pomdp_arrays import ArrayPOMDP, array_pomdp
    from factored_polca.formats import Document, read, write
    from factored_polca.hierarchy import (
        HierarchicalPlan,
        Options,
        PomdpPlan,
        SolvedPomdpTask,
        SolvedTask,
        plan,
        plan_mdp,
        plan_pomdp,
    )
    from factored_polca.hierarchy.executable import ExecutablePlan, executable
    from factored_polca.hierarchy.irrelevance import ValueClasses, executable_by_classes, value_classes
    from factored_polca.hierarchy.merging import CertifiedBounds
    from factored_polca.hierarchy.plan_file import load_plan, save_plan
    from factored_polca.hierarchy.pomdp_executable import ExecutablePomdpPlan, executable_pomdp
    from factored_polca.hierarchy.pomdp_plan_file import load_pomdp_plan, save_pomdp_plan
    from factored_polca.hierarchy.report import plan_report
    from factored_polca.library import domains
    from factored_polca.library import load as load_domain
    from factored_polca.minimisation import (
        Certificate,
        Minimisation,
        Partition,
        Reduction,
        certify,
        flat_process,
        minimise,
        reduce,
        unreduced_pomdp,
    )
    from factored_polca.models import (
        Action,
        Fault,
        Feature,
        InitialBelief,
        LimitReached,
        Model,
        ModelError,
        Observation,
        Task,
        TaskHierarchy,
        boolean,
        check,
        check_tasks,
        conditional,
        lottery,
        uniform,
    )
    from factored_polca.parametric import (
        ParametricProcess,
        ParametricQuotient,
        compile_parametric,
        parametric_flat_process,
        parametric_process,
        reduce_parametric,
    )
    from factored_polca.parametric.sensitivity import Sensitivity, sensitivity
    from factored_polca.simulation import Simulation, simulate
    from factored_polca.simulation.belief_runs import BeliefRuns
    from factored_polca.simulation.comparison import Comparison, compare
    from factored_polca.simulation.measure import Measurement, measure
    from factored_polca.simulation.trace import Trace, trace
    from factored_polca.solvers import MDPSolution, solve_mdp
    from factored_polca.solvers.pomdp_choose import solve_pomdp
    from factored_polca.solvers.pomdp_result import Demand, POMDPSolution
    from factored_polca.solvers.proposal import alpha_vectors, solution_of_actions, solution_of_policy
    from factored_polca.solvers.protocol import MdpSolver, PomdpSolver
    from factored_polca.symbolic import SymbolicModel, compile_model, reachable_states

__version__ = "0.1.0"

_HOME: Final = {
    "control": ("Belief", "Controller", "Decision", "Poll", "choose_tracker", "independent_belief"),
    "control.belief_controller": ("BeliefController", "BeliefDecision", "plan_tracker"),
    "control.certify": ("certify_plan",),
    "diagrams": ("Aborted", "Diagram", "Manager", "MemoryLimit"),
    "explicit.pomdp_arrays": ("ArrayPOMDP", "array_pomdp"),
    "formats": ("Document", "read", "write"),
    "hierarchy": (
        "HierarchicalPlan", "Options", "PomdpPlan", "SolvedPomdpTask", "SolvedTask", "plan", "plan_mdp",
        "plan_pomdp",
    ),
    "hierarchy.executable": ("ExecutablePlan", "executable"),
    "hierarchy.irrelevance": ("ValueClasses", "executable_by_classes", "value_classes"),
    "hierarchy.merging": ("CertifiedBounds",),
    "hierarchy.plan_file": ("load_plan", "save_plan"),
    "hierarchy.pomdp_executable": ("ExecutablePomdpPlan", "executable_pomdp"),
    "hierarchy.pomdp_plan_file": ("load_pomdp_plan", "save_pomdp_plan"),
    "hierarchy.report": ("plan_report",),
    "library": ("domains", "load_domain"),
    "minimisation": (
        "Certificate", "Minimisation", "Partition", "Reduction", "certify", "flat_process", "minimise",
        "reduce", "unreduced_pomdp",
    ),
    "models": (
        "Action", "Fault", "Feature", "InitialBelief", "LimitReached", "Model", "ModelError", "Observation",
        "Task", "TaskHierarchy", "boolean", "check", "check_tasks", "conditional", "lottery", "uniform",
    ),
    "parametric": (
        "ParametricProcess", "ParametricQuotient", "compile_parametric", "parametric_flat_process",
        "parametric_process", "reduce_parametric",
    ),
    "parametric.sensitivity": ("Sensitivity", "sensitivity"),
    "simulation": ("Simulation", "simulate"),
    "simulation.belief_runs": ("BeliefRuns",),
    "simulation.comparison": ("Comparison", "compare"),
    "simulation.measure": ("Measurement", "measure"),
    "simulation.trace": ("Trace", "trace"),
    "solvers": ("MDPSolution", "solve_mdp"),
    "solvers.pomdp_choose": ("solve_pomdp",),
    "solvers.pomdp_result": ("Demand", "POMDPSolution"),
    "solvers.proposal": ("alpha_vectors", "solution_of_actions", "solution_of_policy"),
    "solvers.protocol": ("MdpSolver", "PomdpSolver"),
    "symbolic": ("SymbolicModel", "compile_model", "reachable_states"),
}  # fmt: skip
"""Module -> the public names it holds."""

_OWN_NAME: Final = {"load_domain": "load"}
"""Names that are called otherwise where they live."""

_MODULE: Final = {name: module for module, names in _HOME.items() for name in names}

__all__ = [
    "Aborted", "Action", "ArrayPOMDP", "Belief", "BeliefController", "BeliefDecision", "BeliefRuns",
    "Certificate", "CertifiedBounds", "Comparison", "Controller", "Decision", "Demand", "Diagram",
    "Document", "ExecutablePlan", "ExecutablePomdpPlan", "Fault", "Feature", "HierarchicalPlan",
    "InitialBelief", "LimitReached", "MDPSolution", "Manager", "MdpSolver", "Measurement",
    "MemoryLimit", "Minimisation", "Model", "ModelError", "Observation", "Options", "POMDPSolution",
    "ParametricProcess", "ParametricQuotient", "Partition", "Poll", "PomdpPlan", "PomdpSolver",
    "Reduction", "Sensitivity", "Simulation", "SolvedPomdpTask", "SolvedTask", "SymbolicModel", "Task",
    "TaskHierarchy", "Trace", "ValueClasses", "__version__", "alpha_vectors", "array_pomdp", "boolean",
    "certify", "certify_plan", "check", "check_tasks", "choose_tracker", "compare", "compile_model",
    "compile_parametric", "conditional", "domains", "executable", "executable_by_classes",
    "executable_pomdp", "flat_process", "independent_belief", "load_domain", "load_plan",
    "load_pomdp_plan", "lottery", "measure", "minimise", "parametric_flat_process",
    "parametric_process", "plan", "plan_mdp", "plan_pomdp", "plan_report", "plan_tracker",
    "reachable_states", "read", "reduce", "reduce_parametric", "save_plan", "save_pomdp_plan",
    "sensitivity", "simulate", "solution_of_actions", "solution_of_policy", "solve_mdp", "solve_pomdp",
    "trace", "uniform", "unreduced_pomdp", "value_classes", "write",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Load a public name on first use.

    Raises:
        AttributeError: no public name.
    """
    if name not in _MODULE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = import_module(f"{__name__}.{_MODULE[name]}")
    value = getattr(module, _OWN_NAME.get(name, name))
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

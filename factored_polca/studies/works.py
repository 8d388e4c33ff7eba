"""What a run does: minimise, plan or solve a model, or call somebody's function.

Each work takes a request (plain data, see `factored_polca.studies.grid.Run.request`) and answers figures,
plain data too.  While it works it tells its stage and the figures so far, so that a run that is stopped has
left what it knew.

    minimise   flat model -> blocks
    plan       hierarchy: PolCA, or PolCA+ where the state is not seen -> value or bounds
    solve      the model state by state, without a hierarchy -> bounds
    package.module:function    called with the parameters and the seed -> its figures

Figures that more than one work has are called the same: `states` (the full product of features),
`reachable_states`, `blocks` (of a plan: of all its tasks), `value`, `lower`, `upper`, `gap`, `iterations`,
`parse_seconds`, `seconds` (of the work itself, kernels compiled meanwhile not counted).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from importlib import import_module
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, Final, Protocol

from factored_polca.models import Model, ModelError, TaskHierarchy

if TYPE_CHECKING:
    from factored_polca.explicit.arrays import FloatArray
    from factored_polca.minimisation.flat_model import FlatModel
    from factored_polca.solvers.pomdp_result import Demand

MDP_METHODS: Final = {
    "vi": "value iteration",
    "pi": "policy iteration",
    "mpi": "modified policy iteration",
}
LONGEST_NUMBER: Final = 4000
"""Digits up to which a number of states is kept exactly."""


class Tell(Protocol):
    """Told the stage that a work has reached, and figures."""

    def __call__(self, stage: str, /, **figures: Any) -> None: ...


@dataclass(frozen=True)
class Subject:
    """The model that a run works on."""

    model: Model
    tasks: TaskHierarchy | None


def total_blocks(blocks: Sequence[int | None]) -> int | None:
    """The blocks of all tasks; None where one was solved without blocks."""
    known = [count for count in blocks if count is not None]
    return sum(known) if len(known) == len(blocks) else None


def perform(request: Mapping[str, Any], tell: Tell) -> dict[str, Any]:
    """Do what a request says; answer its figures.

    Raises:
        ModelError: the model, a parameter or an option is not right.
        LimitReached: a cap of ours, such as the number of states that may be listed.
    """
    if ":" in request["work"]:
        return custom(request, tell)
    works = {"minimise": minimise, "plan": plan, "solve": solve}
    began = time.perf_counter()
    tell("reading the model")
    subject = load_subject(request)
    figures = states_of(subject.model) | {"parse_seconds": time.perf_counter() - began}
    tell("reading the model", **figures)
    return figures | works[request["work"]](subject, request, tell)


def load_subject(request: Mapping[str, Any]) -> Subject:
    """The model of a request: a shipped domain, or the text of a file.

    Raises:
        ModelError: no such domain, or the text or a parameter is not right.
    """
    name, settings = request["model"], request["set"]
    if request["text"] is None:
        from factored_polca import library

        domain = library.load(name, settings)
        return Subject(domain.model, domain.tasks)
    from factored_polca.formats import format_of

    try:
        document = format_of(name).read(request["text"], settings, PurePath(name).stem)
    except ModelError as error:
        raise error.in_file(name) from None
    return Subject(document.model, document.tasks)


def states_of(model: Model) -> dict[str, Any]:
    """The number of states: its digits, and its logarithm, as there may be more than a float can hold."""
    magnitude = sum(math.log10(len(feature.values)) for feature in model.features)
    exact = str(model.states) if magnitude < LONGEST_NUMBER else None
    return {"states": exact, "log10_states": magnitude}


# -- minimise --------------------------------------------------------------------------------------


def minimise(subject: Subject, request: Mapping[str, Any], tell: Tell) -> dict[str, Any]:
    """The blocks of the flat model."""
    from factored_polca.minimisation import flat_process
    from factored_polca.minimisation import minimise as minimise_process
    from factored_polca.symbolic import compile_model
    from factored_polca.symbolic.reach import reachable_states

    options, figures = request["options"], dict[str, Any]()
    began = time.perf_counter()
    tell("compiling diagrams")
    symbolic = compile_model(subject.model, order=options.get("order", "auto"))
    reachable = None
    if options.get("reachable"):
        tell("reachable states")
        found = reachable_states(symbolic, None)
        reachable, figures["reachable_states"] = found.diagram, str(found.states)
    process = flat_process(symbolic, None, reachable)
    tell("minimising", **figures)
    result = minimise_process(
        process,
        seed=request["seed"],
        interchangeable=options.get("interchangeable", False),
        progress=lambda number, blocks: tell("minimising", rounds=number, blocks=blocks),
    )
    peak_nodes, _ = symbolic.manager.peaks()
    return figures | {
        "blocks": result.partition.blocks,
        "rounds": result.rounds,
        "nodes": result.partition.nodes,
        "peak_nodes": peak_nodes,
        "collision_bound": result.collision_bound,
        "seconds": time.perf_counter() - began,
    }


# -- plan ------------------------------------------------------------------------------------------


def plan(subject: Subject, request: Mapping[str, Any], tell: Tell) -> dict[str, Any]:
    """The hierarchy planned: each task's blocks together, the value of the policy or its bounds."""
    from factored_polca.hierarchy import Options, PomdpPlan
    from factored_polca.hierarchy import plan as plan_model
    from factored_polca.hierarchy.options import FLAT_BLOCK_LIMIT, TRIALS
    from factored_polca.hierarchy.solved import StructuredTask
    from factored_polca.hierarchy.symbolic_task import SymbolicPomdpTask

    given = request["options"]
    options = Options(
        seed=request["seed"],
        order=given.get("order", "auto"),
        reachable=given.get("reachable", False),
        flat_block_limit=FLAT_BLOCK_LIMIT if given.get("flat", True) else None,
        solver=given.get("solver", "auto"),
        gap=given.get("gap"),
        trials=given.get("trials", TRIALS),
        assume_observed=given.get("polca", False),
    )

    def progress(task: str, stage: str, number: int, blocks: int) -> None:
        tell(f"{task}: {stage}", **({"task_blocks": blocks} if blocks else {}))

    began = time.perf_counter()
    tell("compiling diagrams")
    found = plan_model(subject.model, subject.tasks, options, progress=progress)
    blocks = [
        None
        if isinstance(solved, (StructuredTask, SymbolicPomdpTask))
        else solved.reduction.partition.blocks
        for solved in found.solved
    ]
    figures: dict[str, Any] = {
        "blocks": total_blocks(blocks),
        "root_blocks": blocks[-1],
        "tasks": len(found.solved),
    }
    if isinstance(found, PomdpPlan):
        from factored_polca.hierarchy.pomdp_report import guarantee as pomdp_guarantee

        figures |= {
            "lower": found.root.lower, "upper": found.root.upper,
            "gap": found.root.upper - found.root.lower,
            "flat_upper": found.flat.upper, "flat_blocks": found.flat.blocks,
            "guarantee": pomdp_guarantee(found),
        }  # fmt: skip
        seconds = time.perf_counter() - began
        if given.get("episodes"):
            tell("measuring", **figures)
            figures |= measured(found, given["episodes"], request["seed"])
    else:
        from factored_polca.hierarchy.report import guarantee

        polled, flat = found.polled, found.flat
        figures |= {
            "value": polled.value, "lower": polled.lower, "upper": polled.upper,
            "gap": polled.upper - polled.lower,
            "flat_value": None if flat is None else flat.value,
            "flat_blocks": None if flat is None else flat.blocks,
            "guarantee": guarantee(found),
        }  # fmt: skip
        seconds = time.perf_counter() - began
    return figures | {"seconds": seconds}


def measured(found: Any, episodes: int, seed: int) -> dict[str, Any]:
    """What polling a PolCA+ plan earns on the original model: mean and standard error."""
    from factored_polca.hierarchy.pomdp_executable import executable_pomdp
    from factored_polca.simulation.measure import measure

    began = time.perf_counter()
    name = found.root.task.name
    # Tasks below the root are measured too where beliefs are over blocks: as little as can be of them.
    runs = measure(executable_pomdp(found), episodes=episodes, child_episodes=2, seed=seed).runs[name]
    return {
        "value": runs.mean,
        "standard_error": runs.standard_error,
        "episodes": runs.episodes,
        "measuring_seconds": time.perf_counter() - began,
    }


# -- solve -----------------------------------------------------------------------------------------


def solve(subject: Subject, request: Mapping[str, Any], tell: Tell) -> dict[str, Any]:
    """The model solved as it is: bounds on the optimal value from the start."""
    from factored_polca.minimisation.flat_model import flat_model
    from factored_polca.models.model import replace_fields
    from factored_polca.solvers.pomdp_result import Demand
    from factored_polca.symbolic import compile_model

    options, model = request["options"], subject.model
    if "discount" in options:
        model = replace_fields(model, discount=Fraction(options["discount"]))
    if "horizon" in options:
        model = replace_fields(
            model, horizon=None if options["horizon"] == "infinite" else options["horizon"]
        )
    solver = options.get("solver", "auto")
    full, horizon = model.observability == "full", model.horizon
    if not full and horizon is None and model.discount == 1:
        raise ModelError("at discount 1 a partially observed model needs a horizon")
    tell("listing states")
    began = time.perf_counter()
    flat = flat_model(compile_model(model))
    listed = {
        "reachable_states": str(flat.pomdp.states),
        "listing_seconds": time.perf_counter() - began,
    }
    tell("solving", **listed)
    seconds = options.get("stop_seconds")
    demand = Demand(
        options.get("gap", 1e-6 if solver in ("exact", "witness") else 1e-3),
        None if seconds is None else time.monotonic() + seconds,
        options.get("iterations"),
        request["seed"],
        lambda lower, upper: tell("solving", lower=lower, upper=upper, gap=upper - lower),
    )
    as_mdp = full and (solver == "auto" or solver in MDP_METHODS or ":" in solver)
    if solver in MDP_METHODS and not full:
        raise ModelError(f"{solver} solves models whose state is seen: use auto, exact, sarsop or hsvi")
    began = time.perf_counter()
    if as_mdp and horizon is not None:
        figures = solve_stages(flat, horizon, demand, tell)
    elif as_mdp:
        figures = solve_seen(flat, solver, options.get("gap"), demand, tell)
    else:
        figures = solve_unseen(flat, solver, horizon, demand)
    figures["gap"] = figures["upper"] - figures["lower"]
    return listed | figures | {"seconds": time.perf_counter() - began}


def solve_unseen(flat: FlatModel, solver: str, horizon: int | None, demand: Demand) -> dict[str, Any]:
    """The bounds of a POMDP solver."""
    from factored_polca.solvers.pomdp_choose import solve_pomdp
    from factored_polca.solvers.protocol import call_pomdp_solver, load_solver

    if flat.partial_action is not None:
        raise ModelError(
            f"{solver} takes actions that apply everywhere, and {flat.partial_action!r} does not: use "
            "auto, vi, pi or mpi"
        )
    if ":" in solver:
        found = call_pomdp_solver(load_solver(solver), flat.pomdp, demand)
    else:
        found = solve_pomdp(flat.pomdp, solver, demand=demand, horizon=horizon)
    return {
        "lower": found.lower, "upper": found.upper, "value": found.value, "iterations": found.iterations,
        "vectors": found.vectors, "method": found.method, "solver_status": found.status,
        "guarantee": found.guarantee.text, "note": found.note,
    }  # fmt: skip


def solve_seen(
    flat: FlatModel, solver: str, gap: float | None, demand: Demand, tell: Tell
) -> dict[str, Any]:
    """The bounds of an MDP solver; its epsilon is relative to the largest value, the gap is not."""
    from factored_polca.solvers.choose import solve_mdp
    from factored_polca.solvers.protocol import call_mdp_solver, load_solver

    initial, mdp = flat.pomdp.initial, flat.to_mdp()
    epsilon = 1e-9 if gap is None else gap
    for _ in range(2):
        if ":" in solver:
            found = call_mdp_solver(load_solver(solver), mdp, demand)
        else:
            found = solve_mdp(
                mdp,
                MDP_METHODS.get(solver, "auto"),
                epsilon,
                deadline=demand.deadline,
                iterations=demand.iterations,
                progress=lambda number, _: tell("solving", iterations=number),
                describe=flat.state_text,
            )
        margin = rounding(initial, found.values)
        lower = from_start(initial, found.lower) - margin
        upper = from_start(initial, found.upper) + margin
        if gap is None or ":" in solver or found.status != "converged" or not upper - lower > gap:
            break
        epsilon = gap / max(1.0, abs(lower), abs(upper), float(abs(found.values).max())) / 2
    return {
        "lower": lower, "upper": upper, "value": from_start(initial, found.values),
        "iterations": found.iterations, "method": found.method, "solver_status": found.status,
        "guarantee": found.guarantee.text,
    }  # fmt: skip


def solve_stages(flat: FlatModel, horizon: int, demand: Demand, tell: Tell) -> dict[str, Any]:
    """The value over a finite horizon where the state is seen."""
    from factored_polca.solvers.backward_induction import backward_induction

    found = backward_induction(
        flat.to_mdp(),
        horizon,
        deadline=demand.deadline,
        progress=lambda done: tell("solving", iterations=done),
    )
    value = from_start(flat.pomdp.initial, found.values)
    error = found.error + rounding(flat.pomdp.initial, found.values)
    return {
        "lower": value - error, "upper": value + error, "value": value, "iterations": horizon,
        "method": "backward induction", "solver_status": "converged",
    }  # fmt: skip


def rounding(initial: FloatArray, values: FloatArray) -> float:
    """What rounding may do to the mean of `values` [s] under `initial` [s]: n + 4 units."""
    largest = max((abs(value) for value in values.tolist() if math.isfinite(value)), default=0.0)
    return float((int((initial > 0).sum()) + 4) * 2.0**-52 * largest)


def from_start(initial: FloatArray, values: FloatArray) -> float:
    """The mean of `values` [s] under `initial` [s]; minus infinity where that is met."""
    support = initial > 0
    return float(initial[support] @ values[support])


# -- somebody's function ---------------------------------------------------------------------------


def custom(request: Mapping[str, Any], tell: Tell) -> dict[str, Any]:
    """What the function `package.module:function` answers, called with the parameters and the seed.

    Raises:
        ModelError: there is none, or it answers something else than figures by name.
    """
    tell("importing")
    function = imported(request["work"])
    tell("running")
    began = time.perf_counter()
    figures = function(**request["set"], seed=request["seed"])
    seconds = time.perf_counter() - began
    if not isinstance(figures, Mapping) or not all(isinstance(name, str) for name in figures):
        raise ModelError(
            f"{request['work']} answered {type(figures).__name__}: a study's function answers a dictionary "
            "of figures by name"
        )
    return {"seconds": seconds} | dict(figures)


def imported(reference: str) -> Callable[..., Any]:
    """The function that `package.module:function` names; this runs the module.

    Raises:
        ModelError: no such module, or nothing callable of that name in it.
    """
    module_name, _, name = reference.partition(":")
    try:
        module = import_module(module_name)
    except ImportError as error:
        raise ModelError(
            f"{reference} can't be imported: {error}; the module must be installed, or its folder named by "
            "PYTHONPATH"
        ) from error
    function: Callable[..., Any] | None = getattr(module, name, None)
    if not callable(function):
        raise ModelError(f"the module {module_name} has no function {name}")
    return function

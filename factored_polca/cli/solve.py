"""The command that solves a model without a hierarchy: `solve`."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from factored_polca.cli.commands import (
    compile_kernels,
    limits,
    refuse_unwritable,
    report_warnings,
)
from factored_polca.cli.output import Output
from factored_polca.cli.solve_report import conclude, described, print_solution, shown
from factored_polca.cli.solve_symbolic import (
    SYMBOLIC,
    may_be_symbolic,
    solve_on_diagrams,
)
from factored_polca.cli.source import Source, UsageError, load
from factored_polca.models import LimitReached, Model
from factored_polca.models.model import replace_fields

if TYPE_CHECKING:
    from factored_polca.explicit.policies import AnyPolicy
    from factored_polca.minimisation.flat_model import FlatModel
    from factored_polca.solvers.pomdp_result import Demand
    from factored_polca.solvers.result import Guarantee, Status
    from factored_polca.symbolic import SymbolicModel

MDP_METHODS: Final = {
    "auto": "auto",
    "vi": "value iteration",
    "pi": "policy iteration",
    "mpi": "modified policy iteration",
    "structured": "structured value iteration",
}
STAGED: Final = ("auto", "exact", "witness")
"""POMDP solvers that take a horizon."""

GAP: Final = 1e-3
EXACT_GAP: Final = 1e-6
MDP_EPSILON: Final = 1e-9
LONGEST_HORIZON: Final = 1_000_000


@dataclass(frozen=True)
class Task:
    """What is asked for, checked."""

    model: Model  # with its discount and horizon as asked for
    solver: str
    gap: float | None  # None: not said, for MDPs
    as_mdp: bool
    deadline: Callable[[], float | None]  # counted from the call, `time.monotonic()`
    iterations: int | None
    seed: int
    custom: Callable[..., Any] | None = None  # a solver that is not ours

    def demand(self, gap: float, progress: Callable[[float, float], None] | None = None) -> Demand:
        """What a solver is asked for, from now on."""
        from factored_polca.solvers.pomdp_result import Demand

        return Demand(gap, self.deadline(), self.iterations, self.seed, progress)


@dataclass(frozen=True)
class Found:
    """A solution of either kind; the bounds are on the optimal value from the start."""

    lower: float
    upper: float
    value: float
    policy: AnyPolicy
    status: Status
    guarantee: Guarantee
    method: str
    vectors: int | None
    iterations: int
    seconds: float
    note: str

    @property
    def gap(self) -> float:
        """upper - lower; 0 where both are the same infinity."""
        return 0.0 if self.lower == self.upper else self.upper - self.lower


def solve(arguments: argparse.Namespace, output: Output) -> int:
    """Solve a model as it is, print bounds and what they mean, write the policy."""
    from factored_polca.cli.solve_large import listed_unless_large, solve_large
    from factored_polca.hierarchy.policy_file import FlatPolicy, save_policy
    from factored_polca.symbolic import compile_model

    if arguments.output is not None:
        refuse_unwritable(arguments.output)
    source = load(arguments.model, arguments.set)
    task = checked_task(source, arguments)
    report_warnings(source, output)
    if task.solver == SYMBOLIC:
        return solve_on_diagrams(task, source, arguments, output)
    compile_seconds = warm(task, output)
    began = time.perf_counter()
    with source.located(), output.progress(f"listing the states of {source.name}"):
        symbolic = compile_model(task.model, memory_limit=limits(arguments)[0])
        flat = listed_unless_large(symbolic, task)
    if isinstance(flat, str):
        if may_be_symbolic(task):
            return solve_on_diagrams(task, source, arguments, output, flat)
        return solve_large(symbolic, task, flat, source, arguments, output, compile_seconds)
    build_seconds = time.perf_counter() - began
    with output.progress(f"solving {source.name}"):
        found, compiled = work(task, flat, source, output)
    compile_seconds += compiled
    data = described(task, found, wanted(task), found.value) | {
        "reachable_states": flat.pomdp.states,
        "observations": count_observations(flat),
        "vectors": found.vectors,
        "seconds": max(0.0, found.seconds - compiled),
        "compile_seconds": compile_seconds,
        "build_seconds": build_seconds,
    }

    def save(kept: dict[str, Any], path: str) -> None:
        save_policy(FlatPolicy(flat, found.policy, kept), path)

    return conclude(data, save, source, arguments, output, print_solution)


def count_observations(flat: FlatModel) -> int | None:
    """How many joint observations occur; None where the state is seen."""
    if flat.fully_observed:
        return None
    return len({label for labels in flat.pomdp.observations for label in labels})


# -- what is asked for ---------------------------------------------------------------------------


def checked_task(source: Source, arguments: argparse.Namespace) -> Task:
    """What the arguments ask for.

    Raises:
        UsageError: options that do not go together, with each other or with the model.
    """
    from factored_polca.solvers.protocol import load_solver

    model, solver = source.model, arguments.solver
    if arguments.discount is not None:
        model = replace_fields(model, discount=arguments.discount)
    if arguments.horizon is not None:
        model = replace_fields(
            model, horizon=None if arguments.horizon == "infinite" else arguments.horizon
        )
    full = model.observability == "full"
    own = ":" not in solver
    as_mdp = (solver in MDP_METHODS and (full or solver != "auto")) or (full and not own)
    if as_mdp and not full:
        raise UsageError(
            f"{solver} solves fully observed models; {source.name} is partially observed: use --solver "
            "auto, exact, sarsop, hsvi, pbvi or perseus"
        )
    refuse_horizon(source, model, solver, as_mdp, arguments)
    if not full and model.discount == 1 and model.horizon is None:
        raise UsageError(
            f"{source.name}: at discount 1 a partially observed model without a horizon has no defined "
            "value: give --discount D below 1, or --horizon H"
        )
    return Task(
        model, solver, chosen_gap(arguments, as_mdp), as_mdp,
        lambda: None if arguments.time is None else time.monotonic() + arguments.time,
        arguments.iterations, arguments.seed, None if own else load_solver(solver),
    )  # fmt: skip


def refuse_horizon(
    source: Source, model: Model, solver: str, as_mdp: bool, arguments: argparse.Namespace
) -> None:
    """Refuse a horizon that is too long, or that the solver can't have, or the lack of one."""
    horizon = model.horizon
    if horizon is None:
        if solver == "witness":
            raise UsageError("witness needs a horizon: give --horizon H, or use --solver exact")
        return
    said = "--horizon" if arguments.horizon is not None else f"{source.name}"
    if horizon > LONGEST_HORIZON:
        raise UsageError(
            f"{said} asks for {horizon} steps; at most {LONGEST_HORIZON:,} are solved for: give a shorter "
            "one, or --horizon infinite"
        )
    able = ("auto", "vi") if as_mdp and ":" not in solver else STAGED
    if solver not in able:
        both = ", ".join(STAGED if model.observability == "partial" else ("auto", "vi", "exact", "witness"))
        raise UsageError(
            f"{said} asks for a horizon of {horizon} steps, and {solver} has none: use --solver "
            f"{both}, or --horizon infinite"
        )
    if as_mdp and arguments.iterations is not None:
        raise UsageError("--iterations does not go with a horizon here: all its steps are needed")


def chosen_gap(arguments: argparse.Namespace, as_mdp: bool) -> float | None:
    """upper - lower that is asked for; --gap and --epsilon are two names of it."""
    gap, epsilon = arguments.gap, arguments.epsilon
    if gap is not None and epsilon is not None and gap != epsilon:
        raise UsageError(
            f"--gap {gap:g} and --epsilon {epsilon:g} both mean upper - lower at the start: give one"
        )
    asked: float | None = gap if gap is not None else epsilon
    if asked is None and not as_mdp:
        return EXACT_GAP if arguments.solver in ("exact", "witness") else GAP
    return asked


def wanted(task: Task) -> float | None:
    """The gap asked for; None where a finite horizon is solved whole."""
    return task.gap if task.model.horizon is None else None


# -- the work ------------------------------------------------------------------------------------


def warm(task: Task, output: Output) -> float:
    """Load or compile the kernels that are needed; the seconds that took."""
    seconds = compile_kernels(output)
    if task.as_mdp or task.custom is not None:
        return seconds
    from factored_polca.solvers.compiled import watch_compiling
    from factored_polca.solvers.warm_pomdp import warm_up

    def announce() -> None:
        output.note("compiling the solver's kernels, once for this installation (a minute or so)")

    with watch_compiling(announce):
        return seconds + warm_up(task.solver, staged=task.model.horizon is not None)


def listed(symbolic: SymbolicModel, task: Task) -> FlatModel:
    """The model as arrays; the time that there is counts for this alone.

    Raises:
        LimitReached: too many states, or time.
        UsageError: a POMDP solver, and an action that does not apply everywhere.
    """
    from factored_polca.diagrams import Aborted
    from factored_polca.minimisation.flat_model import flat_model

    symbolic.manager.deadline = task.deadline()
    try:
        flat = flat_model(symbolic)
    except Aborted as error:
        raise LimitReached(f"listing the states: {error}", "listing") from None
    finally:
        symbolic.manager.deadline = None
    if not task.as_mdp and flat.partial_action is not None:
        raise UsageError(
            f"{task.solver} would solve {task.model.name} as a POMDP whose state is seen, where actions "
            f"apply everywhere, and {flat.partial_action!r} does not: use --solver auto, vi, pi or mpi"
        )
    return flat


def work(task: Task, flat: FlatModel, source: Source, output: Output) -> tuple[Found, float]:
    """Solve; the solution, and how many seconds of it went into compiling what `warm` missed."""
    from factored_polca.solvers.compiled import watch_compiling

    show = shown(source, output)
    with watch_compiling() as compiling:
        if not task.as_mdp:
            found = solve_as_pomdp(task, flat, show)
        elif task.model.horizon is not None:
            found = solve_stages(task, flat, show)
        else:
            found = solve_as_mdp(task, flat, show)
    return found, compiling.seconds


def solve_as_pomdp(task: Task, flat: FlatModel, show: Callable[[str], None]) -> Found:
    """The solution of a partially observed model, or of one taken for such."""
    from factored_polca.solvers.pomdp_choose import solve_pomdp
    from factored_polca.solvers.protocol import call_pomdp_solver

    def progress(lower: float, upper: float) -> None:
        show(f"the value lies in {lower:.6g} .. {upper:.6g}, gap {upper - lower:.3g}")

    gap = EXACT_GAP if task.gap is None else task.gap
    demand = task.demand(gap, progress)
    if task.custom is not None:
        found = call_pomdp_solver(task.custom, flat.pomdp, demand)
    else:
        found = solve_pomdp(flat.pomdp, task.solver, demand=demand, horizon=task.model.horizon)
    return Found(
        found.lower, found.upper, found.value, found.policy, found.status, found.guarantee, found.method,
        found.vectors, found.iterations, found.seconds, found.note,
    )  # fmt: skip


def solve_as_mdp(task: Task, flat: FlatModel, show: Callable[[str], None]) -> Found:
    """The solution of a fully observed model; a second, finer run where the gap asked for needs one.

    `solve_mdp` takes its epsilon relative to the largest value, which is known after the first run.
    """
    from factored_polca.explicit.state_policy import StatePolicy
    from factored_polca.solvers.choose import solve_mdp
    from factored_polca.solvers.protocol import call_mdp_solver

    began, deadline = time.perf_counter(), task.deadline()
    epsilon = MDP_EPSILON if task.gap is None else task.gap
    mdp, initial = flat.to_mdp(), flat.pomdp.initial
    for _ in range(2):
        if task.custom is not None:
            found = call_mdp_solver(task.custom, mdp, task.demand(epsilon))
        else:
            found = solve_mdp(
                mdp,
                MDP_METHODS[task.solver],
                epsilon,
                deadline=deadline,
                iterations=task.iterations,
                progress=lambda n, gap: show(f"{n} iterations, gap {gap:.3g}"),
                describe=flat.state_text,
            )
        largest = float(np.abs(found.values[np.isfinite(found.values)]).max(initial=0.0))
        margin = (np.count_nonzero(initial) + 4) * 2.0**-52 * largest
        lower, upper = at_start(initial, found.lower) - margin, at_start(initial, found.upper) + margin
        if task.gap is None or found.status != "converged" or not upper - lower > task.gap:
            break
        epsilon = task.gap / max(1.0, largest) / 2
    status: Status = found.status
    if task.gap is not None and math.isfinite(upper - lower):
        reached = upper - lower <= task.gap
        status = "converged" if reached else "rounding limit" if status == "converged" else status
    dead = int(found.dead_ends.sum())
    return Found(
        lower, upper, min(max(at_start(initial, found.values), lower), upper),
        StatePolicy(found.policy[None, :]), status, found.guarantee, found.method, None, found.iterations,
        time.perf_counter() - began, f"{dead} dead ends, where every policy has lost" if dead else "",
    )  # fmt: skip


def solve_stages(task: Task, flat: FlatModel, show: Callable[[str], None]) -> Found:
    """The solution of a fully observed model over a finite horizon."""
    from factored_polca.solvers.backward_induction import backward_induction
    from factored_polca.solvers.result import Guarantee

    horizon, initial = task.model.horizon or 0, flat.pomdp.initial
    found = backward_induction(
        flat.to_mdp(),
        horizon,
        deadline=task.deadline(),
        progress=lambda done: show(f"{done:,} of {horizon:,} steps"),
    )
    value = at_start(initial, found.values)
    largest = float(np.abs(found.values[np.isfinite(found.values)]).max(initial=0.0))
    error = found.error + (np.count_nonzero(initial) + 4) * 2.0**-52 * largest
    text = f"the optimal value over {horizon} steps; rounding may have cost {error:.1e}"
    return Found(
        value - error, value + error, value, found.policy, "converged", Guarantee("exact", text),
        "backward induction", None, horizon, found.seconds, "",
    )  # fmt: skip


def at_start(initial: Any, values: Any) -> float:
    """The mean of `values` [s] under `initial` [s]; minus infinity where that is met."""
    support = np.flatnonzero(initial)
    return float(initial[support] @ values[support])

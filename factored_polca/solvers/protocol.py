"""Solvers of other people: what they are called with, how they are found, what is checked of their results.

A solver of partially observed problems is anything that can be called as `PomdpSolver` says, one of fully
observed problems as `MdpSolver` says: a function, an object, or a class without arguments.  It is named
"package.module:Name" on the command line (`plan --solver`, `solve --solver`) or given in `Options.solver`.
A name that stands in a model file is never imported: a model file is not trusted to run programs.

`factored_polca.solvers.proposal` makes a whole solution of alpha-vectors, a policy graph or a table of
actions, proves its lower bound and adds an upper one; with it a solver has ten lines.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from importlib import import_module
from typing import Any, Final, Protocol, TypeVar

from factored_polca.explicit.arrays import ArrayMDP, FloatArray
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.models.errors import LimitReached, ModelError
from factored_polca.solvers.pomdp_result import Demand, POMDPSolution
from factored_polca.solvers.result import MDPSolution
from factored_polca.solvers.verify import mdp_faults, pomdp_faults

REFERENCE: Final = re.compile(r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*:[A-Za-z_]\w*", re.ASCII)
"""How a solver is named: `package.module:Name`."""

Solution = TypeVar("Solution", MDPSolution, POMDPSolution)


class PomdpSolver(Protocol):
    """Solves a partially observed problem.

    `roots` [r, s] are beliefs at which the policy is wanted good beside the initial one, such as corners;
    None: the initial one only.  The policy must be a map from beliefs (`AlphaVectors`, or
    `EntropyPolicy`) to be used in a task.
    """

    def __call__(self, pomdp: ArrayPOMDP, demand: Demand, roots: FloatArray | None) -> POMDPSolution:
        """Bounds on the optimal value at the initial belief and at the roots, and a policy."""


class MdpSolver(Protocol):
    """Solves a fully observed problem.

    Asked for is upper - lower <= `demand.gap * max(1, max |value|)` in each state.
    """

    def __call__(self, mdp: ArrayMDP, demand: Demand) -> MDPSolution:
        """Bounds on the optimal value of each state, and a policy."""


def is_reference(text: str) -> bool:
    """Whether a text names a solver as `package.module:Name`."""
    return REFERENCE.fullmatch(text) is not None


def load_solver(reference: str) -> Callable[..., Any]:
    """The solver that `package.module:Name` names; a class is called without arguments first.

    This runs the module's code: never call it with a name that was read from a model file.

    Raises:
        ModelError: no such name, no such module, an error while it was imported, or nothing callable.
    """
    if not is_reference(reference):
        raise ModelError(f"{reference!r} names no solver: write package.module:Name")
    module_name, _, name = reference.partition(":")
    try:
        module = import_module(module_name)
    except Exception as error:
        raise ModelError(
            f"the solver {reference} can't be imported: {type(error).__name__}: {error}; the module must "
            "be installed, or its folder named by PYTHONPATH"
        ) from error
    found = getattr(module, name, None)
    if found is None:
        public = sorted(n for n, thing in vars(module).items() if callable(thing) and n[0] != "_")
        listed = ", ".join(public[:12]) or "nothing to call"
        raise ModelError(f"the module {module_name} has no {name}; it has {listed}")
    if inspect.isclass(found):
        try:
            found = found()
        except Exception as error:
            raise ModelError(
                f"the solver {reference} can't be made without arguments: {type(error).__name__}: {error}"
            ) from error
    if not callable(found):
        raise ModelError(f"the solver {reference} is {type(found).__name__}, which can't be called")
    checked: Callable[..., Any] = found
    return checked


def name_of(solver: object) -> str:
    """How a solver is called in messages: `module:name`."""
    kind = solver if hasattr(solver, "__qualname__") else type(solver)
    return f"{getattr(kind, '__module__', '?')}:{getattr(kind, '__qualname__', '?')}"


def call_pomdp_solver(
    solver: PomdpSolver, pomdp: ArrayPOMDP, demand: Demand, roots: FloatArray | None = None
) -> POMDPSolution:
    """What a solver returns, checked.

    Raises:
        ModelError: the solver failed, or what it returned is no solution; the message says in what.
    """
    found = _called(solver, lambda: solver(pomdp, demand, roots))
    return _checked(solver, found, pomdp_faults(found, pomdp, roots))


def call_mdp_solver(solver: MdpSolver, mdp: ArrayMDP, demand: Demand) -> MDPSolution:
    """What a solver returns, checked.

    Raises:
        ModelError: the solver failed, or what it returned is no solution; the message says in what.
    """
    found = _called(solver, lambda: solver(mdp, demand))
    return _checked(solver, found, mdp_faults(found, mdp))


def _called(solver: object, call: Callable[[], Solution]) -> Solution:
    try:
        return call()
    except (ModelError, LimitReached):
        raise
    except Exception as error:
        raise ModelError(f"the solver {name_of(solver)} failed: {type(error).__name__}: {error}") from error


def _checked(solver: object, found: Solution, faults: list[str]) -> Solution:
    if faults:
        raise ModelError(f"the solver {name_of(solver)} returned no right solution: {'; '.join(faults)}")
    return found

"""Compile the numeric kernels ahead of the work, so that times are times of the work.

On a fresh install numba compiles each kernel once and keeps it on disk; later processes load it.
A model of four states, with a synchronic arc, runs through every kernel of the main path.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from factored_polca.diagrams import INDEX, Field, dump, load, states_of_leaves
from factored_polca.diagrams.jit import compile_ahead, compiled_before
from factored_polca.diagrams.nodes import STEPS
from factored_polca.hierarchy.options import Options
from factored_polca.hierarchy.plan import plan_mdp
from factored_polca.minimisation import flat_process, partition_from
from factored_polca.minimisation.pass_kernel import run_passes
from factored_polca.minimisation.quotient import make_quotient
from factored_polca.models import Action, Feature, Model
from factored_polca.symbolic import NumericView, SymbolicModel, compile_model
from factored_polca.symbolic.forward import ForwardRegression


def tiny_model() -> Model:
    """A model of four states whose actions have synchronic arcs, or none."""
    x, y = Feature("x", range(2)), Feature("y", range(2))
    joint = Action("joint", {x: "{0: 0.5, 1: 0.5}", y: "x' if x == 0 else {0: 0.1, 1: 0.9}"})
    apart = Action("apart", {y: "{0: 0.25, 1: 0.75}"}, rewards="x + y / 3")
    return Model("tiny", [x, y], [joint, apart], rewards="1 if y == 1 else 0", terminal="x == 1 and y == 1")


def is_compiled() -> bool:
    """Whether the kernels lie compiled on disk already."""
    return compiled_before()


def compile_passes() -> None:
    """Compile the largest kernel alone: another process may, while this one compiles the others."""
    compile_ahead(run_passes)


def warm_up(ready: Callable[[], object] | None = None) -> float:
    """Compile, or load from disk, the kernels; answer the seconds it took.

    `ready` is called before the largest kernel is needed, to wait for a process that compiles it.
    """
    began = time.perf_counter()
    if ready is not None:
        _warm_others()
        ready()
    found = plan_mdp(tiny_model(), options=Options(memory_limit=1 << 28))
    policy, manager = found.root.policy, found.symbolic.manager
    states_of_leaves(policy, found.symbolic.now_levels)
    load(manager, dump(policy), INDEX)
    _warm_forward(found.symbolic)
    manager.collect_garbage()
    return time.perf_counter() - began


def _warm_forward(symbolic: SymbolicModel) -> None:
    symbolic.manager.indicator(symbolic.now(0), [0])
    numbers = NumericView(symbolic, Field())
    ForwardRegression(numbers, 1, numbers.weights(1, 1)[0]).run(STEPS)


def _warm_others() -> None:
    """What planning needs but `run_passes`: a quotient of the model by its terminal states."""
    symbolic = compile_model(tiny_model())
    _warm_forward(symbolic)
    partition = partition_from(symbolic, symbolic.terminal)
    make_quotient(flat_process(symbolic), partition)
    states_of_leaves(symbolic.terminal, symbolic.now_levels)
    load(symbolic.manager, dump(symbolic.terminal), INDEX)
    symbolic.manager.collect_garbage()

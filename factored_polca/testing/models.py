"""`check_model`: whether a model is right, and its two readings, by enumeration and by diagrams, agree."""

from __future__ import annotations

from typing import Any

import numpy as np

from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.explicit.exact_pomdp import enumerate_pomdp
from factored_polca.formats.native import read_native, write_native
from factored_polca.minimisation import flat_process, reduce
from factored_polca.minimisation.unreduced import unreduced, unreduced_mdp
from factored_polca.models import Model, ModelError, TaskHierarchy, check, check_tasks
from factored_polca.symbolic import SymbolicModel, compile_model
from factored_polca.testing.reductions import check_reduction

MOST_STATES = 5_000
TOLERANCE = 1e-12
"""Products of a few rounded probabilities; rewards are compared relative to the largest."""


def check_model(
    model: Model, tasks: TaskHierarchy | None = None, *, maximum_states: int = MOST_STATES
) -> None:
    """Whether a model, and its tasks, keep what every model must.

    There are no faults; the native format gives it back; it compiles, and its quotient by the coarsest
    partition has its rows and rewards; read off diagrams it is what enumerating its states gives.  The
    last two are left out beyond `maximum_states` states.

    Raises:
        AssertionError: with what is wrong.
    """
    faults = [*check(model), *(check_tasks(model, tasks) if tasks is not None else ())]
    wrong = [str(fault) for fault in faults if fault.severity == "error"]
    assert not wrong, f"{model.name}: {'; '.join(wrong)}"
    try:
        back = read_native(write_native(model, tasks), name=model.name)
        assert back.model == model, f"{model.name}: written and read again it is another model"
        assert tasks is None or back.tasks == tasks, f"{model.name}: its tasks read again are others"
        symbolic = compile_model(model)
        if model.states > maximum_states:
            return
        check_reduction(reduce(flat_process(symbolic)), maximum_states=maximum_states)
        _compare(model, symbolic)
    except ModelError as error:
        raise AssertionError(f"{model.name}: {error}") from error


def _compare(model: Model, symbolic: SymbolicModel) -> None:
    mine: Any
    theirs: Any
    names: tuple[str, ...]
    if model.observability == "full":
        mine, theirs = unreduced_mdp(symbolic), enumerate_model(model).to_arrays()
        matrices = [(name, m) for name, m in zip(mine.actions, mine.transitions, strict=True)]
        others = list(theirs.transitions)
        names = ("terminal", "applicable", "rewards")
    else:
        mine, theirs = unreduced(symbolic, reachable=False).pomdp, enumerate_pomdp(model).to_arrays()
        assert mine.observations == theirs.observations, f"{model.name}: other observations by diagrams"
        matrices = [(name, m) for name, row in zip(mine.actions, mine.kernel, strict=True) for m in row]
        others = [m for row in theirs.kernel for m in row]
        names = ("terminal", "observed", "initial", "rewards")
    for name in names:
        left, right = getattr(mine, name).astype(float), getattr(theirs, name).astype(float)
        scale = max(1.0, float(np.abs(right).max(initial=0.0)))
        assert left.shape == right.shape, f"{model.name}: {name} has other shapes in the two readings"
        assert np.allclose(left, right, rtol=0, atol=TOLERANCE * scale), (
            f"{model.name}: {name} differs between diagrams and enumeration"
        )
    for (action, matrix), other in zip(matrices, others, strict=True):
        off = abs(matrix - other)
        assert not off.nnz or float(off.max()) <= TOLERANCE, (
            f"{model.name}: the rows of {action!r} differ between diagrams and enumeration"
        )

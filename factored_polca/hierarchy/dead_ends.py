"""Plans that can run into a dead end are refused: no policy of the root avoids it from a start state."""

from __future__ import annotations

import numpy as np

from factored_polca.hierarchy.evaluation import describe_block
from factored_polca.hierarchy.solved import AnySolvedTask, StructuredTask
from factored_polca.hierarchy.structured_task import lost_start
from factored_polca.models import Fault, ModelError


def refuse_unavoidable_dead_ends(root: AnySolvedTask) -> None:
    """Raise an error if the polled policy can run into a dead end from a start state.

    Raises:
        ModelError: naming such a start.
    """
    with root.process.symbolic.manager.undisturbed():  # it may be late, and is soon done
        if isinstance(root, StructuredTask):
            state = lost_start(root.solution)
        else:
            belief = root.reduction.project_initial()
            lost = np.flatnonzero((belief > 0) & root.solution.dead_ends)
            state = describe_block(root.reduction, int(lost[0])) if len(lost) else None
    if state is not None:
        message = (
            f"from a start state like {state} every policy of task {root.task.name!r} can run into a state "
            "that is not terminal and has no applicable action"
        )
        hint = "make such states terminal, add an action, or start elsewhere"
        raise ModelError([Fault(message, ("tasks", root.task.name), hint)])

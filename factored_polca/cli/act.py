"""The command `act`: what a plan does in a state, or at a belief, and the path of tasks there."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from fractions import Fraction
from typing import TYPE_CHECKING, Any

from factored_polca.cli.output import Output, big, escape, make_table
from factored_polca.cli.source import UsageError, parse_belief, parse_state
from factored_polca.models import LimitReached, Value

if TYPE_CHECKING:
    from factored_polca.cli.pilot import AnyPlan, Said
    from factored_polca.control.tracker import Belief


def act(arguments: argparse.Namespace, output: Output) -> int:
    """Say what a plan does."""
    from factored_polca.cli.pilot import open_plan
    from factored_polca.hierarchy.executable import ExecutablePlan

    plan = open_plan(arguments.plan)
    seen = plan.model.observability == "full"
    if arguments.state is not None and arguments.belief is not None:
        raise UsageError("--state and --belief: give one of them")
    if seen and arguments.belief is not None:
        raise UsageError(f"{arguments.plan}: the state is seen, there is no belief; give --state")
    if seen and arguments.state is None:
        raise UsageError(f"{arguments.plan}: the state is seen; say where it is: --state x=3,y=2,...")
    if arguments.state is not None and isinstance(plan, ExecutablePlan):
        said = at_state(plan, parse_state(arguments.state, plan.model))
    else:
        said = at_belief(plan, arguments)
    data: dict[str, Any] = {"action": said.action}
    if said.state is not None and not seen:
        data["likeliest_state"] = dict(said.state)
    data["path"] = said.path
    if arguments.json:
        output.result(data)
    elif "probability" in said.path[0]:
        print_belief_path(said, output)
    else:
        print_path(said, output, None if seen or arguments.state is not None else said.state)
    return 0


def at_state(plan: Any, state: Mapping[str, Value]) -> Said:
    """What a policy of states does in a state."""
    from factored_polca.cli.pilot import Said, poll_data
    from factored_polca.control import Controller

    decision = Controller(plan).poll(state)
    return Said(decision.action, -1, [poll_data(poll) for poll in decision.path])


def at_belief(plan: AnyPlan, arguments: argparse.Namespace) -> Said:
    """What a plan does at the belief that the arguments give."""
    from factored_polca.cli.pilot import decider

    given: Mapping[str, Mapping[Value, Fraction]] | None = None
    if arguments.state is not None:
        state = parse_state(arguments.state, plan.model)
        given = {name: {value: Fraction(1)} for name, value in state.items()}
    elif arguments.belief is not None:
        given = parse_belief(arguments.belief, plan.model)
    return decider(plan)(belief_at_once(plan, given))


def belief_at_once(plan: AnyPlan, given: Mapping[str, Mapping[Value, Fraction]] | None) -> Belief:
    """The belief to be asked at.

    It need not be tracked, so a product of diagrams does, which takes no minimising; the tracker that fits
    the plan where it does not fit.

    Raises:
        UsageError: what is seen is not said, or the belief is impossible.
    """
    from factored_polca.cli.pilot import rows_of, seen_at_start, tracker_of
    from factored_polca.control import DiagramTracker, ImpossibleObservation
    from factored_polca.hierarchy.executable import ExecutablePlan

    rows = rows_of(plan, given)
    seen, unsaid = seen_at_start(plan.symbolic, rows)
    if unsaid:
        listed = ", ".join(f"{name}=..." for name in unsaid)
        raise UsageError(f"what is seen must be certain: say which value is seen, --belief {listed}")
    try:
        if isinstance(plan, ExecutablePlan):
            return tracker_of(plan, "error").tracker.start(seen, initial=rows)
        try:
            return DiagramTracker(plan.symbolic).start(seen, initial=rows)
        except LimitReached:
            return tracker_of(plan, "error").tracker.start(seen, initial=rows)
    except ImpossibleObservation as error:
        raise UsageError(f"no action follows: {error}") from None


def print_path(said: Said, output: Output, likeliest: Mapping[str, Value] | None) -> None:
    """The path of a policy of states for people."""
    from factored_polca.cli.pilot import LIKELIEST, assigned

    if likeliest is not None:
        output.line(LIKELIEST)
        output.line(f"likeliest state: {assigned(likeliest)}")
    table = make_table(
        "polled from the top", {"task": "left", "block": "right", "states in it": "right", "answer": "left"}
    )
    for poll in said.path:
        without = "the task has ended" if poll["terminal"] else "no action: a dead end"
        if poll["block"] is None:
            without = "no action: outside the states that were planned for (--reachable)"
        answer = poll["action"] or without
        block = "none" if poll["block"] is None else f"{poll['block']:,}"
        table.add_row(escape(poll["task"]), block, big(poll["block_states"]), escape(answer))
    output.table(table)
    output.line(f"action: [bold]{escape(said.action or 'none')}[/]")


def print_belief_path(said: Said, output: Output) -> None:
    """The path of a policy of beliefs for people."""
    from factored_polca.cli.pilot import assigned, chance

    columns = {
        "task": "left", "answer": "left", "likeliest block": "right", "states in it": "right",
        "probability": "right", "its first state": "left",
    }  # fmt: skip
    table = make_table("polled from the top", columns)
    for poll in said.path:
        table.add_row(
            escape(poll["task"]), escape(poll["action"]) + notes(poll), f"{poll['block']:,}",
            big(poll["block_states"]), chance(poll["probability"]), assigned(poll["state"]),
        )  # fmt: skip
    output.table(table)
    output.line(f"action: [bold]{escape(said.action or 'none')}[/]")


def notes(poll: Mapping[str, Any]) -> str:
    """What is special about an answer."""
    found = ["this task has ended"] if poll.get("ended") else []
    if poll.get("looked_ahead"):
        found.append("by looking ahead: the policy's own answer has ended")
    return f" ({'; '.join(found)})" if found else ""

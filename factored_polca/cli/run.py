"""The command `run`: an episode step by step, observed by a person, a script, or a simulated world.

At each step it prints what the plan does and believes, then takes what was observed.  Lines come from a
terminal or from a pipe; with --json what is printed for people goes to stderr.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import textwrap
from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np

from factored_polca.cli.commands import compile_kernels
from factored_polca.cli.episode import SHOWN_VALUES, Episode, Step
from factored_polca.cli.output import Output, big, escape, printable
from factored_polca.cli.pilot import (
    LIKELIEST,
    AnyPlan,
    Said,
    assigned,
    chance,
    decider,
    features_of,
    open_plan,
    rows_of,
    seen_at_start,
    tracker_of,
)
from factored_polca.cli.replies import Asked, Misread, allowed, asked_after, listing, read_reply
from factored_polca.cli.source import UsageError, parse_belief
from factored_polca.control.answers import answers, can_end
from factored_polca.control.received import shown
from factored_polca.control.tracker import Belief, Rows, Tracker
from factored_polca.explicit.belief import ImpossibleObservation
from factored_polca.hierarchy.executable import ExecutablePlan
from factored_polca.models import ModelError, Value
from factored_polca.simulation.sampler import Sampler

AUTO_STEPS: Final = 20
"""Steps of an episode that is simulated, where nobody asks for more."""

SHOWN_FEATURES: Final = 15
"""Features of which more than one value is printed."""

SHOWN_ANSWERS: Final = 30
"""Answers that `?` lists."""

LISTED_VALUES: Final = 8
"""Values of a channel up to which the prompt lists them."""

HELP: Final = "back takes the last step back, quit ends the dialogue"


class Quit(Exception):
    """The dialogue is over."""


class Back(Exception):
    """The last step is to be taken back."""


def run(arguments: argparse.Namespace, output: Output) -> int:
    """Run a plan step by step."""
    plan = open_plan(arguments.plan)
    if plan.model.observability == "full":
        raise UsageError(f"{arguments.plan}: the state is seen; act --state says what is done in a state")
    if arguments.seed is not None and not arguments.auto:
        raise UsageError("--seed is for --auto: without it nothing is drawn")
    given = None if arguments.belief is None else parse_belief(arguments.belief, plan.model)
    compile_kernels(output)
    with output.progress("making a tracker of beliefs"):
        chosen = tracker_of(plan, "reset" if arguments.auto else "error", arguments.seed or 0)
    session = Session(plan, chosen.tracker, rows_of(plan, given), Talk(output))
    status = 0
    try:
        if arguments.auto:
            session.simulate(arguments.steps or AUTO_STEPS, arguments.seed or 0)
        else:
            session.hold(arguments.steps)
    except Quit:
        pass
    except KeyboardInterrupt:
        session.talk.line()
        status = 130
    session.close(arguments.auto)
    if arguments.json:
        output.result(
            {
                "model": plan.model.name,
                "tracker": chosen.kind,
                "tracker_reason": chosen.reason,
                **session.episode.data(session.decide, rewarded=arguments.auto),
            }
        )
    return status


class Talk:
    """What is said to a person, and what a person types."""

    def __init__(self, output: Output) -> None:
        self.console = output.err if output.as_json else output.out
        self.silent = output.as_json and output.quiet
        stream = sys.stdin
        self.typed = stream is not None and stream.isatty() and sys.stdout.isatty() and not output.as_json
        if stream is not None and hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
        if self.typed:
            with contextlib.suppress(ImportError):
                import readline  # noqa: F401  # it lets `input` edit lines

    def line(self, text: str = "") -> None:
        """Print a line; `text` may hold markup."""
        if not self.silent:
            self.console.print(text, soft_wrap=True)

    def indented(self, text: str) -> None:
        """Print escaped text, wrapped to the terminal, under a step."""
        width = max(40, self.console.width)
        for part in textwrap.wrap(
            text, width, initial_indent="    ", subsequent_indent="      ",
            break_long_words=False, break_on_hyphens=False,
        ):  # fmt: skip
            self.line(part)

    def ask(self, prompt: str) -> str:
        """A line that is typed, or read and printed.

        Raises:
            Quit: there is no further line.
        """
        if self.typed:
            try:
                return input(printable(prompt))
            except EOFError:
                self.line()
                raise Quit from None
        found = sys.stdin.readline() if sys.stdin is not None else ""
        if not self.silent:
            self.console.print(escape(prompt + found.rstrip("\r\n")), soft_wrap=True)
        if not found:
            raise Quit
        return found


class Session:
    """An episode and who observes it (a working state, not a value)."""

    def __init__(self, plan: AnyPlan, tracker: Tracker, rows: Rows, talk: Talk) -> None:
        self.plan, self.tracker, self.rows, self.talk = plan, tracker, rows, talk
        self.symbolic, self.model = plan.symbolic, plan.model
        self.decide = decider(plan)
        self.episode = Episode(plan.model, tuple(features_of(plan)))

    # -- the two ways -----------------------------------------------------------------------------

    def hold(self, limit: int | None) -> None:
        """Let a person observe.

        Raises:
            Quit: asked for, or no further line.
        """
        belief = self.start_by_person()
        self.open()
        while not belief.ended and (limit is None or len(self.episode.steps) < limit):
            self.episode.belief = belief
            said = self.decide(belief)
            self.show(belief, said)
            if said.action is None:
                raise Quit
            try:
                step = self.observe(belief, said)
            except Back:
                if self.episode.steps:
                    belief = self.episode.steps.pop().belief
                else:
                    self.talk.line("    there is no step to take back")
                continue
            belief = self.keep(*step)
        self.episode.belief = belief

    def simulate(self, steps: int, seed: int) -> None:
        """Let a world that is drawn, unseen by the plan, observe."""
        sampler, generator = Sampler(self.symbolic), np.random.default_rng(seed)
        state = sampler.initial(1, generator, self.rows)
        belief = self.start(self.seen(state), bool(sampler.terminal(state)[0]))
        self.open()
        while not belief.ended and len(self.episode.steps) < steps:
            self.episode.belief = belief
            said = self.decide(belief)
            self.show(belief, said)
            if said.action is None:
                raise Quit
            number = np.array([said.number])
            following, rewards = sampler.step(state, number, generator)
            values = sampler.observe(state, number, following, generator)[0].tolist()
            sensed = self.tracker.reader.sensed[said.number]
            channels = [(self.model.observations[j], values[j]) for j in sensed]
            observation = {c.name: c.values[v] for c, v in channels} | self.seen(following)
            after = belief.after(said.number, observation, ended=bool(sampler.terminal(following)[0]))
            step = Step(belief, said, observation, after.ended, after.likelihood, float(rewards[0]))
            belief, state = self.keep(step, after), following
        self.episode.belief = belief

    def seen(self, state: Any) -> dict[str, Value]:
        """The values of the observed features of a drawn state."""
        features = [(i, self.model.features[i]) for i in self.tracker.reader.observed]
        return {feature.name: feature.values[int(state[0, i])] for i, feature in features}

    def keep(self, step: Step, after: Belief) -> Belief:
        """Note a step and say what came of it; answer the belief after it."""
        self.episode.steps.append(step)
        observed = assigned(step.observation or {}) or "nothing"
        observed += ", and the episode has ended" if step.ended else ""
        likelihood = 0.0 if step.likelihood is None else step.likelihood
        reward = "" if step.reward is None else f"; reward {step.reward:g}"
        self.talk.line(f"    observed: {observed} (probability {chance(likelihood)}){reward}")
        if after.was_reset:
            self.talk.line("    the sample did not hold that possible: the belief starts anew")
        return after

    # -- the start --------------------------------------------------------------------------------

    def start(self, seen: Mapping[str, Value], ended: bool = False) -> Belief:
        """The belief at the start.

        Raises:
            UsageError: it is impossible.
        """
        try:
            return self.tracker.start(seen, ended=ended, initial=self.rows)
        except ImpossibleObservation as error:
            raise UsageError(str(error)) from None

    def start_by_person(self) -> Belief:
        """The belief at the start; what is seen there and not certain is asked for."""
        seen, unsaid = seen_at_start(self.symbolic, self.rows)
        if not unsaid:
            return self.start(seen)
        asked = asked_after(self.tracker.reader, -1, ending=False)
        while True:
            line = self.talk.ask(f"seen at the start, {prompt(asked)}").strip()
            try:
                if self.is_command(line, lambda: allowed(asked)):
                    continue
                read = read_reply(line, asked, lambda: None).observation
                return self.tracker.start(seen | read, initial=self.rows)
            except Back:
                self.talk.line("    there is no step to take back")
            except (Misread, ModelError, ImpossibleObservation) as error:
                self.talk.indented(escape(str(error)))

    # -- an observation ---------------------------------------------------------------------------

    def observe(self, belief: Belief, said: Said) -> tuple[Step, Belief]:
        """What a person says was observed, asked until it is right.

        Raises:
            Back, Quit: where that was asked for instead.
        """
        asked = asked_after(self.tracker.reader, said.number, can_end(belief))
        while True:
            line = self.talk.ask(prompt(asked)).strip()
            try:
                if self.is_command(line, lambda: self.listed(belief, said.number, asked)):
                    continue
                reply = read_reply(line, asked, lambda: answers(belief, said.number))
                ended = reply.ended
                try:
                    after = belief.after(said.number, reply.observation, ended=ended)
                except ImpossibleObservation:
                    if ended or not asked.ending:
                        raise
                    ended = surely_ended(belief, said.number, reply.observation)
                    after = belief.after(said.number, reply.observation, ended=ended)
            except (Misread, ModelError, ImpossibleObservation) as error:
                self.talk.indented(escape(str(error)))
                continue
            likelihood = after.likelihood if reply.known is None else reply.known
            return Step(belief, said, reply.observation, ended, likelihood), after

    def is_command(self, line: str, helped: Callable[[], str]) -> bool:
        """Whether a line asked for help, which is printed.

        Raises:
            Back, Quit: where that was asked for.
        """
        match line.casefold():
            case "?" | "help":
                self.talk.line(helped())
                self.talk.line(f"    {HELP}")
                return True
            case "back":
                raise Back
            case "quit" | "exit":
                raise Quit
        return False

    def listed(self, belief: Belief, action: int, asked: Asked) -> str:
        """What may be observed, with probabilities."""
        found = answers(belief, action)
        if found is None:
            return f"    too many to list: {escape(allowed(asked))}"
        lines = [
            f"    {chance(answer.probability):>8}  {assigned(answer.observation) or 'nothing'}"
            + (" and ended" if answer.ended else "")
            for answer in found[:SHOWN_ANSWERS]
        ]
        if len(found) > SHOWN_ANSWERS:
            lines.append(f"    and {len(found) - SHOWN_ANSWERS:,} less likely ones")
        return "\n".join(lines)

    # -- what is printed --------------------------------------------------------------------------

    def open(self) -> None:
        """What is run, and how."""
        name, states, kind = escape(self.model.name), big(self.model.states), self.tracker.kind
        self.talk.line(f"{name}, {states} states; beliefs tracked: {kind}")
        if isinstance(self.plan, ExecutablePlan):
            self.talk.line(LIKELIEST)

    def show(self, belief: Belief, said: Said) -> None:
        """The action, the path and the belief."""
        path = " > ".join(escape(poll["task"]) for poll in said.path)
        action = escape(said.action or "no action: the task at the top has ended everywhere that may be")
        ahead = " (by looking ahead)" if any(poll.get("looked_ahead") for poll in said.path) else ""
        self.talk.line()
        self.talk.line(f"[bold]{len(self.episode.steps) + 1}. {action}[/]   {path}{ahead}")
        if said.state is not None:
            self.talk.indented(f"likeliest: {assigned(said.state)}")
        sure, unsure = self.episode.hypotheses(belief)
        if sure:
            self.talk.indented(f"sure: {assigned(sure)}")
        width = max((len(name) for name, _ in unsure), default=0)
        for name, values in unsure[:SHOWN_FEATURES]:
            told = "  ".join(f"{escape_value(value)} {chance(q)}" for value, q in values[:SHOWN_VALUES])
            more = "  ..." if len(values) > SHOWN_VALUES else ""
            self.talk.indented(f"{escape(name.ljust(width))}  {told}{more}")
        if len(unsure) > SHOWN_FEATURES:
            self.talk.indented(f"and {len(unsure) - SHOWN_FEATURES:,} more features that are not sure")

    def close(self, auto: bool) -> None:
        """How it went."""
        done = f"{len(self.episode.steps):,} step{'' if len(self.episode.steps) == 1 else 's'}"
        if self.episode.ended:
            done += "; the episode has ended"
        self.talk.line()
        self.talk.line(f"{done}; log-likelihood of what was observed {self.episode.log_likelihood():.6g}")
        if auto:
            self.talk.line(
                f"earned {self.episode.earned(1.0):g}, "
                f"discounted {self.episode.earned(float(self.model.discount)):.6g}"
            )


def surely_ended(belief: Belief, action: int, observation: Mapping[str, Value]) -> bool:
    """Whether the episode must have ended where this was observed."""
    try:
        belief.after(action, observation, ended=True)
    except ImpossibleObservation:
        return False
    return True


def escape_value(value: Value) -> str:
    """A value as it is to be seen."""
    return escape(shown(value))


def prompt(asked: Asked) -> str:
    """What is asked for, with its values where they are few."""
    if not asked.values:
        return "nothing is sensed, Enter goes on> "
    told = []
    for name, values in asked.values.items():
        told.append(f"{name} ({listing(values)})" if len(values) <= LISTED_VALUES else name)
    return f"{', '.join(told)}> "

"""PRISM's language for Markov decision processes and Markov chains (Kwiatkowska, Norman & Parker 2011).

The program is read by Storm's parser (the extra `storm`); its modules and commands become features and
actions as `factored_polca.formats.prism_actions` says, outcomes that assign several variables as
`factored_polca.formats.prism_outcomes` does. Settings, beside constants of the program (which come
first):

    discount    PRISM has none: `--set discount=0.95`, or a constant `discount` of the program
    rewards     the reward structure, by name or number from 1; the only one if it is left out
    costs       the same, but its values are costs: their sign is turned
    terminal    the label whose states end the run, or `none`; if left out, the label "terminal" if any

    state reward  g : v       v in each step that begins where g holds
    [a] g : v                 v for the action a where g holds; [] for commands without a label
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from fractions import Fraction

from factored_polca.formats.prism_actions import Actions
from factored_polca.formats.prism_expressions import choose
from factored_polca.formats.prism_initial import initial_belief
from factored_polca.formats.prism_process import parse_program
from factored_polca.formats.prism_program import Program, Structure, make_program
from factored_polca.formats.prism_text import Place, Scan, scan
from factored_polca.models.errors import Fault, ModelError
from factored_polca.models.expressions import FALSE, ZERO, Expression
from factored_polca.models.language import number
from factored_polca.models.model import Model

SETTINGS = ("discount", "rewards", "costs", "terminal")
NO_DISCOUNT = "PRISM programs have no discount"
DISCOUNT_HINT = (
    "give one: --set discount=0.95, or --set discount=1 where every policy comes to an end; or write "
    "const double discount = 0.95; in the program"
)


class Places:
    """Where the parts of the model stand in the program."""

    def __init__(self, places: Mapping[tuple[str, ...], Place]) -> None:
        self._places = places

    def __call__(self, faults: Iterable[Fault]) -> tuple[Fault, ...]:
        """The faults with line and column of the places that their paths name."""
        return tuple(self._located(fault) for fault in faults)

    def _located(self, fault: Fault) -> Fault:
        for length in range(len(fault.path), 0, -1):
            line, column = self._places.get(fault.path[:length], (0, 0))
            if line and not fault.line:
                return replace(fault, line=line, column=column)
        return fault


def read_prism(
    text: str, settings: Mapping[str, str] | None = None, name: str = "model"
) -> tuple[Model, tuple[Fault, ...], Places]:
    """The model of a PRISM program, warnings, and where its parts stand.

    Raises:
        ModelError: stormpy is not there, the program is at fault, or has what is not read.
    """
    given = dict(settings or {})
    places = scan(text)
    source = places.for_the_parser()
    if not places.kind:
        source = f"mdp {source}"  # PRISM's default

    def original(line: int, column: int) -> Place:
        shift = 4 if line == 1 and not places.kind else 0
        return places.original(line, max(1, column - shift))

    raw = parse_program(source, original)
    known = {constant for constant, _, _ in raw.constants} - {places.constant}
    unknown = sorted(set(given) - known - set(SETTINGS))
    if unknown:
        listed = ", ".join(sorted(known)) or "none"
        raise ModelError([Fault(
            f"nothing called {unknown[0][:60]!r} to set",
            hint=f"constants of the program are {listed}; others are {', '.join(SETTINGS)}",
        )])  # fmt: skip
    options = {key: given.pop(key) for key in SETTINGS if key in given and key not in known}
    program = make_program(raw, places, given)
    return _Assembly(program, places, options, name).model()


class _Assembly:
    def __init__(self, program: Program, places: Scan, options: Mapping[str, str], name: str) -> None:
        self.program, self.scan, self.options, self.name = program, places, options, name
        self.warnings = list(program.warnings)
        self.at: dict[tuple[str, ...], Place] = {}

    def model(self) -> tuple[Model, tuple[Fault, ...], Places]:
        program = self.program
        discount = self.discount()
        terminal = self.terminal()
        structure, sign = self.rewards()
        steps: list[Expression] = []
        for item in structure.items:
            if item.label is None:
                self.at["reward", str(len(steps))] = item.place
                steps.append(choose(item.guard, sign * item.value, ZERO))

        def own(label: str) -> list[Expression]:
            items = [item for item in structure.items if item.label == label]
            return [choose(item.guard, sign * item.value, ZERO) for item in items]

        actions = Actions(program, terminal)
        self.warnings += actions.warnings
        chain = program.kind == "dtmc"
        made = [(actions.of_dtmc(own), (0, 0))] if chain else list(actions.of_mdp(own))
        for action, place in made:
            self.at["actions", action.name] = place
        for feature in program.features:
            self.at["features", feature.name] = self.scan.variables.get(feature.name, (0, 0))
        parameters = {key: value for key, value in program.parameters.items() if key != "discount"}
        model = Model(
            self.name, program.features, [action for action, _ in made], rewards=steps, terminal=terminal,
            initial=initial_belief(program, self.scan.initial), discount=discount, parameters=parameters,
            description=f"A PRISM program ({program.kind}).",
        )  # fmt: skip
        if program.initial is not None:
            self.note("init is read as the uniform distribution over the states that satisfy it",
                      self.scan.initial)  # fmt: skip
        return model, tuple(self.warnings), Places(self.at)

    def note(self, message: str, place: Place, hint: str = "") -> None:
        self.warnings.append(Fault(message, hint=hint, line=place[0], column=place[1], severity="warning"))

    def discount(self) -> Fraction:
        constant = self.program.constants.get("discount")
        if constant is not None:
            return Fraction(constant)
        if "discount" not in self.options:
            raise ModelError([Fault(NO_DISCOUNT, ("discount",), DISCOUNT_HINT)])
        text = self.options["discount"]
        try:
            over, _, under = text.partition("/")
            return number(over.strip()) / number(under.strip() or "1")
        except (ValueError, ZeroDivisionError):
            raise ModelError(f"discount is a number such as 0.95 or 19/20, not {text[:40]!r}") from None

    def terminal(self) -> Expression:
        labels = self.program.labels
        asked = self.options.get("terminal")
        if asked is None:
            if "terminal" not in labels:
                return FALSE
            message = 'the states labelled "terminal" end the run'
            hint = "--set terminal=LABEL names another label, --set terminal=none none"
            self.note(message, self.scan.labels.get("terminal", (0, 0)), hint)
            asked = "terminal"
        elif asked == "none" and "none" not in labels:
            return FALSE
        asked = asked.strip('"')
        if asked not in labels:
            listed = ", ".join(labels) or "none"
            raise ModelError([Fault(f"no label {asked[:60]!r}", ("terminal",), f"labels are {listed}")])
        self.at["terminal",] = self.scan.labels.get(asked, (0, 0))
        return labels[asked]

    def rewards(self) -> tuple[Structure, int]:
        """The reward structure that is asked for, and the sign of its values."""
        structures = self.program.structures
        asked = [key for key in ("rewards", "costs") if key in self.options]
        if len(asked) > 1:
            raise ModelError("give rewards or costs, not both")
        listed = ", ".join(s.name or f"number {i + 1}" for i, s in enumerate(structures)) or "none"
        if not asked:
            if len(structures) > 1:
                hint = f"name one of {listed}: --set rewards=NAME, or costs=NAME to turn the sign"
                raise ModelError([Fault(f"{len(structures)} reward structures", ("reward",), hint)])
            if not structures:
                self.note("no reward structure: every reward is 0", (0, 0))
            return (structures[0] if structures else Structure("", ())), 1
        text = self.options[asked[0]].strip('"')
        sign = -1 if asked[0] == "costs" else 1
        for structure in structures:
            if structure.name == text:
                return structure, sign
        if text.isdigit() and len(text) < 6 and 1 <= int(text) <= len(structures):
            return structures[int(text) - 1], sign
        raise ModelError([Fault(f"no reward structure {text[:60]!r}", ("reward",), f"there are {listed}")])


__all__ = ["Places", "read_prism"]

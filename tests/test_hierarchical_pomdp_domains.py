"""The shipped partially observable domains with task hierarchies, read again here by independent means.

Kernels are compared, state by state, with small simulations written from the domains' descriptions;
numbers of blocks with counts made by hand; the nursing robot's rewards with Table 1 of the paper.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from functools import cache
from itertools import product
from typing import Any

import pytest

from factored_polca import library
from factored_polca.explicit.evaluate import distribution, evaluate
from factored_polca.explicit.exact_pomdp import ExactPOMDP, enumerate_pomdp
from factored_polca.formats.document import Document
from factored_polca.formats.native import read_native, write_native
from factored_polca.minimisation import flat_process, minimise
from factored_polca.models import Action, Model, ModelError, check, check_tasks
from factored_polca.models.expressions import references
from factored_polca.models.model import replace_fields
from factored_polca.symbolic import compile_model

F = Fraction
State = tuple[Any, ...]
Joint = dict[tuple[State, State], Fraction]
Step = Callable[[State, str], tuple[Joint, Fraction]]

# name, parameters, states, actions, tasks
SOUND = [
    ("meds", {}, 3, 4, 2),
    ("meds", {"accuracy": "1/3", "discount": "0"}, 3, 4, 2),
    ("part_painting", {}, 4, 4, 2),
    ("twenty_questions", {}, 12, 20, 4),
    ("twenty_questions", {"accuracy": "1"}, 12, 20, 4),
    ("cheese_taxi", {}, 33, 7, 6),
    ("network", {"segment": "2"}, 2**4, 9, 3),
    ("network", {"size": "5", "segment": "3"}, 2**5, 11, 3),
    ("network", {"size": "7", "topology": "legs", "segment": "2"}, 2**7, 15, 5),
    ("network", {"size": "1", "topology": "legs", "segment": "1"}, 2, 3, 2),
    ("nursebot", {}, 576, 19, 7),
    ("nursebot", {"rooms": "1", "bystanders": "1"}, 576 * 2 * 4, 19, 7),
    ("nursebot", {"topics": "4"}, 192 * 5, 23, 7),
    ("nursebot", {"patients": "3"}, 64 * 5 * 3 * 3, 21, 7),
    ("nursebot", {"perturbation": "1/2", "seed": "3"}, 576, 19, 7),
    ("nursebot", {"rooms": "8", "bystanders": "9"}, 576 * 2**8 * 11**9, 19, 7),
]


@pytest.mark.parametrize(("name", "parameters", "states", "actions", "tasks"), SOUND)
def test_every_domain_is_sound_and_has_the_states_actions_and_tasks_it_says(
    name: str, parameters: Mapping[str, str], states: int, actions: int, tasks: int
) -> None:
    domain = library.load(name, parameters)
    assert domain.model.name == name
    assert domain.model.observability == "partial"
    assert domain.model.states == states
    assert len(domain.model.actions) == actions
    assert check(domain.model) == []
    assert domain.tasks is not None
    assert len(domain.tasks.tasks) == tasks
    assert check_tasks(domain.model, domain.tasks) == []
    # No action is lost: each is some task's.
    listed = {name for task in domain.tasks.tasks for name in task.actions}
    assert listed >= {action.name for action in domain.model.actions}
    # Compiling refuses rows that do not sum to 1.
    assert compile_model(domain.model).model == domain.model


@pytest.mark.parametrize(("name", "parameters"), [(n, p) for n, p, states, _, _ in SOUND if states < 1000])
def test_every_domain_is_read_back_from_its_own_text(name: str, parameters: Mapping[str, str]) -> None:
    domain = library.load(name, parameters)
    assert read_native(write_native(domain.model, domain.tasks)) == Document(domain.model, domain.tasks)


@cache
def enumerated(name: str, *parameters: tuple[str, str]) -> ExactPOMDP:
    return enumerate_pomdp(library.load(name, dict(parameters)).model)


def agrees(pomdp: ExactPOMDP, step: Step) -> None:
    """Each row and reward is what `step` says; exactly."""
    assert not any(pomdp.terminal)
    for s, state in enumerate(pomdp.state_values):
        for a, action in enumerate(pomdp.actions):
            joint, reward = step(state, action)
            found = {
                (pomdp.state_values[t], pomdp.observations[o]): q
                for (t, o), q in pomdp.kernel[a][s].items()
            }
            assert found == {key: q for key, q in joint.items() if q}, (state, action)
            assert pomdp.rewards[a][s] == reward, (state, action)


def hierarchy(name: str, **parameters: str) -> dict[str, tuple[str, ...]]:
    tasks = library.load(name, parameters).tasks
    assert tasks is not None
    return {task.name: task.actions for task in tasks.tasks}


def blocks(model: Model) -> int:
    return minimise(flat_process(compile_model(model))).partition.blocks


# --------------------------------------------------------------------------------------------
# Meds
# --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("accuracy", [F(8, 10), F(1), F(0)])
def test_the_meds_user_is_asked_and_served_as_described(accuracy: Fraction) -> None:
    wishes = {"meds": "CheckMeds", "kitchen": "GoToKitchen", "bedroom": "GoToBedroom"}

    def step(state: State, action: str) -> tuple[Joint, Fraction]:
        (wish,) = state
        if action == "ClarifyTask":
            words = {w: accuracy if w == wish else (1 - accuracy) / 4 for w in wishes}
            words["noise"] = (1 - accuracy) / 2
            return {(state, (word,)): q for word, q in words.items()}, F(-1)
        new = {((w,), ("noise",)): F(1, 3) for w in wishes}
        return new, F(10 if action == wishes[wish] else -50)

    pomdp = enumerated("meds", ("accuracy", str(accuracy)))
    assert pomdp.actions == ("ClarifyTask", "CheckMeds", "GoToKitchen", "GoToBedroom")
    assert pomdp.initial == (F(1, 3),) * 3
    agrees(pomdp, step)


def test_two_levels_of_meds_share_the_clarifying_action() -> None:
    assert hierarchy("meds") == {
        "Act": ("CheckMeds", "ClarifyTask", "Move"),
        "Move": ("ClarifyTask", "GoToKitchen", "GoToBedroom"),
    }


def test_move_has_nothing_better_than_to_ask_one_who_wants_his_medicine() -> None:
    # The talk's example of an abstract action.  Seen by Move, with W the mean of its values at the three
    # wishes: to serve is worth 10 + 0.95 W, to ask for ever -1 / 0.05 = -20, a wrong walk -50 + 0.95 W; so
    # W = (10 + 10 - 20) / 3 = 0 solves it, and asking is best where medicine is wanted.
    model = library.load("meds").model
    move = tuple(action for action in model.actions if action.name in hierarchy("meds")["Move"])
    pomdp = enumerate_pomdp(replace_fields(model, actions=move))
    values = [F(10) if wish != "meds" else F(-20) for (wish,) in pomdp.state_values]
    for s, (wish,) in enumerate(pomdp.state_values):
        worth = {
            action: pomdp.rewards[a][s]
            + F(95, 100) * sum(q * values[t] for (t, _), q in pomdp.kernel[a][s].items())
            for a, action in enumerate(pomdp.actions)
        }
        assert max(worth.values()) == values[s]
        assert (worth["ClarifyTask"] == values[s]) == (wish == "meds")


# --------------------------------------------------------------------------------------------
# Part-painting
# --------------------------------------------------------------------------------------------


def test_the_parts_are_painted_inspected_and_sent_as_in_the_source() -> None:
    # The states of paint.95 as (flawed, painted).
    names = {(0, 0): "NFL-NBL-NPA", (0, 1): "NFL-NBL-PA", (1, 1): "FL-NBL-PA", (1, 0): "FL-BL-NPA"}
    painting = {
        "NFL-NBL-NPA": {"NFL-NBL-NPA": F("0.1"), "NFL-NBL-PA": F("0.9")},
        "NFL-NBL-PA": {"NFL-NBL-PA": F(1)},
        "FL-NBL-PA": {"FL-NBL-PA": F(1)},
        "FL-BL-NPA": {"FL-NBL-PA": F("0.9"), "FL-BL-NPA": F("0.1")},
    }
    shipped = {"NFL-NBL-PA": 1, "NFL-NBL-NPA": -1, "FL-NBL-PA": -1, "FL-BL-NPA": -1}
    rejected = {"FL-BL-NPA": 1, "NFL-NBL-NPA": -1, "NFL-NBL-PA": -1, "FL-NBL-PA": 0}
    states = {name: state for state, name in names.items()}

    def step(state: State, action: str) -> tuple[Joint, Fraction]:
        name = names[state]
        if action == "inspect":
            blemished = F("0.75") if name == "FL-BL-NPA" else F("0.25")
            return {(state, ("BL",)): blemished, (state, ("NBL",)): 1 - blemished}, F(0)
        if action == "paint":
            return {(states[t], ("NBL",)): q for t, q in painting[name].items()}, F(0)
        new = {(states[t], ("NBL",)): F(1, 2) for t in ("NFL-NBL-NPA", "FL-BL-NPA")}
        return new, F((shipped if action == "ship" else rejected)[name])

    pomdp = enumerated("part_painting")
    assert set(pomdp.actions) == {"paint", "inspect", "ship", "reject"}
    assert dict(zip(pomdp.state_values, pomdp.initial, strict=True)) == {
        (False, False): F(1, 2), (True, False): F(1, 2), (False, True): 0, (True, True): 0,
    }  # fmt: skip
    agrees(pomdp, step)


def test_finishing_a_part_is_a_task_of_its_own() -> None:
    assert hierarchy("part_painting") == {
        "Work": ("inspect", "reject", "Finish"),
        "Finish": ("paint", "ship"),
    }


# --------------------------------------------------------------------------------------------
# Twenty questions
# --------------------------------------------------------------------------------------------

TRUTHS = {
    "polar_bear": "animal white large", "monkey": "animal brown", "robin": "animal red",
    "elephant": "animal large", "mushroom": "vegetable white", "potato": "vegetable brown hard",
    "tomato": "vegetable red", "pumpkin": "vegetable hard large", "marble": "mineral white hard",
    "amber": "mineral brown", "ruby": "mineral red hard", "granite": "mineral hard large",
}  # fmt: skip


def test_questions_are_answered_and_guesses_are_paid_as_described() -> None:
    def step(state: State, action: str) -> tuple[Joint, Fraction]:
        (thing,) = state
        verb, _, what = action.partition("_")
        if verb == "guess":
            new = {((other,), ("noise",)): F(1, 12) for other in TRUTHS}
            return new, F(20 if what == thing else -20)
        right, wrong = ("yes", "no") if what in TRUTHS[thing].split() else ("no", "yes")
        return {
            (state, (right,)): F(85, 100),
            (state, (wrong,)): F(5, 100),
            (state, ("noise",)): F(10, 100),
        }, F(-1)

    pomdp = enumerated("twenty_questions")
    assert {values[0] for values in pomdp.state_values} == set(TRUTHS)
    assert pomdp.initial == (F(1, 12),) * 12
    agrees(pomdp, step)


@pytest.mark.parametrize(("task", "kind"), [("Animals", "animal"), ("Vegetables", "vegetable"),
                                            ("Minerals", "mineral")])  # fmt: skip
def test_a_kind_of_objects_is_a_task_that_ignores_most_of_the_others(task: str, kind: str) -> None:
    own = [thing for thing, truths in TRUTHS.items() if kind in truths]
    questions = [f"ask_{asked}" for asked in ("white", "brown", "red", "hard", "large")]
    assert hierarchy("twenty_questions")[task] == (*questions, *(f"guess_{thing}" for thing in own))
    model = library.load("twenty_questions").model
    listed = hierarchy("twenty_questions")[task]
    actions = [action for action in model.actions if action.name in listed]
    others = {frozenset(truths.split()[1:]) for truths in TRUTHS.values() if kind not in truths}
    assert blocks(replace_fields(model, actions=tuple(actions))) == len(own) + len(others) == 11
    blind = tuple(Action(a.name, a.effects, rewards=a.rewards) for a in actions)
    assert blocks(replace_fields(model, actions=blind)) == len(own) + 1


# --------------------------------------------------------------------------------------------
# Cheese-taxi
# --------------------------------------------------------------------------------------------

MAZE = {"s0": (0, 0), "s1": (1, 0), "s2": (2, 0), "s3": (3, 0), "s4": (4, 0), "s5": (0, 1),
        "s6": (2, 1), "s7": (4, 1), "s8": (0, 2), "s9": (4, 2), "s10": (2, 2)}  # fmt: skip
ALIKE = [{"s0"}, {"s1", "s3"}, {"s2"}, {"s4"}, {"s5", "s6", "s7"}, {"s8", "s9"}, {"s10"}]
COMPASS = {"North": (0, -1), "South": (0, 1), "East": (1, 0), "West": (-1, 0)}


def test_the_cheese_taxi_drives_and_asks_as_described() -> None:
    places = {cell: name for name, cell in MAZE.items()}
    pomdp = enumerated("cheese_taxi")
    move = pomdp.actions.index("North")
    # Which reading belongs to which places is taken from the kernel, and must be those that look alike.
    readings: dict[str, set[str]] = {}
    for row in pomdp.kernel[move]:
        for t, o in row:
            readings.setdefault(str(pomdp.observations[o][0]), set()).add(str(pomdp.state_values[t][0]))
    sides = {"north_west", "north_south", "north", "north_east", "east_west", "east_south_west", "stop"}
    assert set(readings) <= sides

    def seen(place: Any) -> str:
        x, y = MAZE[place]
        closed = [side.lower() for side, (i, j) in COMPASS.items() if (x + i, y + j) not in places]
        return "stop" if place == "s10" else "_".join(closed)

    assert [{p for p in MAZE if seen(p) == reading} for reading in dict.fromkeys(map(seen, MAZE))] == ALIKE

    def step(state: State, action: str) -> tuple[Joint, Fraction]:
        place, goal = state
        silent = ("none", "none")
        if action in COMPASS:
            target = (MAZE[place][0] + COMPASS[action][0], MAZE[place][1] + COMPASS[action][1])
            after = places.get(target, place)
            return {((after, goal), (seen(after), "none")): F(1)}, F(-1)
        if action == "Query":
            return {(state, silent if goal == "s10" else ("none", goal)): F(1)}, F(-1)
        if action == "Pickup" and place == goal == "s10":
            return {((place, wish), silent): F(1, 2) for wish in ("s0", "s4")}, F(-1)
        if action == "Putdown" and goal != "s10" and place == goal:
            return {((anywhere, "s10"), silent): F(1, 11) for anywhere in MAZE}, F(20)
        return {(state, silent): F(1)}, F(-10)

    agrees(pomdp, step)
    assert len(pomdp.actions) == 7
    assert {o for rows in pomdp.kernel for row in rows for _, o in row} == set(range(10))
    begin = {s for s, q in zip(pomdp.state_values, pomdp.initial, strict=True) if q}
    assert begin == {(place, "s10") for place in MAZE}


def test_the_cheese_taxi_has_the_tasks_of_the_taxi() -> None:
    assert hierarchy("cheese_taxi") == {
        "Root": ("Get", "Put"),
        "Get": ("Pickup", "Navigate_s10"),
        "Put": ("Putdown", "Query", "Navigate_s0", "Navigate_s4"),
        **{f"Navigate_{place}": tuple(COMPASS) for place in ("s10", "s0", "s4")},
    }
    tasks = library.load("cheese_taxi").tasks
    assert tasks is not None
    for place, goal in product(MAZE, ("s10", "s0", "s4")):
        here = {("taxi", False): place, ("destination", False): goal}
        ended = {task.name for task in tasks.tasks if evaluate(task.terminal, here)}
        assert ended == {
            "Put" if goal == "s10" else "Get",
            *({f"Navigate_{place}"} if place in ("s0", "s4", "s10") else ()),
        }


# --------------------------------------------------------------------------------------------
# Network by segments
# --------------------------------------------------------------------------------------------


def test_a_cycle_and_legs_are_cut_into_segments() -> None:
    assert hierarchy("network", size="5", segment="2") == {
        "Administer": ("Segment_0", "Segment_1", "Segment_2"),
        "Segment_0": ("noop", "reboot_0", "reboot_1", "ping_0", "ping_1"),
        "Segment_1": ("noop", "reboot_2", "reboot_3", "ping_2", "ping_3"),
        "Segment_2": ("noop", "reboot_4", "ping_4"),
    }
    legs = hierarchy("network", size="10", topology="legs", segment="2")
    machines = [
        [int(a.split("_")[1]) for a in actions if a.startswith("ping")] for actions in legs.values()
    ]
    # The server; then 1 to 3, 4 to 6 and 7 to 9 hang on it one after the other.
    assert machines[1:] == [[0], [1, 2], [3], [4, 5], [6], [7, 8], [9]]


def test_a_segment_is_paid_for_its_own_machines_and_actions() -> None:
    tasks = library.load("network", {"size": "3", "segment": "2"}).tasks
    assert tasks is not None
    first, second = tasks.task("Segment_0"), tasks.task("Segment_1")
    up = {(f"up_{i}", False): True for i in range(3)}
    assert [evaluate(term, up) for term in first.pseudo_rewards] == [2, 1]
    assert [evaluate(term, up) for term in second.pseudo_rewards] == [1]
    costs = {name: evaluate(terms[0], up) for name, terms in first.pseudo_rewards_of}
    assert costs == {"reboot_0": F(-5, 2), "reboot_1": F(-5, 2), "ping_0": F(-1, 10), "ping_1": F(-1, 10)}
    assert not first.adds_reward


@pytest.mark.parametrize(("topology", "size", "segment", "expected"), [
    ("legs", 7, 2, [2, 8, 8, 8]), ("legs", 10, 3, [2, 16, 16, 16]), ("legs", 7, 1, [2, 4, 8, 4, 8, 4, 8]),
    ("cycle", 4, 2, [16, 16]),
])  # fmt: skip
def test_a_segment_needs_its_leg_and_the_server_but_all_of_a_cycle(
    topology: str, size: int, segment: int, expected: Sequence[int]
) -> None:
    domain = library.load("network", {"size": size, "topology": topology, "segment": segment})
    assert domain.tasks is not None
    found = []
    for task in domain.tasks.tasks[1:]:
        costs = dict(task.pseudo_rewards_of)
        actions = tuple(
            Action(a.name, a.effects, rewards=costs.get(a.name, ()), senses=a.senses)
            for a in domain.model.actions
            if a.name in task.actions
        )
        found.append(blocks(replace_fields(domain.model, actions=actions, rewards=task.pseudo_rewards)))
    assert found == expected


# --------------------------------------------------------------------------------------------
# Nursebot: the tasks
# --------------------------------------------------------------------------------------------

PLACES = ("home", "patient_room", "physio")
REMINDERS = {"RemindPhysioAppt": "physio", "RemindVitamin": "vitamin", "UpdateChecklist": "checklist"}
QUESTIONS = ("ConfirmDone", "VerifyInfoRequest", "ConfirmWantTime", "ConfirmWantWeather",
             "ConfirmGuideToPhysio", "CheckBattery", "CheckUserPresent")  # fmt: skip


def test_the_nursing_robot_has_the_tasks_of_the_paper() -> None:
    assert hierarchy("nursebot") == {
        "Act": ("Remind", "Assist", "Rest"),
        "Remind": ("RemindPhysioAppt", "RemindVitamin", "UpdateChecklist"),
        "Assist": ("Contact", "Move", "Inform"),
        "Contact": ("gotoPatientRoom", "RingBell"),
        "Move": ("GuideToPhysio", "CheckUserPresent", "TerminateGuidance", "ConfirmGuideToPhysio",
                 "CheckBattery"),
        "Inform": ("ConfirmDone", "VerifyInfoRequest", "ConfirmWantTime", "TellTime",
                   "ConfirmWantWeather", "TellWeather"),
        "Rest": ("DoNothing", "ConfirmDone", "GoHome", "RechargeBattery"),
    }  # fmt: skip
    tasks = library.load("nursebot").tasks
    assert tasks is not None
    calm = {("battery", False): "high"}
    assert not any(evaluate(task.terminal, calm) for task in tasks.tasks)
    assert not any(task.has_pseudo_reward for task in tasks.tasks)


def test_more_patients_and_topics_bring_their_own_actions() -> None:
    many = hierarchy("nursebot", patients="2", topics="3")
    assert many["Contact"] == ("gotoPatientRoom_1", "gotoPatientRoom_2", "RingBell")
    assert many["Inform"][-2:] == ("ConfirmWantTopic_3", "TellTopic_3")


# --------------------------------------------------------------------------------------------
# Nursebot: all rows and rewards, from the description
# --------------------------------------------------------------------------------------------

Chances = dict[Any, Fraction]
CHANNELS = {"Scheduler": 0, "Laser": 1, "Speech": 2, "Battery": 3, "IR": 4}


def sure(value: Any) -> Chances:
    return {value: F(1)}


def either(value: Any, chance: str, other: Any) -> Chances:
    return {value: F(chance), other: 1 - F(chance)}


class Nurse:
    """One step of the nursing robot from one state, as the description says."""

    def __init__(self, state: State, action: str) -> None:
        self.robot, self.person, attends, self.battery, self.motion, self.reminder, request = state
        self.action, self.state = action, state
        self.met = self.together(self.robot, self.person)
        self.attends = bool(attends) and self.met
        self.request = request if self.met else "none"
        self.open = self.reminder != "none" or self.motion != "none" or self.request != "none"
        ready = (self.robot, self.motion, self.battery) == ("patient_room", "physio", "high")
        self.guided = self.attends and ready
        self.reminded = self.attends and self.reminder == REMINDERS.get(action)

    @staticmethod
    def together(robot: str, person: str) -> bool:
        return (robot, person) in (("patient_room", "room"), ("physio", "physio"))

    def reward(self) -> int:
        action, heard = self.action, self.attends
        if action == "DoNothing":
            return -1
        if action == "gotoPatientRoom":
            return 5 if self.robot == "home" and self.open else -5 if self.robot == "patient_room" else -50
        if action == "RingBell":
            return 5 if self.met and not heard and self.open else -5
        if action in REMINDERS:
            return -5 if not heard else 50 if self.reminded else -50
        if action == "GuideToPhysio":
            return 50 if self.guided else -50
        if action == "CheckUserPresent":
            waits = (self.robot, self.person, self.motion) == ("physio", "room", "physio")
            return -1 if waits else -5
        if action == "TerminateGuidance":
            both = self.robot == self.person == "physio"
            return -5 if self.motion == "none" else 50 if both else -50
        if action in ("ConfirmGuideToPhysio", "CheckBattery"):
            return -5
        if action == "ConfirmDone":
            return -1 if heard else -5
        if action.startswith("Tell"):
            return -5 if not heard else 50 if action == f"Tell{self.request.capitalize()}" else -50
        if action == "GoHome":
            excused = self.robot == "patient_room" and self.battery == "low"
            return -5 if self.robot == "home" else 5 if not self.open else 0 if excused else -50
        if action == "RechargeBattery":
            return 20 if self.robot == "home" and self.battery == "low" else -5
        assert action in ("VerifyInfoRequest", "ConfirmWantTime", "ConfirmWantWeather")
        return -1 if heard and self.request != "none" else -5

    # What comes next, feature after feature; each by the next values of those before it.

    def robots(self) -> Chances:
        target = {"gotoPatientRoom": "patient_room", "GoHome": "home"}.get(self.action, self.robot)
        if self.action == "GuideToPhysio":
            return sure("physio" if self.guided else self.robot)
        return sure(self.robot) if target == self.robot else either(target, "0.9", self.robot)

    def batteries(self) -> Chances:
        trip = {"gotoPatientRoom": "patient_room", "GoHome": "home"}
        travels = (
            self.guided
            if self.action == "GuideToPhysio"
            else trip.get(self.action, self.robot) != self.robot
        )
        if self.action == "RechargeBattery" and self.robot == "home":
            return sure("high")
        return either("low", "0.2", "high") if travels and self.battery == "high" else sure(self.battery)

    def persons(self, robot: str) -> Chances:
        if self.action == "GuideToPhysio" and self.guided:
            return either("room", "0.4", "physio")
        if self.person == "room":
            waited = robot == "physio" and self.motion == "physio"
            return either("physio", "0.5", "room") if waited else sure("room")
        free = robot != "physio" and self.motion == "none"
        return either("room", "0.2", "physio") if free else sure("physio")

    def attention(self, met: bool) -> Chances:
        if not met:
            return sure(False)
        if self.attends:
            return either(False, "0.05", True)
        if self.met:
            return either(True, "0.8" if self.action == "RingBell" else "0.1", False)
        return either(True, "0.9" if (self.robot, self.person) == ("physio", "room") else "0.1", False)

    def motions(self, robot: str) -> Chances:
        if self.action == "TerminateGuidance":
            return sure("none")
        if self.action == "RemindPhysioAppt" and self.reminded and self.person == "room":
            return either("physio", "0.7", "none") if self.motion == "none" else sure("physio")
        if self.person == "physio" and robot != "physio" and self.motion == "physio":
            return either("none", "0.5", "physio")
        return sure(self.motion)

    def reminders(self) -> Chances:
        if self.reminded:
            return sure("none")
        quiet = (self.robot, self.person, self.motion) == ("home", "room", "none")
        if quiet and self.reminder == "none":
            return {"none": F("0.8"), "physio": F("0.1"), "vitamin": F("0.05"), "checklist": F("0.05")}
        return sure(self.reminder)

    def requests(self, met: bool) -> Chances:
        if not (met and self.met):
            return sure("none")
        if self.request == "none" and self.attends:
            return {"none": F("0.94"), "time": F("0.03"), "weather": F("0.03")}
        told = self.attends and self.action == f"Tell{self.request.capitalize()}"
        return sure("none" if told else self.request)

    def senses(self, after: State) -> dict[State, Fraction]:
        robot, person, attends, battery, motion, reminder, request = after
        found: tuple[str, Chances] | None = None
        if self.action == "DoNothing":
            others = [kind for kind in REMINDERS.values() if kind != reminder]
            heard = {reminder: F("0.94"), "none": F("0.04"), **dict.fromkeys(others, F("0.01"))}
            found = "Scheduler", sure("none") if reminder == "none" else heard
        elif self.action in ("gotoPatientRoom", "GoHome", "GuideToPhysio"):
            found = "Laser", {place: F("0.9") if place == robot else F("0.05") for place in PLACES}
        elif self.action == "CheckUserPresent":
            found = "IR", either("user", "0.85" if self.together(robot, person) else "0.15", "no_user")
        elif self.action == "CheckBattery":
            found = "Battery", either("high", "0.95" if battery == "high" else "0.05", "low")
        elif self.action != "RechargeBattery":
            found = "Speech", self.speech(attends, motion, request)
        silent = ["none"] * 5
        if found is None:
            return {tuple(silent): F(1)}
        channel, chances = found
        k = CHANNELS[channel]
        return {(*silent[:k], value, *silent[k + 1 :]): q for value, q in chances.items() if q}

    def speech(self, attends: bool, motion: str, request: str) -> Chances:
        if not attends:
            return {"noise": F("0.9"), "yes": F("0.05"), "no": F("0.05")}
        if self.action == "VerifyInfoRequest":
            if request == "none":
                return {"no": F("0.7"), "time": F("0.05"), "weather": F("0.05"), "noise": F("0.2")}
            other = {"time": "weather", "weather": "time"}[request]
            return {request: F("0.7"), other: F("0.1"), "noise": F("0.2")}
        truth = {
            "RingBell": True,
            "ConfirmDone": motion == request == "none",
            "ConfirmGuideToPhysio": motion == "physio",
            "ConfirmWantTime": request == "time",
            "ConfirmWantWeather": request == "weather",
        }.get(self.action)
        if truth is not None:
            right, wrong = ("yes", "no") if truth else ("no", "yes")
            return {right: F("0.7"), wrong: F("0.1"), "noise": F("0.2")}
        if request == "none":
            return {"time": F("0.025"), "weather": F("0.025"), "noise": F("0.95")}
        other = {"time": "weather", "weather": "time"}[request]
        return {request: F("0.5"), other: F("0.05"), "noise": F("0.45")}

    def step(self) -> tuple[Joint, Fraction]:
        joint: Joint = {}
        for (robot, q_robot), (battery, q_battery) in product(
            self.robots().items(), self.batteries().items()
        ):
            for person, q_person in self.persons(robot).items():
                met = self.together(robot, person)
                rest = (self.attention(met), self.motions(robot), self.reminders(), self.requests(met))
                for (attends, q1), (motion, q2), (reminder, q3), (request, q4) in product(
                    *(chances.items() for chances in rest)
                ):
                    after = (robot, person, attends, battery, motion, reminder, request)
                    chance = q_robot * q_battery * q_person * q1 * q2 * q3 * q4
                    for seen, q in self.senses(after).items():
                        joint[after, seen] = joint.get((after, seen), F(0)) + chance * q
        return joint, F(self.reward())


def test_the_nursing_robot_s_world_is_that_of_the_description() -> None:
    pomdp = enumerated("nursebot")
    assert pomdp.states == 576
    start = ("home", "room", False, "high", "none", "none", "none")
    assert [s for s, q in zip(pomdp.state_values, pomdp.initial, strict=True) if q] == [start]
    agrees(pomdp, lambda state, action: Nurse(state, action).step())


# --------------------------------------------------------------------------------------------
# Nursebot: Table 1 of the paper
# --------------------------------------------------------------------------------------------

# What was observed, the action, its reward, and a state in which it earns that: robot, person, attending,
# battery, motion, reminder, request.
WAITING = ("home", "room", False, "high", "none", "none", "none")
DUE = ("home", "room", False, "high", "none", "physio", "none")
ARRIVED = ("patient_room", "room", False, "high", "none", "physio", "none")
ATTENDED = ("patient_room", "room", True, "high", "none", "physio", "none")
WILLING = ("patient_room", "room", True, "high", "physio", "none", "none")
ALONE = ("physio", "room", False, "high", "physio", "none", "none")
JOINED = ("physio", "physio", True, "high", "physio", "none", "none")
CURIOUS = ("physio", "physio", True, "high", "none", "none", "weather")
DONE = ("physio", "physio", True, "high", "none", "none", "none")
BACK = ("home", "physio", False, "low", "none", "none", "none")
TABLE_1: list[tuple[str, str, int, State]] = [
    ("", "DoNothing", -1, WAITING),
    ("Scheduler=physio", "gotoPatientRoom", 5, DUE),
    ("Laser=patient_room", "RingBell", 5, ARRIVED),
    ("Speech=yes", "RemindPhysioAppt", 50, ATTENDED),
    ("Speech=noise", "ConfirmGuideToPhysio", -5, WILLING),
    ("Speech=yes", "CheckBattery", -5, WILLING),
    ("Battery=high", "GuideToPhysio", 50, WILLING),
    ("Laser=physio", "CheckUserPresent", -1, ALONE),
    ("IR=no_user", "CheckUserPresent", -1, ALONE),
    ("IR=user", "CheckUserPresent", -5, JOINED),
    ("IR=user", "TerminateGuidance", 50, JOINED),
    ("Speech=noise", "ConfirmDone", -1, CURIOUS),
    ("Speech=no", "VerifyInfoRequest", -1, CURIOUS),
    ("Speech=weather", "ConfirmWantWeather", -1, CURIOUS),
    ("Speech=noise", "VerifyInfoRequest", -1, CURIOUS),
    ("Speech=weather", "ConfirmWantWeather", -1, CURIOUS),
    ("Speech=yes", "TellWeather", 50, CURIOUS),
    ("Speech=noise", "ConfirmDone", -1, DONE),
    ("Speech=yes", "GoHome", 5, DONE),
    ("Laser=home", "RechargeBattery", 20, BACK),
]


def reading(text: str) -> State:
    channel, _, value = text.partition("=")
    return tuple(value if channel == name else "none" for name in CHANNELS)


def test_the_dialogue_of_table_1_can_happen_and_earns_what_it_says() -> None:
    pomdp = enumerated("nursebot")
    for number, (_, action, reward, state) in enumerate(TABLE_1):
        a, s = pomdp.actions.index(action), pomdp.state_values.index(state)
        assert pomdp.rewards[a][s] == reward, number
        if number + 1 < len(TABLE_1):
            seen, _, _, after = TABLE_1[number + 1]
            o = pomdp.observations.index(reading(seen))
            assert pomdp.kernel[a][s].get((pomdp.state_values.index(after), o), 0) > 0, number


def test_the_fifteen_actions_of_table_1_are_there_with_four_siblings() -> None:
    names = {action.name for action in library.load("nursebot").model.actions}
    shown = {action for _, action, _, _ in TABLE_1}
    assert len(shown) == 15
    assert names - shown == {"RemindVitamin", "UpdateChecklist", "ConfirmWantTime", "TellTime"}


def test_questions_only_cost_one_who_sees_everything() -> None:
    # They do to the state what DoNothing does, and bring no more.
    pomdp = enumerated("nursebot")
    wait = pomdp.actions.index("DoNothing")

    def goes(a: int, s: int) -> dict[int, Fraction]:
        row: dict[int, Fraction] = {}
        for (t, _), q in pomdp.kernel[a][s].items():
            row[t] = row.get(t, F(0)) + q
        return row

    for question in QUESTIONS:
        a = pomdp.actions.index(question)
        for s in range(pomdp.states):
            assert goes(a, s) == goes(wait, s)
            assert pomdp.rewards[a][s] <= pomdp.rewards[wait][s] == -1


# --------------------------------------------------------------------------------------------
# Nursebot: single rows of its larger kin
# --------------------------------------------------------------------------------------------

CALM = {
    "patient": "patient_2", "robot_location": "home", "person_location": "room", "attending": False,
    "battery": "high", "motion_goal": "none", "reminder_goal": "none", "user_goal": "none",
    "bystander_0": "home", "door_of_room_0": False,
}  # fmt: skip
LARGE = {"patients": "2", "topics": "3", "rooms": "1", "bystanders": "1"}


def large_row(action: str, feature: str, sensed: bool = False, **changes: Any) -> dict[Any, Fraction]:
    """P(feature' | CALM with `changes`); names that end in `_next` are values afterwards."""
    model = library.load("nursebot", LARGE).model
    here = {(name, False): changes.get(name, value) for name, value in CALM.items()}
    here |= {(name[:-5], True): value for name, value in changes.items() if name.endswith("_next")}
    if sensed:
        values = next(channel.values for channel in model.observations if channel.name == feature)
        row = distribution(dict(model.action(action).senses)[feature], values, here)
    else:
        values = model.feature(feature).values
        row = distribution(dict(model.action(action).effects)[feature], values, here)
    assert isinstance(row, tuple)
    return {value: q for value, q in zip(values, row, strict=True) if q}


@pytest.mark.parametrize(
    ("action", "feature", "changes", "expected"),
    [
        ("gotoPatientRoom_2", "robot_location", {}, {"patient_room_2": "0.9", "home": "0.1"}),
        ("gotoPatientRoom_1", "battery", {}, {"low": "0.2", "high": "0.8"}),
        # A new reminder is for anybody; the one who is served stays otherwise.
        ("DoNothing", "patient", {"reminder_goal_next": "none"}, {"patient_2": 1}),
        (
            "DoNothing",
            "patient",
            {"reminder_goal_next": "vitamin"},
            {"patient_1": "1/2", "patient_2": "1/2"},
        ),
        (
            "DoNothing",
            "patient",
            {"reminder_goal": "vitamin", "reminder_goal_next": "vitamin"},
            {"patient_2": 1},
        ),
        # The bell is heard in the right room only.
        (
            "RingBell",
            "attending",
            {
                "robot_location": "patient_room_2",
                "person_location_next": "room",
                "patient_next": "patient_2",
            },
            {True: "0.8", False: "0.2"},
        ),
        (
            "RingBell",
            "attending",
            {
                "robot_location": "patient_room_1",
                "person_location_next": "room",
                "patient_next": "patient_2",
            },
            {False: 1},
        ),
        (
            "TellTopic_3",
            "user_goal",
            {
                "robot_location": "patient_room_2",
                "attending": True,
                "user_goal": "topic_3",
                "person_location_next": "room",
                "patient_next": "patient_2",
            },
            {"none": 1},
        ),
        ("DoNothing", "door_of_room_0", {}, {False: "0.9", True: "0.1"}),
        # Five places: home, two rooms of patients, physiotherapy and one more.
        (
            "DoNothing",
            "bystander_0",
            {},
            {
                "home": "3/4",
                **dict.fromkeys(["patient_room_1", "patient_room_2", "physio", "room_0"], "1/16"),
            },
        ),
        (
            "DoNothing",
            "bystander_0",
            {"robot_location": "physio"},
            {
                "home": "1/2",
                **dict.fromkeys(["patient_room_1", "patient_room_2", "physio", "room_0"], "1/8"),
            },
        ),
        (
            "DoNothing",
            "bystander_0",
            {"bystander_0": "room_0"},
            {
                "room_0": "1/2",
                **dict.fromkeys(["home", "patient_room_1", "patient_room_2", "physio"], "1/8"),
            },
        ),
    ],
)
def test_the_larger_ward_changes_as_described(
    action: str, feature: str, changes: Mapping[str, Any], expected: Mapping[Any, Any]
) -> None:
    assert large_row(action, feature, **changes) == {value: F(q) for value, q in expected.items()}


@pytest.mark.parametrize(
    ("action", "channel", "changes", "expected"),
    [
        (
            "DoNothing",
            "Scheduler",
            {"reminder_goal_next": "vitamin", "patient_next": "patient_1"},
            {"vitamin_1": "0.94", "none": "0.04", "physio_1": "0.01", "checklist_1": "0.01"},
        ),
        (
            "DoNothing",
            "Scheduler",
            {"reminder_goal_next": "none", "patient_next": "patient_1"},
            {"none": 1},
        ),
        (
            "GoHome",
            "Laser",
            {"robot_location_next": "patient_room_1"},
            {"patient_room_1": "0.9", "home": "1/30", "patient_room_2": "1/30", "physio": "1/30"},
        ),
        (
            "VerifyInfoRequest",
            "Speech",
            {"attending_next": True, "user_goal_next": "topic_3"},
            {"topic_3": "0.7", "time": "0.05", "weather": "0.05", "noise": "0.2"},
        ),
        (
            "TellTime",
            "Speech",
            {"attending_next": True, "user_goal_next": "none"},
            {"noise": "0.95", **dict.fromkeys(["time", "weather", "topic_3"], "1/60")},
        ),
    ],
)
def test_the_larger_ward_is_sensed_as_described(
    action: str, channel: str, changes: Mapping[str, Any], expected: Mapping[Any, Any]
) -> None:
    assert large_row(action, channel, True, **changes) == {value: F(q) for value, q in expected.items()}


# --------------------------------------------------------------------------------------------
# Nursebot: blocks
# --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("patients", "topics", "rooms", "bystanders"),
    [(1, 2, 0, 0), (1, 2, 3, 0), (1, 2, 0, 2), (1, 2, 9, 8), (1, 5, 2, 1), (2, 2, 0, 0), (3, 2, 1, 1)],
)
def test_the_blocks_grow_with_patients_and_topics_and_not_with_rooms_and_bystanders(
    patients: int, topics: int, rooms: int, bystanders: int
) -> None:
    # Battery 2, motion 2, reminder 4.  Together, in two ways, also attention 2 and the topics and none;
    # apart, in the 2 (patients + 2) - 2 other ways, attention and requests are void.  So for each patient.
    expected = patients * (2 * 16 * 2 * (topics + 1) + (2 * patients + 2) * 16)
    parameters = {"patients": patients, "topics": topics, "rooms": rooms, "bystanders": bystanders}
    assert blocks(library.load("nursebot", parameters).model) == expected


@pytest.mark.parametrize(
    ("parameters", "parents"),
    [({"rooms": "9", "bystanders": "6"}, 6), ({"patients": "6", "topics": "8"}, 8)],
)
def test_a_big_ward_stays_factored(parameters: Mapping[str, str], parents: int) -> None:
    model = library.load("nursebot", parameters).model
    expressions = []
    for action in model.actions:
        expressions += [*action.rewards, *(e for _, e in action.effects), *(e for _, e in action.senses)]
    assert max(len(references(e)) for e in expressions) <= parents


# --------------------------------------------------------------------------------------------
# Nursebot: perturbation
# --------------------------------------------------------------------------------------------


def test_a_perturbation_changes_each_reward_by_at_most_its_share_and_no_block() -> None:
    plain = library.load("nursebot").model
    shaken = library.load("nursebot", {"perturbation": "0.2", "seed": "5"}).model
    ratios = set()
    names = [feature.name for feature in plain.features]
    for values in product(*(feature.values for feature in plain.features)):
        here = {(name, False): value for name, value in zip(names, values, strict=True)}
        for before, after in zip(plain.actions, shaken.actions, strict=True):
            old, new = evaluate(before.rewards[0], here), evaluate(after.rewards[0], here)
            assert isinstance(old, Fraction)
            assert isinstance(new, Fraction)
            assert abs(new - old) <= abs(old) / 5
            ratios.add(new / old if old else F(1))
    # Each of the seven rewards has a factor of its own; 1 stands for the excused way home.
    assert len(ratios) == 8
    assert blocks(shaken) == blocks(plain)


def test_a_perturbation_is_drawn_by_its_seed() -> None:
    def of(**parameters: str) -> Model:
        return library.load("nursebot", parameters).model

    assert of(seed="4") == of()
    assert of(perturbation="0.2", seed="4") == of(perturbation="1/5", seed="4")
    assert of(perturbation="0.2", seed="4") != of(perturbation="0.2", seed="5")


# --------------------------------------------------------------------------------------------
# Parameters
# --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "parameters", "said"),
    [
        ("meds", {"accuracy": "1.1"}, ["accuracy is", "from 0 to 1"]),
        ("meds", {"discount": "2"}, ["discount is", "from 0 to 1"]),
        ("meds", {"size": "2"}, ["no parameter 'size'", "accuracy, discount"]),
        ("part_painting", {"discount": "-1"}, ["discount is", "from 0 to 1"]),
        ("twenty_questions", {"accuracy": "often"}, ["'often'", "number"]),
        ("cheese_taxi", {"discount": "3"}, ["discount is", "from 0 to 1"]),
        ("network", {"segment": "5"}, ["segment is 5", "from 0 to 4"]),
        ("network", {"segment": "-1"}, ["segment is -1"]),
        ("nursebot", {"rooms": "-1"}, ["rooms is -1", "from 0"]),
        ("nursebot", {"bystanders": "1000"}, ["bystanders is 1000", "to 100"]),
        ("nursebot", {"patients": "0"}, ["patients is 0", "from 1"]),
        ("nursebot", {"topics": "1"}, ["topics is 1", "from 2"]),
        ("nursebot", {"topics": "many"}, ["'many'", "integer"]),
        ("nursebot", {"perturbation": "0.6"}, ["perturbation is", "from 0 to 1/2"]),
        ("nursebot", {"seed": "-3"}, ["seed is -3", "from 0"]),
        ("nursebot", {"discount": "1.5"}, ["discount is", "from 0 to 1"]),
    ],
)
def test_a_bad_parameter_is_refused_with_what_is_allowed(
    name: str, parameters: Mapping[str, object], said: Sequence[str]
) -> None:
    with pytest.raises(ModelError) as caught:
        library.load(name, parameters)
    for part in said:
        assert part in str(caught.value)


@pytest.mark.parametrize("name", ["nursebot", "meds", "part_painting", "twenty_questions", "cheese_taxi"])
def test_discount_one_is_refused_by_the_check(name: str) -> None:
    faults = check(library.load(name, {"discount": "1"}).model)
    assert ["discount 1" in fault.message for fault in faults] == [True]

"""A robot in a nursing home reminds, guides and informs people whom it understands badly.

After J. Pineau, G. Gordon and S. Thrun, "Policy-contingent abstraction for robust robot control" (2003),
sections 2 and 5.  Their model was made by hand and never published: this is a reconstruction.

From the paper: the seven features and the 576 states; the fifteen actions of Table 1 and their rewards
there, given below without a star; the five channels and the readings of Table 1; noisy sensors, speech
above all; "large positive rewards for correctly delivering information or satisfying motion goals, large
negative rewards for incorrect motion or reminder actions, and small negative rewards for clarification".
Reconstructed: the four actions that the fifteen leave out (RemindVitamin, UpdateChecklist, ConfirmWantTime,
TellTime), the values of the features, which task holds which action (the figure is lost), when each reward
is due, every reward with a star, all probabilities, the discount 0.95, and the start: robot at home, person
in the room and not attending, battery high, no goal.  Tasks need no pseudo-reward (the paper's footnote 2);
none ends, since an end would have to be seen.

    robot_location   home, patient_room, physio      motion_goal     none, physio
    person_location  room, physio                    reminder_goal   none, physio, vitamin, checklist
    attending        false, true                     user_goal       none, time, weather
    battery          high, low

Robot and person are *together* in the patient's room or in physiotherapy; the person *hears* the robot when
together and attending.  Attention and requests are void when apart.  Something is *open*: a reminder,
guidance or, when together, a request.  Rewards, by the first rule that fits:

    DoNothing               -1
    gotoPatientRoom         at home with something open +5; in the room already -5*; else -50*
    RingBell                together, the person not attending, something open +5; else -5*
    RemindPhysioAppt, RemindVitamin, UpdateChecklist
                            unheard -5*; this reminder due +50; else -50*
    GuideToPhysio           from the room, heard, guidance wanted, battery high +50; else -50*
    CheckUserPresent        waiting in physiotherapy for the person being guided -1; else -5
    TerminateGuidance       no guidance -5*; both in physiotherapy +50; else -50*
    ConfirmGuideToPhysio, CheckBattery
                            -5
    ConfirmDone             heard -1; else -5*
    VerifyInfoRequest, ConfirmWantTime, ConfirmWantWeather
                            heard with a request -1; else -5*
    TellTime, TellWeather   unheard -5*; this was asked +50; else -50*
    GoHome                  at home -5*; nothing open +5; in the room with battery low 0*; else -50*
    RechargeBattery         away -5*; battery low +20; else -5*

A step that is of use in passing costs 1 and a needless one 5, the two costs of Table 1; there
CheckUserPresent costs 1 twice, before the person has come, and then 5.  What is wrong costs as much as what
is right brings.  Trips without a reason are wrong, so that it does not pay to go in circles.

Chances, one a step where not said otherwise; what an action does not name goes on as it does by itself:

    0.1  a trip to the room or home finds the way blocked       0.2  a trip takes a high battery to low
    0.4  the guided person falls behind                         0.5  and catches up, once the robot waits
    0.9  who catches up attends                                 0.8  who hears the bell attends
    0.05 attention is lost                                      0.1  attention is found without the bell
    0.7  a person told of physiotherapy wants guidance          0.06 who hears the robot asks for something
    0.2  a reminder falls due: 1/2 physio, 1/4 each other       0.2  the person comes back after a session
    0.5  guidance is over that the robot left in physiotherapy

Old people walk slowly and their thoughts wander, but they follow a bell; five trips use up a battery.
Reminders fall due only while the robot is at home, the person in the room and no guidance open, so that one
visit is one dialogue.  Requests are for each topic alike and lapse at parting.  A reminder or guidance that
does not fit changes nothing; TerminateGuidance ends guidance, rightly or not.  Sensed after the action:

    Scheduler  by DoNothing: the reminder due 0.94, missed 0.04, another one 0.02; none if none is due
    Laser      by gotoPatientRoom, GoHome, GuideToPhysio: the robot's place 0.9, another 0.1
    IR         by CheckUserPresent: whether together 0.85          Battery  by CheckBattery 0.95
    Speech     by all that is said.  From who does not attend: noise 0.9, else yes or no.  Who attends
               answers with yes or no rightly 0.7, wrongly 0.1, noise 0.2 (RingBell: yes; ConfirmDone:
               neither a request nor guidance is open); VerifyInfoRequest with his topic, or no, 0.7,
               another topic 0.1, noise 0.2; after a statement (a reminder, TerminateGuidance, Tell) his
               topic is heard 0.5, another 0.05, else noise.

A program rarely errs, range sensors now and then, and a third of the answers of old people are lost on the
recogniser: after one answer a wrong step is likely enough to ask again, after two it is not.

    Act = {Remind, Assist, Rest}            Assist = {Contact, Move, Inform}
    Remind = {RemindPhysioAppt, RemindVitamin, UpdateChecklist}
    Contact = {gotoPatientRoom, RingBell}   Rest = {DoNothing, ConfirmDone, GoHome, RechargeBattery}
    Move = {GuideToPhysio, CheckUserPresent, TerminateGuidance, ConfirmGuideToPhysio, CheckBattery}
    Inform = {ConfirmDone, VerifyInfoRequest, ConfirmWantX and TellX for each topic X}

The two levels that may end a dialogue share ConfirmDone.  All was fixed before planners were compared but
for four things, changed then: wrong reminders and motions had cost 100 (PolCA earned less than QMDP);
ConfirmDone had not asked about guidance, and Rest had lacked it (PolCA+ waited for ever, unsure); and a low
battery had excused going home from anywhere (it paid to leave the person on the way).

The flat quotient has m (64 (k + 1) + 32 (m + 1)) blocks for k topics and m patients, 256 for the paper's
576 states.  Who sees everything earns 167.3, discounted; the optimum of the POMDP is between 96 and 126.

`topics`: further ones are topic_3, topic_4, ...  `patients` m > 1: rooms patient_room_1, ..., an action
gotoPatientRoom_i each, and a feature `patient`, the one served, drawn anew with each reminder, whom the
scheduler names (physio_2); the rest is said of him.  `rooms`: as many more, whose doors (open or shut)
change with chance 1/10; `bystanders`: as many people who wander through all places, moving on with chance
1/2, or 1/4 where they can watch the robot.  Neither is seen or matters: the blocks stay as they are.
`perturbation` q multiplies each reward and chance above by a factor from 1 - q to 1 + q drawn with `seed`
(of several outcomes the less likely ones), to see what hangs on the numbers.
"""

from __future__ import annotations

import random
from collections.abc import Mapping
from dataclasses import dataclass, fields
from fractions import Fraction
from functools import cached_property
from typing import Annotated

from factored_polca.library import Number, discount_factor, integer, number
from factored_polca.models import (
    FALSE,
    TRUE,
    Action,
    Constant,
    Expression,
    Feature,
    Model,
    ModelError,
    Observation,
    Reference,
    Switch,
    Task,
    TaskHierarchy,
    boolean,
    conditional,
    disjunction,
    lottery,
    uniform,
)

Rooms = Annotated[int, "further rooms with doors, which matter to nothing; each doubles the states"]
Bystanders = Annotated[int, "people who wander about and matter to nothing"]
Patients = Annotated[int, "persons with a room each, one of whom is served at a time"]
Topics = Annotated[int, "what a person may ask for, from 2 on: time, weather, topic_3, ..."]
Perturbation = Annotated[Number, "largest relative change of each number, from 0 to 1/2"]
Seed = Annotated[int, "where the changes of the numbers are drawn"]
Discount = Annotated[Number, "discount, from 0 to 1"]

Sensed = Mapping[Observation, Expression]

_REMINDERS = {"RemindPhysioAppt": "physio", "RemindVitamin": "vitamin", "UpdateChecklist": "checklist"}
_NONE, _PHYSIO = Constant("none"), Constant("physio")


@dataclass(frozen=True)
class _Numbers:
    """The numbers of the module's docstring: rewards, then chances, of a pair the less likely one."""

    goal: Fraction = Fraction(50)
    wrong: Fraction = Fraction(-50)
    approach: Fraction = Fraction(5)
    recharge: Fraction = Fraction(20)
    wait: Fraction = Fraction(-1)
    useful: Fraction = Fraction(-1)
    needless: Fraction = Fraction(-5)

    blocked: Fraction = Fraction("0.1")
    drained: Fraction = Fraction("0.2")
    behind: Fraction = Fraction("0.4")
    catches_up: Fraction = Fraction("0.5")
    comes_absent: Fraction = Fraction("0.1")
    bell_ignored: Fraction = Fraction("0.2")
    lost: Fraction = Fraction("0.05")
    found: Fraction = Fraction("0.1")
    declines: Fraction = Fraction("0.3")
    asks: Fraction = Fraction("0.06")
    due: Fraction = Fraction("0.2")
    comes_back: Fraction = Fraction("0.2")
    lapses: Fraction = Fraction("0.5")

    missed: Fraction = Fraction("0.04")
    mixed: Fraction = Fraction("0.02")
    laser_error: Fraction = Fraction("0.1")
    infrared_error: Fraction = Fraction("0.15")
    battery_error: Fraction = Fraction("0.05")
    unheard_word: Fraction = Fraction("0.1")
    answer_wrong: Fraction = Fraction("0.1")
    answer_noise: Fraction = Fraction("0.2")
    uttered: Fraction = Fraction("0.5")
    misheard: Fraction = Fraction("0.05")

    def perturbed(self, most: Fraction, seed: int) -> _Numbers:
        """Each number times a factor of its own, from 1 - most to 1 + most in steps of most/1000."""
        draw = random.Random(seed).random  # the one method whose sequence Python promises to keep
        factors = {f.name: 1 + most * Fraction(int(draw() * 2001) - 1000, 1000) for f in fields(self)}
        return _Numbers(**{name: getattr(self, name) * factor for name, factor in factors.items()})


def model(
    *,
    rooms: Rooms = 0,
    bystanders: Bystanders = 0,
    patients: Patients = 1,
    topics: Topics = 2,
    perturbation: Perturbation = 0,
    seed: Seed = 0,
    discount: Discount = Fraction(95, 100),
) -> Model:
    """The POMDP: 576 states, 19 actions; for one patient times 2^rooms (3 + rooms)^bystanders.

    Raises:
        ModelError: a parameter out of its range.
    """
    most = number("perturbation", perturbation)
    if not 0 <= most <= Fraction(1, 2):
        raise ModelError(f"perturbation is {perturbation}: it must be from 0 to 1/2")
    numbers = _Numbers().perturbed(most, integer("seed", seed, 0, 2**31))
    ward = _Ward(_names(patients, topics), rooms, bystanders, numbers)
    return Model(
        "nursebot",
        ward.features,
        [*_rest(ward), *_contact(ward), *_remind(ward), *_move(ward), *_inform(ward)],
        initial=ward.initial(),
        discount=discount_factor(discount),
        observability="partial",
        observations=[ward.scheduler, ward.laser, ward.speech, ward.charge, ward.infrared],
        description="A nursing robot reminds, guides and informs people whom it understands badly.",
    )


def tasks(
    *,
    rooms: Rooms = 0,
    bystanders: Bystanders = 0,
    patients: Patients = 1,
    topics: Topics = 2,
    perturbation: Perturbation = 0,
    seed: Seed = 0,
    discount: Discount = Fraction(95, 100),
) -> TaskHierarchy:
    """Act{Remind, Assist{Contact, Move, Inform}, Rest}.

    Raises:
        ModelError: `patients` or `topics` out of its range; the other parameters change nothing here.
    """
    names = _names(patients, topics)
    asked = [action for topic in names.topics for action in _topic_actions(topic)]
    guide = ["GuideToPhysio", "CheckUserPresent", "TerminateGuidance", "ConfirmGuideToPhysio"]
    return TaskHierarchy(
        [
            Task("Act", ["Remind", "Assist", "Rest"]),
            Task("Remind", _REMINDERS),
            Task("Assist", ["Contact", "Move", "Inform"]),
            Task("Contact", [*names.visits, "RingBell"]),
            Task("Move", [*guide, "CheckBattery"]),
            Task("Inform", ["ConfirmDone", "VerifyInfoRequest", *asked]),
            Task("Rest", ["DoNothing", "ConfirmDone", "GoHome", "RechargeBattery"]),
        ]
    )


@dataclass(frozen=True)
class _Names:
    """What the parameters say how many of there are; the first three are by patient."""

    patients: tuple[str, ...]
    rooms: tuple[str, ...]
    visits: tuple[str, ...]
    topics: tuple[str, ...]


def _names(patients: int, topics: int) -> _Names:
    m, k = integer("patients", patients, 1, 50), integer("topics", topics, 2, 50)
    ends = [""] if m == 1 else [f"_{i}" for i in range(1, m + 1)]
    return _Names(
        patients=tuple(f"patient{end}" for end in ends),
        rooms=tuple(f"patient_room{end}" for end in ends),
        visits=tuple(f"gotoPatientRoom{end}" for end in ends),
        topics=("time", "weather", *(f"topic_{i}" for i in range(3, k + 1))),
    )


def _topic_actions(topic: str) -> tuple[str, str]:
    return f"ConfirmWant{topic.capitalize()}", f"Tell{topic.capitalize()}"


def _either(value: str | bool, chance: Fraction, otherwise: str | bool) -> Expression:
    return lottery([(Constant(value), chance), (Constant(otherwise), 1 - chance)])


def _mostly(value: str, chance: Fraction, others: list[str]) -> dict[str, Fraction]:
    """`value`, but with `chance` one of the others, all alike."""
    return {value: 1 - chance, **dict.fromkeys(others, chance / len(others))}


class _Ward:
    """Features and channels, what holds of a state, and what goes on by itself."""

    def __init__(self, names: _Names, rooms: int, bystanders: int, numbers: _Numbers) -> None:
        self.names, self.numbers, self.many = names, numbers, len(names.patients) > 1
        extra = [f"room_{i}" for i in range(integer("rooms", rooms, 0, 100))]
        self.places = ["home", *names.rooms, "physio"]
        self.robot = Feature("robot_location", self.places)
        self.person = Feature("person_location", ["room", "physio"])
        self.attending = boolean("attending")
        self.battery = Feature("battery", ["high", "low"])
        self.motion = Feature("motion_goal", ["none", "physio"])
        self.reminder = Feature("reminder_goal", ["none", *_REMINDERS.values()])
        self.user = Feature("user_goal", ["none", *names.topics])
        self.patient = Feature("patient", names.patients)
        self.doors = [boolean(f"door_of_{room}") for room in extra]
        walkers = range(integer("bystanders", bystanders, 0, 100))
        self.walkers = [Feature(f"bystander_{i}", [*self.places, *extra]) for i in walkers]

        # What the scheduler says of (patient, reminder).
        self.words = {
            (who, kind): kind + who.removeprefix("patient")
            for who in names.patients
            for kind in _REMINDERS.values()
        }
        self.scheduler = Observation("Scheduler", ["none", *self.words.values()])
        self.laser = Observation("Laser", ["none", *self.places])
        self.speech = Observation("Speech", ["none", "yes", "no", *names.topics, "noise"])
        self.charge = Observation("Battery", ["none", "high", "low"])
        self.infrared = Observation("IR", ["none", "user", "no_user"])

    @property
    def features(self) -> list[Feature]:
        who = [self.patient] if self.many else []
        here = [*who, self.robot, self.person, self.attending, self.battery]
        return [*here, self.motion, self.reminder, self.user, *self.doors, *self.walkers]

    def initial(self) -> dict[Feature, Expression]:
        drawn = [self.patient, *self.doors, *self.walkers] if self.many else [*self.doors, *self.walkers]
        return {
            self.robot: Constant("home"),
            self.person: Constant("room"),
            self.attending: FALSE,
            self.battery: Constant("high"),
            **dict.fromkeys((self.motion, self.reminder, self.user), _NONE),
            **{other: uniform(other) for other in drawn},
        }

    # What holds of a state ------------------------------------------------------------------

    def meet(self, robot: Reference, person: Reference, patient: Reference) -> Expression:
        """Robot and person are together."""
        rooms = zip(self.names.patients, self.names.rooms, strict=True)
        cases = tuple((who, robot.is_(room)) for who, room in rooms)
        in_room = Switch(patient, cases) if self.many else cases[0][1]
        return conditional(person.is_("room"), in_room, robot.is_("physio"))

    @cached_property
    def together(self) -> Expression:
        return self.meet(self.robot.now, self.person.now, self.patient.now)

    @cached_property
    def heard(self) -> Expression:
        return self.attending.now & self.together

    @cached_property
    def asked(self) -> Expression:
        return self.together & ~self.user.is_("none")

    @cached_property
    def open(self) -> Expression:
        return disjunction([~self.reminder.is_("none"), ~self.motion.is_("none"), self.asked])

    @cached_property
    def guides(self) -> Expression:
        """GuideToPhysio is right."""
        ready = self.person.is_("room") & self.motion.is_("physio") & self.battery.is_("high")
        return ready & self.heard

    @cached_property
    def aside(self) -> dict[Feature, Expression]:
        """Doors and bystanders."""
        doors = {door: conditional(door, *map(_flip, (True, False))) for door in self.doors}
        return {**doors, **{one: self.wandered(one) for one in self.walkers}}

    # What an action does, and what goes on by itself ----------------------------------------

    def action(
        self,
        name: str,
        rewards: Expression | Fraction,
        senses: Sensed | None = None,
        changes: Mapping[Feature, Expression] | None = None,
        *,
        bell: bool = False,
        told: str | None = None,
    ) -> Action:
        """An action with `changes` beside what goes on by itself."""
        changes = changes or {}
        robot = self.robot.next if self.robot in changes else self.robot.now
        meets = self.meet(robot, self.person.next, self.patient.next if self.many else self.patient.now)
        effects: dict[Feature, Expression] = {
            self.person: self.person_next(robot),
            self.attending: self.attending_next(meets, bell),
            self.motion: self.motion_next(robot),
            self.reminder: self.reminder_next(),
            self.user: self.user_next(meets, told),
            **self.aside,
            **changes,
        }
        if self.many:
            new = self.reminder.is_("none") & ~self.reminder.next.is_("none")
            effects[self.patient] = conditional(new, uniform(self.patient), self.patient)
        return Action(name, effects, rewards=rewards, senses=senses or {})

    def trip(self, place: str) -> dict[Feature, Expression]:
        """Robot and battery after a trip to `place`."""
        there, n = self.robot.is_(place), self.numbers
        way = lottery([(Constant(place), 1 - n.blocked), (self.robot, n.blocked)])
        used = conditional(self.battery.is_("high"), _either("low", n.drained, "high"), self.battery)
        return {
            self.robot: conditional(there, self.robot, way),
            self.battery: conditional(there, self.battery, used),
        }

    def person_next(self, robot: Reference) -> Expression:
        n = self.numbers
        follows = robot.is_("physio") & self.motion.is_("physio")
        leaves = ~robot.is_("physio") & self.motion.is_("none")
        return conditional(
            self.person.is_("room"),
            conditional(follows, _either("physio", n.catches_up, "room"), self.person),
            conditional(leaves, _either("room", n.comes_back, "physio"), self.person),
        )

    def attending_next(self, meets: Expression, bell: bool) -> Expression:
        n = self.numbers
        found = _either(True, n.found, False)
        kept = conditional(
            self.attending,
            _either(False, n.lost, True),
            _either(False, n.bell_ignored, True) if bell else found,
        )
        caught_up = self.robot.is_("physio") & self.person.is_("room")
        joined = conditional(caught_up, _either(False, n.comes_absent, True), found)
        return conditional(meets, conditional(self.together, kept, joined), FALSE)

    def motion_next(self, robot: Reference) -> Expression:
        left = self.person.is_("physio") & ~robot.is_("physio") & self.motion.is_("physio")
        return conditional(left, _either("none", self.numbers.lapses, "physio"), self.motion)

    def reminder_next(self) -> Expression:
        due = self.numbers.due
        quiet = self.robot.is_("home") & self.person.is_("room") & self.motion.is_("none")
        news = {"none": 1 - due, "physio": due / 2, "vitamin": due / 4, "checklist": due / 4}
        return conditional(quiet & self.reminder.is_("none"), lottery(news), self.reminder)

    def user_next(self, meets: Expression, told: str | None) -> Expression:
        wish = lottery(_mostly("none", self.numbers.asks, list(self.names.topics)))
        kept = conditional(self.user.is_("none") & self.attending, wish, self.user)
        if told is not None:
            kept = conditional(self.user.is_(told) & self.attending, _NONE, kept)
        return conditional(meets & self.together, kept, _NONE)

    def wandered(self, one: Feature) -> Expression:
        cases = []
        for place in map(str, one.values):
            others = [str(other) for other in one.values if other != place]
            on, watching = (lottery(_mostly(place, Fraction(1, q), others)) for q in (2, 4))
            seen = place in self.places
            cases.append((place, conditional(self.robot.is_(place), watching, on) if seen else on))
        return Switch(one.now, tuple(cases))

    # What is sensed -------------------------------------------------------------------------

    def said(self, attended: Expression) -> Sensed:
        """Speech of a person who attends, or not."""
        noise = lottery(_mostly("noise", self.numbers.unheard_word, ["yes", "no"]))
        return {self.speech: conditional(self.attending.next, attended, noise)}

    def answer(self, yes: Expression) -> Sensed:
        """The answer to a question with yes or no."""
        wrong, noise = self.numbers.answer_wrong, self.numbers.answer_noise

        def row(right: str, other: str) -> Expression:
            return lottery({right: 1 - wrong - noise, other: wrong, "noise": noise})

        return self.said(conditional(yes, row("yes", "no"), row("no", "yes")))

    def by_topic(self, silent: Mapping[str, Fraction], right: Fraction, wrong: Fraction) -> Sensed:
        """The user's topic `right`, another one `wrong`, else noise; without a topic `silent` too."""
        cases = []
        for topic in map(str, self.user.values):
            others = [other for other in self.names.topics if other != topic]
            clear = silent if topic == "none" else {topic: right}
            noise = 1 - wrong - sum(clear.values(), Fraction(0))
            cases.append((topic, lottery({**_mostly("noise", wrong, others), **clear, "noise": noise})))
        return self.said(Switch(self.user.next, tuple(cases)))

    def topic_named(self) -> Sensed:
        """The answer to VerifyInfoRequest."""
        wrong, right = self.numbers.answer_wrong, 1 - self.numbers.answer_wrong - self.numbers.answer_noise
        return self.by_topic({"no": right}, right, wrong)

    def topic_uttered(self) -> Sensed:
        """What is said after a statement."""
        return self.by_topic({}, self.numbers.uttered, self.numbers.misheard)

    def located(self) -> Sensed:
        cases = []
        for place in self.places:
            others = [other for other in self.places if other != place]
            cases.append((place, lottery(_mostly(place, self.numbers.laser_error, others))))
        return {self.laser: Switch(self.robot.next, tuple(cases))}

    def message(self) -> Sensed:
        n = self.numbers

        def row(who: str, kind: str) -> Expression:
            others = [self.words[who, other] for other in _REMINDERS.values() if other != kind]
            chances = _mostly(self.words[who, kind], n.mixed, others)
            return lottery({**chances, self.words[who, kind]: 1 - n.missed - n.mixed, "none": n.missed})

        def of(kind: str) -> Expression:
            rows = tuple((who, row(who, kind)) for who in self.names.patients)
            return Switch(self.patient.next, rows) if self.many else rows[0][1]

        kinds = tuple((kind, of(kind)) for kind in _REMINDERS.values())
        return {self.scheduler: Switch(self.reminder.next, kinds, _NONE)}


def _flip(now: bool) -> Expression:
    return _either(not now, Fraction(1, 10), now)


# --------------------------------------------------------------------------------------------
# The actions, by task
# --------------------------------------------------------------------------------------------


def _rest(ward: _Ward) -> list[Action]:
    n, home, low = ward.numbers, ward.robot.is_("home"), ward.battery.is_("low")
    excused = low & ward.robot.is_in(ward.names.rooms)
    leave = conditional(~ward.open, n.approach, conditional(excused, 0, n.wrong))
    charged = {ward.battery: conditional(home, Constant("high"), ward.battery)}
    return [
        ward.action("DoNothing", n.wait, ward.message()),
        ward.action("GoHome", conditional(home, n.needless, leave), ward.located(), ward.trip("home")),
        ward.action("RechargeBattery", conditional(home & low, n.recharge, n.needless), None, charged),
    ]


def _contact(ward: _Ward) -> list[Action]:
    n, visits = ward.numbers, []
    for visit, room, who in zip(ward.names.visits, ward.names.rooms, ward.names.patients, strict=True):
        due = ward.robot.is_("home") & ward.open
        due = due & ward.patient.is_(who) if ward.many else due
        otherwise = conditional(ward.robot.is_(room), n.needless, n.wrong)
        reward = conditional(due, n.approach, otherwise)
        visits.append(ward.action(visit, reward, ward.located(), ward.trip(room)))
    rung = ward.together & ~ward.attending.now & ward.open
    reward = conditional(rung, n.approach, n.needless)
    return [*visits, ward.action("RingBell", reward, ward.answer(TRUE), bell=True)]


def _remind(ward: _Ward) -> list[Action]:
    n, found = ward.numbers, []
    for name, kind in _REMINDERS.items():
        given = ward.heard & ward.reminder.is_(kind)
        changes = {ward.reminder: conditional(given, _NONE, ward.reminder_next())}
        if kind == "physio":
            wants = conditional(ward.motion.is_("none"), _either("none", n.declines, "physio"), _PHYSIO)
            stays = ward.motion_next(ward.robot.now)
            changes[ward.motion] = conditional(given & ward.person.is_("room"), wants, stays)
        said = conditional(ward.reminder.is_(kind), n.goal, n.wrong)
        reward = conditional(ward.heard, said, n.needless)
        found.append(ward.action(name, reward, ward.topic_uttered(), changes))
    return found


def _move(ward: _Ward) -> list[Action]:
    n, here = ward.numbers, ward.robot.is_("physio")
    guided = {
        ward.robot: conditional(ward.guides, _PHYSIO, ward.robot),
        ward.battery: conditional(ward.guides, _either("low", n.drained, "high"), ward.battery),
        ward.person: conditional(
            ward.guides, _either("room", n.behind, "physio"), ward.person_next(ward.robot.next)
        ),
    }
    waits = here & ward.person.is_("room") & ward.motion.is_("physio")
    arrived = conditional(here & ward.person.is_("physio"), n.goal, n.wrong)
    ended = conditional(ward.motion.is_("none"), n.needless, arrived)
    present = conditional(
        ward.meet(ward.robot.next, ward.person.next, ward.patient.next),
        _either("no_user", n.infrared_error, "user"),
        _either("user", n.infrared_error, "no_user"),
    )
    charge = conditional(
        ward.battery.next.is_("high"),
        _either("low", n.battery_error, "high"),
        _either("high", n.battery_error, "low"),
    )
    wanted = ward.answer(ward.motion.next.is_("physio"))
    found = conditional(waits, n.useful, n.needless)
    return [
        ward.action("GuideToPhysio", conditional(ward.guides, n.goal, n.wrong), ward.located(), guided),
        ward.action("CheckUserPresent", found, {ward.infrared: present}),
        ward.action("TerminateGuidance", ended, ward.topic_uttered(), {ward.motion: _NONE}),
        ward.action("ConfirmGuideToPhysio", n.needless, wanted),
        ward.action("CheckBattery", n.needless, {ward.charge: charge}),
    ]


def _inform(ward: _Ward) -> list[Action]:
    n = ward.numbers
    done = ward.answer(ward.user.next.is_("none") & ward.motion.next.is_("none"))
    inquiry = conditional(ward.attending & ward.asked, n.useful, n.needless)
    found = [
        ward.action("ConfirmDone", conditional(ward.heard, n.useful, n.needless), done),
        ward.action("VerifyInfoRequest", inquiry, ward.topic_named()),
    ]
    for topic in ward.names.topics:
        confirm, tell = _topic_actions(topic)
        told = conditional(ward.user.is_(topic), n.goal, n.wrong)
        reward = conditional(ward.heard, told, n.needless)
        found += [
            ward.action(confirm, inquiry, ward.answer(ward.user.next.is_(topic))),
            ward.action(tell, reward, ward.topic_uttered(), told=topic),
        ]
    return found

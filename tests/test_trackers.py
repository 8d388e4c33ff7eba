"""Trackers of beliefs against Bayes' rule on the enumerated model, closed forms, and their errors.

The oracle is `enumerate_pomdp`: b' is proportional to b K_a(.; ., o), restricted to the states that look
like the true one and have ended, or not, as it has.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from random_pomdps import random_pomdp

from factored_polca.control import (
    Belief,
    BlockBelief,
    BlockTracker,
    Depleted,
    DiagramBelief,
    DiagramTracker,
    ImpossibleObservation,
    ParticleBelief,
    ParticleTracker,
    Tracker,
    choose_tracker,
    independent_belief,
    make_block_tracker,
)
from factored_polca.control.block_walk import make_walk
from factored_polca.control.particle_tracker import random_history, systematic
from factored_polca.diagrams import Diagram, choose, evaluate_states, support
from factored_polca.explicit.exact_pomdp import ExactPOMDP, enumerate_pomdp
from factored_polca.minimisation import Partition, flat_process, minimise, partition_from
from factored_polca.models import Action, Feature, Model, ModelError, Observation, Value, boolean
from factored_polca.symbolic import SymbolicModel, compile_model, reachable_states

SEEDS = range(200)
ROUNDING = 1e-12  # sums and products of up to 64 floats, a dozen steps

# -- the oracle ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Moment:
    """What came in (action -1: at the start), and the exact belief [s] and likelihood after it."""

    action: int
    observation: Mapping[str, Value]
    ended: bool
    belief: np.ndarray
    likelihood: float


@dataclass(frozen=True)
class Case:
    """A model, its oracle, and the states of the oracle as value numbers [s, feature]."""

    symbolic: SymbolicModel
    exact: ExactPOMDP
    digits: np.ndarray
    kernel: np.ndarray  # [a, o, s, t]

    def labels(self, diagram: Diagram) -> np.ndarray:
        """The value of an index diagram at each state of the oracle."""
        return evaluate_states(diagram, self.digits, self.symbolic.columns()).astype(np.int64)

    def summed(self, diagram: Diagram, belief: np.ndarray, count: int) -> np.ndarray:
        return np.bincount(self.labels(diagram), belief, minlength=count)[:count]


@cache
def case(seed: int) -> Case:
    model = random_pomdp(seed, max_states=(24, 64)[seed % 2])
    order = [feature.name for feature in model.features]
    random.Random(seed).shuffle(order)
    symbolic, exact = compile_model(model, order=order), enumerate_pomdp(model)
    digits = [[f.index(v) for f, v in zip(model.features, s, strict=True)] for s in exact.state_values]
    kernel = np.zeros((len(exact.actions), len(exact.observations), exact.states, exact.states))
    for a, rows in enumerate(exact.kernel):
        for s, row in enumerate(rows):
            for (t, o), chance in row.items():
                kernel[a, o, s, t] = float(chance)
    return Case(symbolic, exact, np.array(digits, dtype=np.int32), kernel)


@cache
def episode(seed: int, number: int = 0, steps: int = 8) -> tuple[Moment, ...]:
    """A run of random actions: the oracle draws states and observations, and tracks the belief."""
    it, generator = case(seed), np.random.default_rng((seed, number))
    exact, model = it.exact, it.symbolic.model
    terminal, observed = np.array(exact.terminal), np.array(exact.observed)
    belief = np.array([float(q) for q in exact.initial])
    state = int(generator.choice(exact.states, p=belief))
    moments: list[Moment] = []
    action, seen = -1, dict[str, Value]()
    while True:
        belief = np.where((observed == observed[state]) & (terminal == terminal[state]), belief, 0)
        likelihood = float(belief.sum())
        belief = belief / likelihood
        values = zip(model.features, exact.state_values[state], strict=True)
        seen |= {feature.name: value for feature, value in values if feature.observed}
        moments.append(Moment(action, seen, bool(terminal[state]), belief, likelihood))
        if terminal[state] or len(moments) > steps:
            return tuple(moments)
        action = int(generator.integers(len(exact.actions)))
        outcomes = list(exact.kernel[action][state])
        chances = [float(exact.kernel[action][state][outcome]) for outcome in outcomes]
        state, o = outcomes[int(generator.choice(len(outcomes), p=chances))]
        belief = belief @ it.kernel[action, o]
        told = zip(model.observations, exact.observations[o], strict=True)
        sensed = {name for name, _ in model.actions[action].senses}
        seen = {
            c.name: value for c, value in told if c.name in sensed or number % 2
        }  # none may be left out


def follow(tracker: Tracker, moments: tuple[Moment, ...], check: Callable[[Belief, Moment], None]) -> None:
    """Track a run and check the belief at each moment."""
    first, *rest = moments
    belief = tracker.start(first.observation, ended=first.ended)
    check(belief, first)
    for moment in rest:
        belief = belief.after(moment.action, moment.observation, ended=moment.ended)
        check(belief, moment)


# -- exact trackers --------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", SEEDS)
def test_beliefs_over_blocks_are_the_full_beliefs_summed(seed: int) -> None:
    it = case(seed)
    tracker = make_block_tracker(it.symbolic, seed=seed)
    blocks = tracker.partition.blocks

    def check(belief: Belief, moment: Moment) -> None:
        assert isinstance(belief, BlockBelief)
        found = np.zeros(blocks)
        found[belief.blocks] = belief.weights
        expected = it.summed(tracker.partition.diagram, moment.belief, blocks)
        assert np.abs(found - expected).max() < ROUNDING
        assert belief.likelihood == pytest.approx(moment.likelihood, abs=ROUNDING)
        best = belief.most_likely()
        digits = [f.index(best[f.name]) for f in it.symbolic.model.features]
        state = int(np.flatnonzero((it.digits == digits).all(axis=1))[0])
        assert expected[it.labels(tracker.partition.diagram)[state]] >= expected.max() - ROUNDING

    for number in range(2):
        follow(tracker, episode(seed, number), check)


@pytest.mark.parametrize("seed", SEEDS)
def test_beliefs_as_diagrams_are_the_full_beliefs_in_each_state(seed: int) -> None:
    it = case(seed)
    features = it.symbolic.model.features

    def check(belief: Belief, moment: Moment) -> None:
        assert isinstance(belief, DiagramBelief)
        assert np.abs(belief.at(it.digits) - moment.belief).max() < ROUNDING
        assert belief.likelihood == pytest.approx(moment.likelihood, abs=ROUNDING)
        found = belief.marginals()
        for number, feature in enumerate(features):
            expected = np.bincount(it.digits[:, number], moment.belief, minlength=len(feature.values))
            assert np.abs(found[feature.name] - expected).max() < ROUNDING
        best = belief.most_likely()
        digits = [f.index(best[f.name]) for f in features]
        state = int(np.flatnonzero((it.digits == digits).all(axis=1))[0])
        assert moment.belief[state] >= moment.belief.max() - ROUNDING

    follow(DiagramTracker(it.symbolic), episode(seed, seed % 2), check)


def test_rows_that_are_made_in_pieces_and_forgotten_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, entries in (("CELLS", 8), ("ENTRIES", 16), ("REMEMBERED", 20)):
        monkeypatch.setattr(f"factored_polca.control.block_tracker.{name}", entries)
    for seed in range(1, 40, 4):
        it = case(seed)
        tracker = make_block_tracker(it.symbolic, seed=seed)

        def check(belief: Belief, moment: Moment, it: Case = it, tracker: BlockTracker = tracker) -> None:
            expected = it.summed(tracker.partition.diagram, moment.belief, tracker.partition.blocks)
            assert np.abs(belief.project(tracker.partition) - expected).max() < ROUNDING

        for number in (0, 1, 0):
            follow(tracker, episode(seed, number), check)


def coarser(seed: int, number: int) -> tuple[Partition, Diagram]:
    """A partition that is stable for some of the actions, and a condition that it tells apart."""
    symbolic = case(seed).symbolic
    drawn = random.Random(f"{seed} {number}")
    names = [action.name for action in symbolic.actions]
    chosen = drawn.sample(names, drawn.randint(1, len(names)))
    i = drawn.randrange(len(symbolic.model.features))
    values = range(len(symbolic.model.features[i].values))
    condition = symbolic.manager.indicator(symbolic.now(i), drawn.sample(values, 1))
    process = flat_process(symbolic, [name for name in names if name in chosen])
    return minimise(process, seed=seed, separate=[condition]).partition, condition


@pytest.mark.parametrize("seed", SEEDS)
def test_one_belief_projects_onto_the_partitions_of_all_subtasks(seed: int) -> None:
    it = case(seed)
    (one, first), (two, second) = coarser(seed, 1), coarser(seed, 2)
    shown = it.symbolic.model.features[seed % len(it.symbolic.model.features)]
    place = it.symbolic.model.features.index(shown)

    def check(belief: Belief, moment: Moment) -> None:
        for partition in (one, two):
            expected = it.summed(partition.diagram, moment.belief, partition.blocks)
            assert np.abs(belief.project(partition) - expected).max() < ROUNDING
        for condition in (first, second, first & ~second, it.symbolic.terminal):
            holds = it.labels(condition) == 1
            assert belief.probability(condition) == pytest.approx(moment.belief[holds].sum(), abs=ROUNDING)
            assert belief.support_in(condition) == (not moment.belief[~holds].any())
        expected = np.bincount(it.digits[:, place], moment.belief, minlength=len(shown.values))
        assert np.abs(belief.marginals()[shown.name] - expected).max() < ROUNDING

    blocks = make_block_tracker(it.symbolic, [one, two], features=[shown.name], seed=seed)
    follow(blocks, episode(seed), check)
    if seed % 3 == 0:
        follow(DiagramTracker(it.symbolic), episode(seed), check)


def test_the_random_runs_meet_what_trackers_must_master() -> None:
    met = dict.fromkeys(
        ("merged", "ended", "seen", "unsensed", "blind", "synchronic", "several", "guessed", "carried"), 0
    )
    for seed in SEEDS:
        it = case(seed)
        symbolic, model = it.symbolic, it.symbolic.model
        tracker = make_block_tracker(symbolic, seed=seed)
        met["merged"] += tracker.partition.blocks < it.exact.states
        met["ended"] += any(episode(seed, n)[-1].ended and len(episode(seed, n)) > 1 for n in range(2))
        met["seen"] += any(feature.observed for feature in model.features)
        met["unsensed"] += any(len(a.observations) < len(model.observations) for a in symbolic.actions)
        met["blind"] += any(not a.observations for a in symbolic.actions)
        met["synchronic"] += any(action.synchronic for action in symbolic.actions)
        for number, action in enumerate(symbolic.actions):
            walk = tracker.walk(number)
            met["guessed"] += len(walk.roots) > 1
            met["carried"] += any(parents for _, parents in walk.draws)
            for row in action.observations.values():
                met["several"] += len([level for level in support(row.diagram) if level % 2]) > 1
    assert all(count >= 10 for count in met.values()), met


def test_a_tracker_of_reachable_states_tracks_the_same_beliefs() -> None:
    left_out = 0
    for seed in range(0, 110, 4):
        it = case(seed)
        reachable = reachable_states(it.symbolic, backend="kernel").diagram
        tracker = make_block_tracker(it.symbolic, reachable=reachable, seed=seed)
        left_out += tracker.partition.has_outside

        def check(belief: Belief, moment: Moment, it: Case = it, tracker: BlockTracker = tracker) -> None:
            assert isinstance(belief, BlockBelief)
            expected = it.summed(tracker.partition.diagram, moment.belief, tracker.partition.blocks)
            assert np.abs(belief.project(tracker.partition) - expected).max() < ROUNDING

        follow(tracker, episode(seed), check)
        if tracker.partition.has_outside:
            uniform = {f.name: {v: f"1/{len(f)}" for v in f.values} for f in it.symbolic.model.features}
            first = episode(seed)[0]
            initial = independent_belief(it.symbolic, uniform)
            with pytest.raises(ModelError, match="left out as unreachable"):
                tracker.start(first.observation, ended=first.ended, initial=initial)
    assert left_out >= 3


# -- closed forms ----------------------------------------------------------------------------------


def tiger(terminal: bool = False) -> Model:
    """Kaelbling, Littman & Cassandra (1998): the tiger is heard on its side with probability 0.85."""
    side = Feature("tiger", ["left", "right"])
    heard = "{left: 0.85, right: 0.15} if tiger' == left else {left: 0.15, right: 0.85}"
    features = [side, boolean("open")]
    opened = "true" if terminal else "false"
    return Model(
        "tiger",
        features,
        [
            Action("listen", senses={"sound": heard}),
            Action("open", {side: "{left: 1/2, right: 1/2}", features[1]: opened}),
        ],
        terminal="open",
        initial={"open": "false"},
        observability="partial",
        observations=[Observation("sound", ["left", "right", "none"])],
    )


def trackers(model: Model, on_impossible: str = "error") -> list[Tracker]:
    symbolic = compile_model(model)
    names = [feature.name for feature in model.features]
    return [
        make_block_tracker(symbolic, features=names, on_impossible=on_impossible),  # type: ignore[arg-type]
        DiagramTracker(symbolic, on_impossible=on_impossible),  # type: ignore[arg-type]
        ParticleTracker(symbolic, 4000, seed=1, on_impossible=on_impossible),  # type: ignore[arg-type]
    ]


def test_two_sounds_from_the_left_make_the_tiger_97_percent_left() -> None:
    expected = 0.85**2 / (0.85**2 + 0.15**2)
    for tracker in trackers(tiger()):
        belief = tracker.start()
        for _ in range(2):
            belief = belief.after(0, {"sound": "left"})
        tolerance = 1e-12 if tracker.guarantee == "exact" else 0.02  # 5 standard errors of 4000 draws
        assert belief.marginals()["tiger"][0] == pytest.approx(expected, abs=tolerance)
        assert belief.most_likely()["tiger"] == "left"
        belief = belief.after(1, {})
        assert belief.marginals()["tiger"][0] == pytest.approx(1 / 2, abs=tolerance + 1e-9)


def noisy_bits(count: int) -> Model:
    """Bits that flip each in its own way, each with a sensor of its own; `look` changes nothing."""
    bits = [boolean(f"x{i}") for i in range(count)]
    senses = {f"o{i}": f"{{0: 0.8, 1: 0.2}} if x{i}' else {{0: 0.3, 1: 0.7}}" for i in range(count)}
    stay = [f"{{true: {i + 1}/{2 * count}, false: {2 * count - i - 1}/{2 * count}}}" for i in range(count)]
    flips = {bit: f"{{true: 0.9, false: 0.1}} if {bit.name} else {stay[i]}" for i, bit in enumerate(bits)}
    actions = [Action("wait", flips, senses=senses), Action("look", senses=senses)]
    channels = [Observation(f"o{i}", [0, 1]) for i in range(count)]
    return Model("bits", bits, actions, observability="partial", observations=channels)


def test_forty_independent_bits_are_tracked_exactly_as_factors() -> None:
    symbolic = compile_model(noisy_bits(40))
    generator = np.random.default_rng(3)
    belief: Belief = DiagramTracker(symbolic).start()
    true = np.full(40, 0.5)
    stay = (np.arange(40) + 1) / 80
    for _ in range(12):
        action, seen = int(generator.integers(2)), generator.integers(2, size=40)
        belief = belief.after(action, {f"o{i}": int(v) for i, v in enumerate(seen)})
        if action == 0:
            true = true * 0.9 + (1 - true) * stay
        if_true, if_false = np.where(seen == 0, 0.8, 0.2), np.where(seen == 0, 0.3, 0.7)
        mass = true * if_true + (1 - true) * if_false
        true = true * if_true / mass
        assert belief.likelihood == pytest.approx(float(np.prod(mass)), rel=1e-10)
    found = belief.marginals()
    assert [found[f"x{i}"][1] for i in range(40)] == pytest.approx(list(true), abs=ROUNDING)
    assert belief.most_likely() == {f"x{i}": bool(true[i] > 0.5) for i in range(40)}
    both = symbolic.manager.indicator(symbolic.now(3), [1]) & symbolic.manager.indicator(
        symbolic.now(30), [1]
    )
    assert belief.probability(both) == pytest.approx(true[3] * true[30], abs=ROUNDING)


def test_what_the_partition_merges_is_not_enumerated() -> None:
    hidden = Feature("h", ["a", "b", "c"])
    others = [boolean(f"z{i}") for i in range(60)]
    chances = np.array([[(i + 1) / 32, (i + 5) / 40, 1 / 3] for i in range(30)])
    senses = {
        f"o{i}": f"switch(h', a: {{1: {i + 1}/32, 0: {31 - i}/32}}, "
        f"b: {{1: {i + 5}/40, 0: {35 - i}/40}}, c: {{1: 1/3, 0: 2/3}})"
        for i in range(30)
    }
    moves = "switch(h, a: {a: 0.9, b: 0.1}, b: {b: 0.8, c: 0.2}, c: {c: 0.7, a: 0.3})"
    stay = {hidden: moves, **dict.fromkeys(others, "{true: 1/2, false: 1/2}")}
    channels = [Observation(f"o{i}", [0, 1]) for i in range(30)]
    go = Action("stay", stay, senses=senses)
    model = Model("noisy", [hidden, *others], [go], observability="partial", observations=channels)
    tracker = make_block_tracker(compile_model(model), features=["h"])
    assert tracker.partition.blocks == 3
    matrix = np.array([[0.9, 0.1, 0], [0, 0.8, 0.2], [0.3, 0, 0.7]])
    expected, belief = np.full(3, 1 / 3), tracker.start()
    generator = np.random.default_rng(2)
    for _ in range(5):
        seen = generator.integers(2, size=30)
        expected = (expected @ matrix) * np.where(seen[:, None] == 1, chances, 1 - chances).prod(axis=0)
        expected = expected / expected.sum()
        belief = belief.after(0, {f"o{i}": int(v) for i, v in enumerate(seen)})
        assert belief.marginals()["h"] == pytest.approx(expected, abs=ROUNDING)
        assert set(belief.marginals()) == {"h"}  # the blocks do not tell of the other features


def test_a_blind_model_is_tracked_without_observations() -> None:
    bit = boolean("x")
    move = Action("move", {bit: "{true: 0.9, false: 0.1} if x else {true: 0.2, false: 0.8}"})
    for tracker in trackers(Model("blind", [bit], [move], initial={"x": "true"}, observability="partial")):
        belief = tracker.start().after(0, {}).after(0, {})
        tolerance = 1e-12 if tracker.guarantee == "exact" else 0.03
        assert belief.marginals()["x"][1] == pytest.approx(0.9 * 0.9 + 0.1 * 0.2, abs=tolerance)
        assert belief.likelihood == pytest.approx(1)


# -- what is seen, and the end ---------------------------------------------------------------------


def corridor() -> Model:
    """The robot sees where it is, but not its battery; the last cell ends the episode."""
    place = Feature("place", range(4), observed=True)
    low = boolean("low")
    step = "min(place + 1, 3) if not low else {place: 0.6, min(place + 1, 3): 0.4}"
    go = Action("go", {place: step, low: "{true: 0.3, false: 0.7} if not low else true"})
    return Model(
        "corridor",
        [place, low],
        [go, Action("wait", senses={"lamp": "on if low' else {on: 0.1, off: 0.9}"})],
        terminal="place == 3",
        initial={"place": "{0: 1/2, 1: 1/2}", "low": "{true: 1/5, false: 4/5}"},
        observability="partial",
        observations=[Observation("lamp", ["on", "off", "none"])],
    )


def test_what_is_seen_of_the_state_narrows_the_belief_at_the_start_and_later() -> None:
    for tracker in trackers(corridor()):
        tolerance = 1e-12 if tracker.guarantee == "exact" else 0.04
        belief = tracker.start({"place": 0})
        assert belief.likelihood == pytest.approx(1 / 2)
        assert belief.marginals()["low"][1] == pytest.approx(1 / 5, abs=tolerance)
        belief = belief.after(0, {"place": 0})  # only a low battery keeps it in place
        assert belief.likelihood == pytest.approx(0.2 * 0.6, abs=tolerance)
        assert belief.marginals()["low"][1] == pytest.approx(1)
        assert belief.most_likely() == {"place": 0, "low": True}


def test_an_episode_that_has_ended_is_a_belief_over_terminal_states_that_no_action_follows() -> None:
    for tracker in trackers(corridor()):
        belief = tracker.start({"place": 1}).after(0, {"place": 2}).after(0, {"place": 3}, ended=True)
        assert belief.ended
        assert belief.support_in(tracker.symbolic.terminal)
        with pytest.raises(ModelError, match="the episode has ended: no action follows"):
            belief.after(0, {"place": 3})


def test_that_the_episode_goes_on_tells_too() -> None:
    model = tiger(terminal=True)
    listen, opening = model.actions
    slow = Action("open", {"tiger": "tiger", "open": "{true: 0.9, false: 0.1} if tiger == left else true"})
    model = Model(
        "door", model.features, [listen, slow], terminal="open", initial=model.initial,
        observability="partial", observations=model.observations,
    )  # fmt: skip
    assert opening.name == slow.name
    for tracker in trackers(model):
        belief = tracker.start().after(1, {})
        assert belief.marginals()["tiger"].tolist() == pytest.approx([1, 0])
        assert belief.likelihood == pytest.approx(0.05, abs=0.02 if tracker.kind == "particles" else 1e-12)


# -- impossible observations and wrong input -------------------------------------------------------


def test_an_impossible_observation_is_an_error_that_names_it() -> None:
    for tracker in trackers(corridor()):
        belief = tracker.start({"place": 0})
        with pytest.raises(
            ImpossibleObservation,
            match="seeing place=2, the episode going on, is impossible after action 'go'",
        ):
            belief.after(0, {"place": 2})
        sure = belief.after(0, {"place": 0})
        with pytest.raises(ImpossibleObservation, match="observation 'lamp=off', seeing place=0"):
            sure.after(1, {"place": 0, "lamp": "off"})
        with pytest.raises(ImpossibleObservation, match="observation 'lamp=on', seeing place=1"):
            belief.after(1, {"place": 1, "lamp": "on"})  # waiting leaves it in place
        with pytest.raises(ImpossibleObservation, match="the episode having ended"):
            belief.after(0, {"place": 0}, ended=True)
        with pytest.raises(ImpossibleObservation, match="at the start seeing place=2"):
            tracker.start({"place": 2})
        with pytest.raises(ImpossibleObservation, match="does not sense lamp, which then reports none"):
            belief.after(0, {"place": 0, "lamp": "on"})
        assert belief.after(0, {"place": 0, "lamp": "none"}).likelihood > 0


def test_a_tracker_may_be_told_to_reset_instead() -> None:
    for tracker in trackers(corridor(), "reset"):
        tolerance = 1e-12 if tracker.guarantee == "exact" else 0.04
        sure = tracker.start({"place": 0}).after(0, {"place": 0})
        again = sure.after(1, {"place": 0, "lamp": "off"})
        assert again.was_reset
        assert again.likelihood == 0
        assert again.marginals()["low"][1] == pytest.approx(1 / 5, abs=tolerance)  # as in b0
        jumped = sure.after(1, {"place": 2, "lamp": "off"})  # b0 does not allow that place
        assert jumped.marginals()["place"][2] == pytest.approx(1)
        assert jumped.marginals()["low"][1] == pytest.approx(1 / 2, abs=tolerance)
        assert not jumped.after(0, {"place": 2}).was_reset


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        ({}, "after action 'wait' a value is needed for lamp, place"),
        ({"lamp": "on"}, "a value is needed for place"),
        ({"lamp": "red", "place": 0}, "lamp has no value red; it has on, off, none"),
        ({"lamp": "on", "place": True}, "place has no value true; it has 0, 1, 2, 3"),
        ({"lamp": "on", "place": 0, "low": True}, "'low' is not observed here; what is: lamp, place"),
    ],
)
def test_wrong_observations_are_refused(observation: dict[str, Value], message: str) -> None:
    for tracker in trackers(corridor()):
        with pytest.raises(ModelError, match=message):
            tracker.start({"place": 0}).after(1, observation)
        with pytest.raises(ModelError, match="no action number 2; there are 0 go, 1 wait"):
            tracker.start({"place": 0}).after(2, {"place": 0})
        with pytest.raises(ModelError, match="at the start a value is needed for place"):
            tracker.start()
        with pytest.raises(ModelError, match="'lamp' is not observed here; what is: place"):
            tracker.start({"place": 0, "lamp": "on"})


def test_a_fully_observed_model_has_no_belief_to_track() -> None:
    symbolic = compile_model(Model("seen", [boolean("x")], [Action("go", {"x": "not x"})]))
    with pytest.raises(ModelError, match="seen is fully observed"):
        choose_tracker(symbolic)
    with pytest.raises(ModelError, match="seen is fully observed"):
        ParticleTracker(symbolic)
    with pytest.raises(ValueError, match="on_impossible is 'ignore'"):
        DiagramTracker(compile_model(tiger()), on_impossible="ignore")  # type: ignore[arg-type]


def test_blocks_say_what_they_do_not_know() -> None:
    symbolic = compile_model(noisy_bits(3))
    deaf = [Action("wait", symbolic.model.actions[0].effects)]
    symbolic = compile_model(Model("deaf", symbolic.model.features, deaf, observability="partial"))
    belief = make_block_tracker(symbolic).start()
    condition = symbolic.manager.indicator(symbolic.now(0), [1])
    for ask in (belief.probability, belief.support_in):
        with pytest.raises(ModelError, match="the condition divides a block"):
            ask(condition)
    with pytest.raises(ModelError, match="the partition divides a block"):
        belief.project(partition_from(symbolic, condition))
    assert belief.marginals() == {}
    with pytest.raises(ModelError, match="no feature 'y'; there are x0, x1, x2"):
        make_block_tracker(symbolic, features=["y"])


def test_a_partition_that_leaves_out_a_possible_state_is_refused() -> None:
    for tracker in trackers(tiger()):
        symbolic = tracker.symbolic
        left = symbolic.manager.indicator(symbolic.now(0), [0])
        narrow = partition_from(symbolic, symbolic.manager.constant(0), left)
        belief = tracker.start()
        with pytest.raises(ModelError, match="leaves out states that the belief holds possible"):
            belief.project(narrow)


def test_states_that_an_action_leaves_are_no_restriction() -> None:
    symbolic = compile_model(tiger())
    left = symbolic.manager.indicator(symbolic.now(0), [0])
    tracker = make_block_tracker(symbolic, reachable=left, features=["tiger"])
    belief = tracker.start(initial=independent_belief(symbolic, {"tiger": {"left": 1}}))
    with pytest.raises(ModelError, match="`reachable` must hold all"):
        belief.after(1, {})


# -- beliefs to start from -------------------------------------------------------------------------


def test_an_episode_may_start_from_another_belief() -> None:
    for tracker in trackers(corridor()):
        tolerance = 1e-12 if tracker.guarantee == "exact" else 0.04
        initial = independent_belief(tracker.symbolic, {"low": {True: 0.7, False: "0.3"}})
        belief = tracker.start({"place": 1}, initial=initial)
        assert belief.marginals()["low"].tolist() == pytest.approx([0.3, 0.7], abs=tolerance)
        assert belief.likelihood == pytest.approx(1 / 2)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"high": {True: 1}}, "no feature 'high'; there are place, low"),
        ({"low": {True: 0.6}}, "the distribution of low sums to 3/5"),
        ({"low": {1: 1}}, "low has no value 1; it has false, true"),
    ],
)
def test_wrong_beliefs_to_start_from_are_refused(
    given: dict[str, dict[Value, float]], message: str
) -> None:
    with pytest.raises(ModelError, match=message):
        independent_belief(compile_model(corridor()), given)


# -- particles -------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(0, 60, 3))
def test_particles_are_within_their_statistical_error(seed: int) -> None:
    it = case(seed)
    partition, _ = coarser(seed, 1)
    least = [np.inf]

    def check(belief: Belief, moment: Moment) -> None:
        assert isinstance(belief, ParticleBelief)
        assert belief.weights.sum() == pytest.approx(1)
        assert 1 - 1e-9 <= belief.effective <= 5000 * (1 + 1e-9)
        least[0] = min(least[0], belief.effective)
        expected = it.summed(partition.diagram, moment.belief, partition.blocks)
        # Each of up to 9 rounds of drawing adds the error of `least` draws; 5 standard errors.
        error = 5 * np.sqrt(9 * expected * (1 - expected) / least[0]) + 1e-9
        assert (np.abs(belief.project(partition) - expected) <= error).all()
        assert (expected[belief.project(partition) > 0] > 0).all()

    follow(ParticleTracker(it.symbolic, 5000, seed=seed), episode(seed), check)


def test_the_estimated_likelihood_of_a_history_has_no_bias() -> None:
    tracker = ParticleTracker(compile_model(tiger()), 20, seed=4)
    estimates = []
    for _ in range(400):
        belief, product = tracker.start(), 1.0
        for sound in ("left", "left", "left"):
            belief = belief.after(0, {"sound": sound})
            product *= belief.likelihood
        estimates.append(product)
    error = np.std(estimates) / np.sqrt(len(estimates))
    assert np.mean(estimates) == pytest.approx((0.85**3 + 0.15**3) / 2, abs=4 * error)


def test_the_same_belief_always_goes_on_in_the_same_way() -> None:
    symbolic = compile_model(corridor())
    one, two = (ParticleTracker(symbolic, 100, seed=7).start({"place": 0}) for _ in range(2))
    ends = [b.after(0, {"place": 1}) for b in (one, two, one)]
    assert all(isinstance(end, ParticleBelief) for end in ends)
    assert len({end.states.tobytes() for end in ends if isinstance(end, ParticleBelief)}) == 1
    tracker = ParticleTracker(symbolic, 100, seed=7)
    starts = [tracker.start({"place": 0}) for _ in range(2)]
    assert len({start.states.tobytes() for start in starts if isinstance(start, ParticleBelief)}) == 2


def test_systematic_resampling_rounds_the_expected_number_of_copies_up_or_down() -> None:
    generator = np.random.default_rng(5)
    for _ in range(50):
        weights = generator.dirichlet(np.full(7, 0.4))
        weights[generator.integers(7)] = 0
        weights /= weights.sum()
        copies = np.bincount(systematic(weights, 30, generator), minlength=7)
        assert copies.sum() == 30
        assert (np.abs(copies - 30 * weights) < 1 + 1e-9).all()


def rare(denominator: int) -> Model:
    """A bit that is true with probability 1/denominator, and a sensor without errors."""
    chance = f"{{true: 1/{denominator}, false: {denominator - 1}/{denominator}}}"
    look = Action("look", senses={"o": "x'"})
    wait = Action("wait", {"n": "{false: 1/2, true: 1/2}"})
    return Model(
        "rare", [boolean("x"), boolean("n")], [wait, look], initial={"x": chance}, observability="partial",
        observations=[Observation("o", [False, True, "none"])],
    )  # fmt: skip


def test_depleted_particles_are_drawn_anew_from_the_history() -> None:
    belief = ParticleTracker(compile_model(rare(100)), 20, seed=0).start()
    belief = belief.after(0, {}).after(0, {})
    assert isinstance(belief, ParticleBelief)
    assert not belief.states[:, 0].any()  # no particle has the rare value
    belief = belief.after(1, {"o": True})
    assert isinstance(belief, ParticleBelief)
    assert len(belief.states) == 20
    assert belief.marginals()["x"].tolist() == pytest.approx([0, 1])
    assert belief.after(1, {"o": True}).likelihood == pytest.approx(1)


def test_too_few_particles_and_the_impossible_are_not_told_apart() -> None:
    belief = ParticleTracker(compile_model(rare(10**9)), 20, seed=0).start()
    with pytest.raises(Depleted, match=r"impossible after action 'look'.*or 1,280 particles are too few"):
        belief.after(1, {"o": True})
    with pytest.raises(ValueError, match="0 particles"):
        ParticleTracker(compile_model(rare(2)), 0)


# -- the choice ------------------------------------------------------------------------------------


def test_the_choice_goes_by_size_and_says_why() -> None:
    symbolic = compile_model(noisy_bits(6))
    blocks = choose_tracker(symbolic)
    assert (blocks.kind, blocks.reason) == ("blocks", "the common refinement has 64 blocks")
    diagram = choose_tracker(symbolic, block_limit=10)
    assert diagram.kind == "diagram"
    assert "more than 10 blocks" in diagram.reason
    particles = choose_tracker(symbolic, block_limit=10, node_limit=2, particles=50)
    assert particles.kind == "particles"
    assert "more than 2 nodes" in particles.reason
    assert "50 particles" in particles.reason
    assert choose_tracker(symbolic, block_limit=0, node_limit=0, particles=5).reason == "5 particles"


def test_a_refinement_that_outgrows_its_memory_is_left_for_diagrams() -> None:
    chosen = choose_tracker(compile_model(noisy_bits(24)), block_limit=100)
    assert chosen.kind == "diagram"
    assert "no tracker over blocks: " in chosen.reason


def test_random_histories_are_possible_and_end_with_the_episode() -> None:
    ended = 0
    for seed in range(0, 110, 5):
        symbolic = case(seed).symbolic
        first, *rest = random_history(symbolic, 10, seed)
        tracker = make_block_tracker(symbolic, seed=seed)
        belief: Belief = tracker.begin(symbolic.initial, first)
        for received in rest:
            assert not belief.ended
            belief = belief.advance(received)
        ended += belief.ended
    assert ended >= 3


def test_a_walk_that_skips_a_sensed_feature_still_weighs_it() -> None:
    """The observation's factor counts though the partition's diagram does not test its parent."""
    model = noisy_bits(2)
    symbolic = compile_model(model)
    partition = partition_from(symbolic, symbolic.manager.indicator(symbolic.now(0), [1]))
    action = symbolic.actions[0]
    walk = make_walk(partition, action.rows, action.observations)
    ends, leaves, masses = walk.push(np.array([[1, 1]], dtype=np.int32), (0, 0))
    assert ends.tolist() == [2]
    found = dict(zip(leaves.tolist(), masses.tolist(), strict=True))
    second = 0.9 * 0.8 + 0.1 * 0.3  # x1 stays true, or not, and o1 = 0
    label = evaluate_states(partition.diagram, np.array([[0, 0], [1, 0]]), symbolic.columns()).tolist()
    assert found[label[0]] == pytest.approx(0.1 * 0.3 * second)
    assert found[label[1]] == pytest.approx(0.9 * 0.8 * second)


def test_a_condition_may_be_any_union_of_blocks() -> None:
    symbolic = compile_model(tiger(terminal=True))
    manager = symbolic.manager
    left = manager.indicator(symbolic.now(0), [0])
    mixed = choose(symbolic.terminal, manager.constant(1), left)
    belief = make_block_tracker(symbolic, conditions=[mixed]).start().after(0, {"sound": "left"})
    assert belief.probability(mixed) == pytest.approx(0.85)
    assert not belief.support_in(mixed)
    assert belief.support_in(manager.constant(1))

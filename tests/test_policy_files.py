"""Policy files: what is saved comes back, and nothing else does any harm."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from factored_polca.explicit.alpha_vectors import AlphaSet, AlphaVectors, StagedVectors
from factored_polca.explicit.entropy_policy import EntropyPolicy
from factored_polca.explicit.policies import AnyPolicy
from factored_polca.explicit.policy_graph import PolicyGraph
from factored_polca.explicit.state_policy import StatePolicy
from factored_polca.formats import archive
from factored_polca.hierarchy.plan_file import load_plan
from factored_polca.hierarchy.policy_file import FlatPolicy, is_policy_file, load_policy, save_policy
from factored_polca.minimisation.flat_model import flat_model
from factored_polca.models import Action, Feature, LimitReached, Model, ModelError, Observation, boolean
from factored_polca.symbolic import compile_model


def peek(horizon: int | None = None) -> Model:
    """A prize lies left or right (hidden); the side one stands on is seen; picking ends it.

    States (side, prize, over): 0 to 7; `look` has two observations, the other actions one.
    """
    side = Feature("side", ("left", "right"), observed=True)
    prize, over = Feature("prize", ("left", "right")), boolean("over")
    hint = Observation("hint", ("left", "right", "none"))
    return Model(
        "peek",
        [side, prize, over],
        [
            Action("look", rewards=-1, senses={hint: "{left: 0.8, right: 0.2} if prize' == left "
                                                     "else {left: 0.2, right: 0.8}"}),
            Action("cross", {side: "right if side == left else left"}, rewards=-1),
            Action("pick", {over: "true"}, rewards="10 if side == prize else -10"),
        ],
        initial={over: "false"}, terminal="over", observability="partial", observations=[hint],
        discount="0.9", horizon=horizon,
    )  # fmt: skip


def fenced(horizon: int | None = None) -> Model:
    """Fully observed: `stop` applies at 2 only, and ends at 3; `up` applies below 2."""
    level = Feature("level", range(4))
    up = Action("up", {level: "level + 1"}, applicable="level < 2", rewards=-1)
    stop = Action("stop", {level: "3"}, applicable="level == 2", rewards=5)
    return Model(
        "fenced", [level], [up, stop], initial={level: "0"}, terminal="level == 3", horizon=horizon
    )


def alpha() -> AlphaVectors:
    left = AlphaSet(np.array([0, 2]), np.array([[1.0, -2.0], [-2.0, 1.0]]), np.array([2, 1]))
    right = AlphaSet(
        np.array([4, 6]), np.array([[0.1, 1 / 3], [0.5, -0.0], [2.0, 1e-300]]), np.array([0, 1, 2])
    )
    return AlphaVectors(8, (left, right), "lower")


def graph() -> PolicyGraph:
    tables = (np.array([[0, 1], [1, -1]]), np.array([[0, 0]]))
    return PolicyGraph(np.array([0, 2]), tables, np.array([0, 1]))


POLICIES: dict[str, tuple[Model, AnyPolicy]] = {
    "alpha": (peek(), alpha()),
    "no vectors": (peek(), AlphaVectors(8, (), "exact")),
    "staged": (peek(2), StagedVectors((alpha(), AlphaVectors(8, alpha().sets[:1], "exact")))),
    "graph": (peek(), graph()),
    "entropy": (peek(), EntropyPolicy(np.arange(24).reshape(8, 3) % 3)),
    "mdp": (fenced(), StatePolicy(np.array([[0, 0, 1, -1]]))),
    "staged mdp": (fenced(3), StatePolicy(np.array([[0, 0, 1, -1]] * 3, dtype=np.int16), staged=True)),
}


def made(name: str) -> FlatPolicy:
    model, policy = POLICIES[name]
    flat = flat_model(compile_model(model), reachable=False)
    return FlatPolicy(flat, policy, {"value": 1.5, "note": "by hand"})


def saved(name: str, folder: Path) -> Path:
    path = folder / "p.policy"
    save_policy(made(name), path)
    return path


def assert_same(a: AnyPolicy, b: AnyPolicy) -> None:
    assert type(a) is type(b)
    if isinstance(a, StagedVectors) and isinstance(b, StagedVectors):
        assert a.horizon == b.horizon
        for mine, other in zip(a.stages, b.stages, strict=True):
            assert_same(mine, other)
    elif isinstance(a, AlphaVectors) and isinstance(b, AlphaVectors):
        assert (a.states, a.meaning) == (b.states, b.meaning)
        for part, found in zip(a.sets, b.sets, strict=True):
            np.testing.assert_array_equal(part.states, found.states)
            np.testing.assert_array_equal(part.actions, found.actions)
            np.testing.assert_array_equal(part.vectors, found.vectors)
    elif isinstance(a, PolicyGraph) and isinstance(b, PolicyGraph):
        np.testing.assert_array_equal(a.actions, b.actions)
        np.testing.assert_array_equal(a.start, b.start)
        for table, found_table in zip(a.successors, b.successors, strict=True):
            np.testing.assert_array_equal(table, found_table)
    elif isinstance(a, (EntropyPolicy, StatePolicy)) and isinstance(b, (EntropyPolicy, StatePolicy)):
        np.testing.assert_array_equal(a.actions, b.actions)
        assert getattr(a, "staged", None) == getattr(b, "staged", None)


@pytest.mark.parametrize("name", POLICIES)
def test_a_saved_policy_comes_back(name: str, tmp_path: Path) -> None:
    before, path = made(name), saved(name, tmp_path)
    assert is_policy_file(path)
    after = load_policy(path)
    assert_same(before.policy, after.policy)
    assert after.model == before.model
    assert after.report == {"value": 1.5, "note": "by hand"}
    np.testing.assert_array_equal(after.flat.states, before.flat.states)
    assert [found.name for found in tmp_path.iterdir()] == ["p.policy"]


def test_a_policy_for_reachable_states_comes_back(tmp_path: Path) -> None:
    flat = flat_model(compile_model(fenced()))
    save_policy(FlatPolicy(flat, StatePolicy(np.array([[0, 0, 1, -1]]))), tmp_path / "p.policy")
    assert load_policy(tmp_path / "p.policy").flat.reachable


def test_a_failed_save_leaves_what_was_there(tmp_path: Path) -> None:
    path = saved("alpha", tmp_path)
    before = path.read_bytes()
    with pytest.raises(ValueError, match="JSON"):
        save_policy(FlatPolicy(made("alpha").flat, alpha(), {"value": float("nan")}), path)
    assert path.read_bytes() == before
    with pytest.raises(ModelError, match="no folder"):
        save_policy(made("alpha"), tmp_path / "none" / "p.policy")
    assert [found.name for found in tmp_path.iterdir()] == ["p.policy"]


Change = Callable[[bytes], bytes | None]


def rewritten(path: Path, name: str, change: Change) -> Path:
    """The policy file with one entry changed, or left out."""
    target = path.with_name("changed.policy")
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(target, "w") as new:
        for entry in old.namelist():
            data: bytes | None = old.read(entry)
            if entry == name:
                data = change(old.read(entry))
            if data is not None:
                new.writestr(entry, data)
    return target


def array(values: object, kind: object = "<i8", order: str = "C") -> Change:
    def change(_: bytes) -> bytes:
        buffer = io.BytesIO()
        np.save(buffer, np.array(values, dtype=kind, order=order), allow_pickle=True)  # type: ignore[call-overload]
        return buffer.getvalue()

    return change


def header(text: str) -> Change:
    """An array whose header says something else than what follows."""

    def change(data: bytes) -> bytes:
        line = text.encode().ljust(117) + b"\n"
        return data[:8] + len(line).to_bytes(2, "little") + line + data[128:]

    return change


def in_json(**changes: object) -> Change:
    return lambda data: json.dumps({**json.loads(data), **changes}).encode()


HUGE = "{'descr': '<i8', 'fortran_order': False, 'shape': (%s,)}"

TAMPERED: list[tuple[str, str, Change, str]] = [
    ("alpha", "policy.json", in_json(format="factored-polca plan"), "no policy of this program"),
    ("alpha", "policy.json", in_json(version=2), "policy version 2; this program reads 1"),
    ("alpha", "policy.json", in_json(kind="tree"), "no kind of policy: 'tree'"),
    ("alpha", "policy.json", in_json(kind=["alpha"]), "kind in policy.json"),
    ("alpha", "policy.json", in_json(kind="staged"), "different horizons"),
    ("alpha", "policy.json", in_json(kind="graph"), "no item named 'actions.npy'"),
    ("alpha", "policy.json", in_json(reachable=1), "reachable in policy.json"),
    ("alpha", "policy.json", in_json(reachable=True, states=4), "states are not those"),
    ("alpha", "policy.json", in_json(states=7), "states are not those"),
    ("alpha", "policy.json", in_json(digest="00"), "states are not those"),
    ("alpha", "policy.json", in_json(head={}), "meanings"),
    ("alpha", "policy.json", in_json(head={"meanings": ["true"]}), "means none"),
    ("alpha", "policy.json", in_json(head={"meanings": ["lower"] * 2}), "not counted"),
    ("alpha", "policy.json", in_json(head={"meanings": [["lower"]]}), "damaged"),
    ("alpha", "policy.json", in_json(report=[1]), "report in policy.json"),
    ("alpha", "policy.json", lambda data: data.replace(b"1.5", b"NaN"), "NaN is no number"),
    ("alpha", "policy.json", lambda data: b"[]", "holds no object"),
    ("alpha", "policy.json", lambda data: b"{", "damaged"),
    ("alpha", "policy.json", lambda data: b"[" * 100_000, "damaged"),
    ("alpha", "policy.json", lambda data: None, "no item named 'policy.json'"),
    ("alpha", "model.toml", lambda data: data[: len(data) // 2], "changed.policy"),
    ("alpha", "model.toml", lambda data: b"\xff\xfe", "damaged"),
    ("alpha", "model.toml", lambda data: data.replace(b"boolean", b"0..2"), "changed.policy"),
    ("alpha", "model.toml", lambda data: None, "no item named 'model.toml'"),
    ("alpha", "set_states.npy", array([0, 2, 4, 8]), "a state has a number that is out of range"),
    ("alpha", "set_states.npy", array([0, 2, -4, 6]), "a state has a number that is out of range"),
    ("alpha", "set_states.npy", array([0, 4, 2, 6]), "told apart"),
    ("alpha", "set_states.npy", array([2, 0, 4, 6]), "out of order"),
    ("alpha", "set_states.npy", array([0, 2, 0, 2]), "two sets"),
    ("alpha", "set_states.npy", array([0, 2, 4]), "have not the sizes"),
    ("alpha", "set_states.npy", array([[0, 2], [4, 6]]), "no array of integers with 1 dimensions"),
    ("alpha", "set_actions.npy", array([2, 1, 0, 1, 3]), "an action has a number that is out of range"),
    ("alpha", "set_actions.npy", array([2, 1, 0, 1, 2.5], "<f8"), "no array of"),
    ("alpha", "set_vectors.npy", array([np.nan] * 10, "<f8"), "not finite"),
    ("alpha", "set_vectors.npy", array([np.inf] * 10, "<f8"), "not finite"),
    ("alpha", "set_vectors.npy", array([0.0] * 9, "<f8"), "have not the sizes"),
    ("alpha", "set_vectors.npy", array(["a"] * 10, "<U1"), "no array of numbers"),
    ("alpha", "set_vectors.npy", array([{"an": "object"}], object), "damaged"),
    ("alpha", "set_vectors.npy", lambda data: data[:-8], "not as many bytes"),
    ("alpha", "set_vectors.npy", lambda data: data[:40], "damaged"),
    ("alpha", "set_sizes.npy", array([[2, 2], [2, 0]]), "empty"),
    ("alpha", "set_sizes.npy", array([[2, 2], [2, 2**62]]), "too large"),
    ("alpha", "set_sizes.npy", array([[2], [2]]), "not counted"),
    ("alpha", "set_sizes.npy", array([[2, 2], [2, 3]], order="F"), "no array of"),
    ("alpha", "stage_sets.npy", array([3]), "not counted"),
    ("alpha", "stage_sets.npy", array([]), "not counted"),
    ("alpha", "stage_sets.npy", header(HUGE % 10**15), "not as many bytes"),
    ("alpha", "stage_sets.npy", header(HUGE % -1), "damaged"),
    ("alpha", "stage_sets.npy", header("__import__('os').getcwd()"), "damaged"),
    ("alpha", "stage_sets.npy", lambda data: data[:6] + b"\x03" + data[7:], "version 1.0"),
    ("staged", "stage_sets.npy", array([4, -1]), "not counted rightly"),
    ("staged", "policy.json", in_json(kind="alpha"), "one stage"),
    ("graph", "actions.npy", array([0, 3]), "an action has"),
    ("graph", "actions.npy", array([]), "no node"),
    ("graph", "actions.npy", array([2, 2]), "a successor"),
    ("graph", "start.npy", array([0]), "not enough first nodes"),
    ("graph", "start.npy", array([0, 2]), "a first node has"),
    ("graph", "start.npy", array([0, -2]), "a first node has"),
    ("graph", "successors.npy", array([0, 1, 1, -1, 0, 2]), "a node has"),
    ("graph", "successors.npy", array([0, 1, 1, -1, 0]), "a successor"),
    ("entropy", "actions.npy", array([[0]] * 7), "missing for a state"),
    ("entropy", "actions.npy", array(np.zeros((8, 0))), "no bins"),
    ("entropy", "actions.npy", array([[3]] * 8), "an action has"),
    ("mdp", "actions.npy", array([[0, 0, 1]]), "another number of states"),
    ("mdp", "actions.npy", array([[0, 0, 2, -1]]), "an action has"),
    ("mdp", "actions.npy", array([[0, 0, 1, -2]]), "an action has"),
    ("mdp", "actions.npy", array([[0, 1, 1, -1]]), "takes 'stop' where it does not apply"),
    ("mdp", "actions.npy", array([[0, 0, 1, 0]]), "takes 'up' where it does not apply"),
    ("mdp", "actions.npy", array([[0, 0, 1, -1]] * 2), "stages"),
    ("mdp", "actions.npy", array(np.zeros((0, 4))), "stages"),
    ("mdp", "policy.json", in_json(head={"staged": 1}), "stages"),
    ("mdp", "policy.json", in_json(head={"staged": True}), "different horizons"),
    ("staged mdp", "actions.npy", array([[0, 0, 1, -1]] * 2), "different horizons"),
    ("staged mdp", "policy.json", in_json(head={"staged": False}), "stages"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "entry", "change", "said"), TAMPERED)
def test_a_tampered_policy_is_refused(
    tmp_path: Path, name: str, entry: str, change: Change, said: str
) -> None:
    path = rewritten(saved(name, tmp_path), entry, change)
    with pytest.raises(ModelError, match=said) as caught:
        load_policy(path)
    assert "changed.policy" in str(caught.value)


def test_a_policy_of_states_is_refused_where_they_are_not_seen(tmp_path: Path) -> None:
    path = tmp_path / "p.policy"
    save_policy(FlatPolicy(made("alpha").flat, StatePolicy(np.array([[0] * 8]))), path)
    with pytest.raises(ModelError, match="does not let see"):
        load_policy(path)


def test_truncated_and_foreign_files_are_refused(tmp_path: Path) -> None:
    path = saved("alpha", tmp_path)
    data = path.read_bytes()
    for cut in (0, 1, 100, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:cut])
        assert not is_policy_file(path)
        with pytest.raises(ModelError, match="no policy file"):
            load_policy(path)
    for other, said in ((tmp_path, "no regular file"), (tmp_path / "none.policy", "solve MODEL -o none.p")):
        assert not is_policy_file(other)
        with pytest.raises(ModelError, match=said):
            load_policy(other)


def test_flipped_bytes_never_crash(tmp_path: Path) -> None:
    path = saved("graph", tmp_path)
    data = bytearray(path.read_bytes())
    generator = np.random.default_rng(0)
    refused = 0
    for _ in range(60):
        damaged = bytearray(data)
        for place in generator.integers(0, len(data), size=3):
            damaged[place] ^= int(generator.integers(1, 256))
        path.write_bytes(bytes(damaged))
        try:
            load_policy(path)
        except ModelError:
            refused += 1
    assert refused > 30  # what is left hit dates and the like, which nobody reads


def test_bombs_are_refused_before_they_are_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "bomb.policy"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as bomb:
        bomb.writestr("policy.json", bytes(2 << 20))
    assert path.stat().st_size < 1 << 13
    monkeypatch.setattr(archive, "MAXIMUM_TEXT", 1 << 20)
    with pytest.raises(ModelError, match="longer than a text"):
        load_policy(path)
    monkeypatch.setattr(archive, "MAXIMUM_BYTES", 1 << 20)
    with pytest.raises(ModelError, match="larger than such a file"):
        load_policy(path)
    with zipfile.ZipFile(path, "w") as bomb:
        for number in range(archive.MAXIMUM_ENTRIES + 1):
            bomb.writestr(str(number), b"")
    with pytest.raises(ModelError, match="larger than such a file"):
        load_policy(path)


def test_a_model_of_too_many_states_is_a_limit(tmp_path: Path) -> None:
    path = rewritten(
        saved("entropy", tmp_path),
        "model.toml",
        lambda data: data.replace(b"[features]", b'[features]\nwide = "0..9999"\nwider = "0..9999"'),
    )
    with pytest.raises(LimitReached, match="states"):
        load_policy(path)


def test_plans_and_policies_are_not_taken_for_each_other(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="not a plan file"):
        load_plan(saved("alpha", tmp_path))
    path = tmp_path / "plan.polca"
    with zipfile.ZipFile(path, "w") as plan:
        plan.writestr("plan.json", "{}")
    assert not is_policy_file(path)

"""Pruning and the simplex method against the definition, by linear programs that HiGHS solves."""

import numpy as np
import pytest
from scipy.optimize import linprog

from factored_polca.explicit.arrays import FloatArray
from factored_polca.models.errors import LimitReached
from factored_polca.solvers import pruning
from factored_polca.solvers.constraint_generation import DOUBTFUL
from factored_polca.solvers.envelope import envelope, envelope_of_sums
from factored_polca.solvers.pruning import prune, survivors, verified
from factored_polca.solvers.simplex import game_value, game_value_by_highs

HIGHS = 1e-7
"""HiGHS meets its constraints to 1e-7 by default; the games here have entries of order 1."""


def best_gain(vector: FloatArray, others: FloatArray) -> float:
    """max over beliefs b of (vector . b - max over u in others of u . b), straight from the definition."""
    count, i = others.shape
    result = linprog(
        [0.0] * i + [-1.0],
        A_ub=np.hstack([others - vector, np.ones((count, 1))]),
        b_ub=np.zeros(count),
        A_eq=[[1.0] * i + [0.0]],
        b_eq=[1.0],
        bounds=[(0, None)] * i + [(None, None)],
        method="highs",
    )
    assert result.status == 0
    return -float(result.fun)


def beliefs(i: int, count: int, generator: np.random.Generator) -> FloatArray:
    """Random beliefs, the corners and the uniform one among them."""
    return np.vstack([np.eye(i), np.full((1, i), 1 / i), generator.dirichlet(np.full(i, 0.5), size=count)])


def random_set(number: int) -> FloatArray:
    """Vectors [n, i] with duplicates, dominated mixtures, ties and near ties, over 1 to 6 states."""
    generator = np.random.default_rng(number)
    i, n = int(generator.integers(1, 7)), int(generator.integers(1, 22))
    if number % 3 == 0:
        rows = generator.integers(-2, 3, size=(n, i)).astype(np.float64)  # many exact ties
    elif number % 3 == 1:
        rows = generator.normal(size=(n, i))
    else:  # close to a sphere: nearly all are useful
        rows = generator.normal(size=(n, i))
        rows /= np.linalg.norm(rows, axis=1)[:, None]
    weights = generator.dirichlet(np.ones(n), size=3)
    extra = [rows[:2], weights @ rows, weights @ rows - 0.1, rows[-1:] + 1e-15, rows[:1] - 1e-14]
    together = np.vstack([rows, *extra])
    return together[generator.permutation(len(together))]


@pytest.mark.parametrize("number", range(60))
def test_what_is_kept_is_useful_and_what_is_dropped_is_not(number: int) -> None:
    vectors = random_set(number)
    kept = prune(vectors)
    assert np.all(np.diff(kept) > 0)
    chosen = set(kept.tolist())
    for n, vector in enumerate(vectors):
        others = [m for m in kept if m != n]
        if n not in chosen:
            assert best_gain(vector, vectors[others]) <= HIGHS
        elif others:
            assert best_gain(vector, vectors[others]) >= -HIGHS
    points = beliefs(vectors.shape[1], 300, np.random.default_rng(number))
    loss = (points @ vectors.T).max(axis=1) - (points @ vectors[kept].T).max(axis=1)
    assert np.all(np.abs(loss) <= 1e-12 * max(1.0, np.abs(vectors).max()) + 1e-15)


@pytest.mark.parametrize("number", range(30))
def test_no_smaller_set_has_the_same_maximum(number: int) -> None:
    generator = np.random.default_rng(number)
    i = int(generator.integers(2, 7))
    rows = generator.integers(-3, 4, size=(15, i)).astype(np.float64)  # gains are 0 or far from it
    kept = prune(rows)
    for n in kept:
        others = [m for m in kept if m != n]
        assert not others or best_gain(rows[n], rows[others]) > 1e-4


def test_pruning_again_changes_nothing_and_order_does_not_matter() -> None:
    generator = np.random.default_rng(4)
    for i in (2, 3, 5):
        rows = generator.normal(size=(60, i))
        kept = rows[prune(rows)]
        assert len(prune(kept)) == len(kept)
        order = generator.permutation(len(rows))
        again = rows[order][prune(rows[order])]
        assert sorted(map(tuple, again)) == sorted(map(tuple, kept))


def test_of_equal_vectors_the_first_is_kept() -> None:
    for i in (1, 2, 3, 4):
        assert prune(np.ones((5, i))).tolist() == [0]
        rows = np.vstack([np.eye(i), np.eye(i)])
        assert prune(rows).tolist() == list(range(i))


def test_ties_at_corners_do_not_keep_useless_vectors() -> None:
    # (1, 0, 0) and (1, -1, -1) tie at the first corner, where pruning looks first
    rows = np.array([[1.0, -1, -1], [1, 0, 0], [0, 1, 0], [0, 1, -2], [0, 0, 1], [-3, 0, 1]])
    assert prune(rows).tolist() == [1, 2, 4]


def test_a_mixture_is_dropped_though_no_single_vector_is_above_it() -> None:
    rows = np.array([[3.0, 0, 0], [0, 3, 0], [0, 0, 3], [0.9, 0.9, 0.9], [1.1, 1.1, 1.1]])
    # (1, 1, 1) is the mixture of the first three: 0.9 is below it, 1.1 above
    assert prune(rows).tolist() == [0, 1, 2, 4]


def test_states_in_which_all_vectors_agree_make_no_difference() -> None:
    generator = np.random.default_rng(8)
    for i in (1, 2, 3, 4):
        rows = generator.normal(size=(20, i))
        padded = np.hstack([np.full((20, 2), 7.0), rows[:, :1], np.zeros((20, 1)), rows[:, 1:]])
        assert prune(padded).tolist() == prune(rows).tolist()


def test_one_state_keeps_the_largest_number() -> None:
    assert prune(np.array([[1.0], [3.0], [2.0], [3.0]])).tolist() == [1]


def test_gains_above_the_tolerance_count_and_rounding_does_not() -> None:
    # (1 + d, 1 + d, 1 + d) is better than the three corners' mixture (1, 1, 1) by d, at the uniform belief
    for gain in (1e-3, 1e-6, 1e-9, 1e-11):
        rows = np.vstack([3 * np.eye(3), np.full((1, 3), 1 + gain)])
        assert len(prune(rows)) == 4
    assert len(prune(np.vstack([3 * np.eye(3), np.full((1, 3), 1 + 1e-15)]))) == 3


@pytest.mark.parametrize("i", [2, 3, 5])
def test_errors_of_dropped_vectors_do_not_add_up(i: int) -> None:
    generator = np.random.default_rng(i)
    rows = generator.normal(size=(200, i))
    rows /= np.linalg.norm(rows, axis=1)[:, None]
    tolerance = 0.02
    kept = prune(rows, tolerance=tolerance)
    assert len(kept) < len(prune(rows))
    points = beliefs(i, 3000, generator)
    loss = (points @ rows.T).max(axis=1) - (points @ rows[kept].T).max(axis=1)
    assert loss.max() <= tolerance * max(1.0, np.abs(rows).max())


@pytest.mark.parametrize("number", range(30))
def test_sums_are_pruned_as_if_they_were_written_out(number: int) -> None:
    generator = np.random.default_rng(number)
    i = int(generator.integers(1, 7))
    if number % 2:
        left, right = generator.normal(size=(7, i)), generator.normal(size=(9, i))
    else:
        left = generator.integers(-2, 3, size=(7, i)).astype(np.float64)
        right = generator.integers(-2, 3, size=(9, i)).astype(np.float64)
    found = survivors(left, right)
    sums = (left[:, None, :] + right[None, :, :]).reshape(-1, i)
    kept = found.left * len(right) + found.right
    assert np.all(np.diff(kept) > 0)
    points = beliefs(i, 200, generator)
    chosen = left[found.left] + right[found.right]
    assert np.allclose((points @ sums.T).max(axis=1), (points @ chosen.T).max(axis=1), atol=1e-11, rtol=0)
    for n in range(len(chosen)):
        others = np.delete(chosen, n, axis=0)
        assert not len(others) or best_gain(chosen[n], others) >= -HIGHS
    worth = np.einsum("ni,ni->n", chosen, found.witnesses)
    assert np.all(worth >= (found.witnesses @ sums.T).max(axis=1) - 1e-11)
    assert np.allclose(found.witnesses.sum(axis=1), 1)


def test_two_states_follow_the_closed_form_of_tangents() -> None:
    # the line through (q, q^2) with slope 2q is 2qp - q^2; the maximum over q of all is p^2 at p = q
    q = np.linspace(0, 1, 11)
    rows = np.column_stack([-(q**2), 2 * q - q**2])
    below = rows - 0.01  # a tangent less 1/100 is below the envelope, which is at least p^2 - 1/400
    kept, witnesses = envelope(np.vstack([below, rows]), 1e-12)
    assert kept.tolist() == list(range(11, 22))
    # neighbours cross half way, the ends reach to 0 and 1
    cuts = np.concatenate([[0], (q[1:] + q[:-1]) / 2, [1]])
    assert np.allclose(witnesses[:, 1], (cuts[1:] + cuts[:-1]) / 2)


def test_the_envelope_of_sums_has_a_line_for_each_pair_of_touching_stretches() -> None:
    # max(-p, p - 1/2) bends at 1/4, max(0, p - 3/4) at 3/4: three stretches, three sums
    left = np.array([[0.0, -1.0], [-0.5, 0.5]])
    right = np.array([[0.0, 0.0], [-0.75, 0.25]])
    l, r, witnesses = envelope_of_sums(left, right, 1e-12)
    assert list(zip(l.tolist(), r.tolist(), strict=True)) == [(0, 0), (1, 0), (1, 1)]
    assert np.allclose(witnesses[:, 1], [1 / 8, 1 / 2, 7 / 8])
    # both bend at 1/4: the two mixed sums are useless
    l, r, _ = envelope_of_sums(left, left + 3, 1e-12)
    assert list(zip(l.tolist(), r.tolist(), strict=True)) == [(0, 0), (1, 1)]


def random_game(number: int) -> FloatArray:
    generator = np.random.default_rng(number)
    count, i = int(generator.integers(1, 40)), int(generator.integers(1, 13))
    if number % 4 == 0:
        return generator.normal(size=(count, i))
    if number % 4 == 1:
        return generator.integers(-2, 3, size=(count, i)).astype(np.float64)
    if number % 4 == 2:  # degenerate: rows of 0 and 1 less one of them
        rows = generator.integers(0, 2, size=(count, i)).astype(np.float64)
        return rows[0] - rows
    rows = generator.normal(size=(count, i))
    rows[generator.random(rows.shape) < 0.6] = 0
    return np.asarray(rows * 10.0 ** generator.integers(-6, 7))


@pytest.mark.parametrize("block", range(10))
def test_the_simplex_method_agrees_with_highs(block: int) -> None:
    for number in range(40 * block, 40 * block + 40):
        matrix = random_game(number)
        scale = float(np.abs(matrix).max()) or 1.0
        value, belief, mixture = game_value(matrix)
        # either side proves the other one optimal, whoever solved it
        assert (matrix @ belief).min() >= value - 1e-11 * scale
        assert (mixture @ matrix).max() <= value + 1e-11 * scale
        assert min(belief.min(), mixture.min()) >= 0
        assert abs(belief.sum() - 1) + abs(mixture.sum() - 1) <= 1e-12
        assert abs(game_value_by_highs(matrix)[0] - value) <= HIGHS * scale


def test_a_game_of_one_row_or_one_column_is_an_extreme_entry() -> None:
    assert game_value(np.array([[1.0, 5, 2]]))[0] == 5
    assert game_value(np.array([[1.0], [5], [2]]))[0] == 1
    assert game_value(np.zeros((3, 3)))[0] == 0


def test_matching_pennies_and_rock_paper_scissors_are_fair() -> None:
    value, belief, mixture = game_value(np.array([[1.0, -1], [-1, 1]]))
    assert abs(value) <= 1e-15
    assert np.allclose([*belief, *mixture], 1 / 2)
    value, belief, mixture = game_value(np.array([[0.0, 1, -1], [-1, 0, 1], [1, -1, 0]]))
    assert abs(value) <= 1e-15
    assert np.allclose([*belief, *mixture], 1 / 3)


def test_verification_puts_wrong_decisions_right() -> None:
    rows = np.array([[3.0, 0, 0], [0, 3, 0], [0, 0, 3], [0.9, 0.9, 0.9], [1.1, 1.1, 1.1]])
    right = [0, 1, 2, 4]
    assert verified(rows, np.array([0, 1, 2])).tolist() == right
    assert verified(rows, np.array([0, 1, 2, 3, 4])).tolist() == right
    assert prune(rows, verify=True).tolist() == right


def test_a_vector_the_programs_leave_open_is_decided_by_highs() -> None:
    rows = np.array([[3.0, 0, 0], [0, 3, 0], [0, 0, 3], [0.9, 0.9, 0.9], [1.1, 1.1, 1.1]])
    work = pruning._Work(rows, np.zeros((1, 3)), 1e-12)
    work.mark(np.eye(3), 0, None)
    for number in (3, 4):
        work.found.state[number, 0] = DOUBTFUL
    work.scan(None)
    assert work.result().left.tolist() == [0, 1, 2, 4]


def test_a_poll_may_stop_the_work() -> None:
    generator = np.random.default_rng(0)
    rows = generator.normal(size=(4000, 6))
    rows /= np.linalg.norm(rows, axis=1)[:, None]

    def stop() -> None:
        raise TimeoutError

    with pytest.raises(TimeoutError):
        prune(rows, poll=stop)


def test_pauses_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    generator = np.random.default_rng(3)
    left, right = generator.normal(size=(30, 5)), generator.normal(size=(40, 5))
    whole = survivors(left, right)
    monkeypatch.setattr(pruning, "PAUSE", 0.0)  # poll after every sum
    calls: list[None] = []
    paused = survivors(left, right, poll=lambda: calls.append(None))
    assert len(calls) > 100
    assert np.array_equal(whole.left, paused.left)
    assert np.array_equal(whole.right, paused.right)
    assert np.array_equal(whole.witnesses, paused.witnesses)


def test_too_many_sums_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pruning, "SUMS", 99)
    with pytest.raises(LimitReached, match="10 x 10"):
        survivors(np.ones((10, 3)), np.ones((10, 3)))

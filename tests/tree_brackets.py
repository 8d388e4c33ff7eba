"""Small POMDPs as arrays and their values by definition, for the tests of exact solvers.

`bracket` expands every action and observation to a depth and bounds the rest by the least and the
largest reward for ever: it shares nothing with the solvers.
"""

from __future__ import annotations

import numpy as np

from factored_polca.explicit.pomdp_arrays import ArrayPOMDP, array_pomdp


def random_pomdp(seed: int, *, discount: float = 0.35, most: int = 5) -> ArrayPOMDP:
    """A random POMDP of up to `most` states: zeros in rows, terminal states, several classes, ties."""
    random = np.random.default_rng(seed)
    states, actions = int(random.integers(1, most + 1)), int(random.integers(1, 4))
    terminal = random.random(states) < (0.2 if states > 2 else 0.0)
    observed = random.integers(0, int(random.integers(1, 3)), states)
    kernel = []
    for _ in range(actions):
        observations = int(random.integers(1, 3))
        weights = random.dirichlet(np.full(states * observations, 0.6), size=states)
        weights = np.where(weights > 0.1 / (states * observations), weights, 0.0)
        weights /= weights.sum(axis=1, keepdims=True)
        weights[terminal] = 0.0
        kernel.append(list(weights.reshape(states, observations, states).transpose(1, 0, 2)))
    rewards = random.integers(-5, 6, (actions, states)).astype(float)
    if random.random() < 0.2:  # a dead state that is not terminal
        rewards[:, 0] = 0.0
        for row in kernel:
            for part in row:
                part[0] = 0.0
                part[0, 0] = 0.0 if terminal[0] else 1 / len(row)
    rewards[:, terminal] = 0.0
    initial = random.dirichlet(np.ones(states))
    return array_pomdp(kernel, rewards, initial, discount, terminal=terminal, observed=observed)


def bracket(pomdp: ArrayPOMDP, belief: np.ndarray, width: float = 2e-3) -> tuple[float, float]:
    """Bounds on the optimal value at a belief [s], as close as a tree of 300,000 beliefs allows."""
    seen = np.unique(pomdp.observed)
    moves = [
        [matrix.toarray() * (pomdp.observed == y) for matrix in row for y in seen] for row in pomdp.kernel
    ]
    parts = [belief * (pomdp.observed == y) for y in seen]
    branching = sum(len(row) for row in moves)
    layers = [np.array([part for part in parts if part.sum() > 0])]
    span = np.ptp(pomdp.rewards) + np.abs(pomdp.rewards).max()
    while span * pomdp.discount ** (len(layers) - 1) / (1 - pomdp.discount) > width:
        if len(layers[-1]) * branching > 300_000:
            break
        layers.append(np.concatenate([layers[-1] @ matrix for row in moves for matrix in row]))
    going_on = layers[-1][:, ~pomdp.terminal].sum(axis=1)
    least, largest = min(pomdp.rewards.min(), 0.0), max(pomdp.rewards.max(), 0.0)
    bounds = [going_on * extreme / (1 - pomdp.discount) for extreme in (least, largest)]
    for layer in layers[-2::-1]:
        for number, values in enumerate(bounds):
            blocks = values.reshape(branching, len(layer))
            q, first = [], 0
            for action, row in enumerate(moves):
                following = blocks[first : first + len(row)].sum(axis=0)
                q.append(layer @ pomdp.rewards[action] + pomdp.discount * following)
                first += len(row)
            bounds[number] = np.max(q, axis=0)
    return float(bounds[0].sum()), float(bounds[1].sum())


def tiger(discount: float) -> ArrayPOMDP:
    """Kaelbling, Littman & Cassandra (1998): listen (-1, right with 0.85), open a door (10 or -100)."""
    hear = np.array([[0.85, 0.15], [0.15, 0.85]])  # [s, o]
    listen = [np.diag(hear[:, o]) for o in range(2)]
    opened = [np.full((2, 2), 0.25) for _ in range(2)]
    rewards = np.array([[-1.0, -1.0], [-100.0, 10.0], [10.0, -100.0]])
    return array_pomdp([listen, opened, opened], rewards, np.array([0.5, 0.5]), discount)


def cheese() -> ArrayPOMDP:
    """McCallum's cheese maze: a row of 5 cells, legs of two under cells 0, 2 and 4, cheese in cell 10."""
    north = [0, 1, 2, 3, 4, 0, 2, 4, 5, 7]
    south = [5, 1, 6, 3, 7, 8, 10, 9, 8, 9]
    east = [1, 2, 3, 4, 4, 5, 6, 7, 8, 9]
    west = [0, 0, 1, 2, 3, 5, 6, 7, 8, 9]
    walls = np.array([0, 1, 2, 1, 3, 4, 4, 4, 5, 5, 6])  # what is seen in each cell
    start = np.append(np.full(10, 0.1), 0.0)
    kernel, rewards = [], []
    for moves in (north, south, east, west):
        rows = np.zeros((11, 11))
        rows[np.arange(10), moves] = 1.0
        rows[10] = start
        kernel.append([rows * (walls == wall) for wall in range(7)])
        rewards.append(rows[:, 10])  # 1 on reaching the cheese
    return array_pomdp(kernel, np.array(rewards), start, 0.95)


def grid_4x3() -> ArrayPOMDP:
    """Russell & Norvig's 4 x 3 world with two wall detectors and a new start after +1 and -1.

    As in Cassandra's file 4x3.95.POMDP, slip of the pen included: going east from cell 9, bumping into
    the south wall ends in cell 8.
    """
    cells = [(0, 0), (0, 1), (0, 2), (0, 3), (1, 0), (1, 2), (1, 3), (2, 0), (2, 1), (2, 2), (2, 3)]
    steps = [(-1, 0), (1, 0), (0, 1), (0, -1)]  # n s e w
    beside = [(2, 3), (2, 3), (0, 1), (0, 1)]
    shown = np.array([0, 2, 2, 4, 3, 0, 5, 0, 2, 2, 1])  # left right neither both good bad
    start = np.full(11, 0.111111)
    start[[3, 6]], start[7] = 0.0, 0.111112
    kernel = []
    for action in range(4):
        rows = np.zeros((11, 11))
        for number, (row, column) in enumerate(cells):
            for direction, chance in [(action, 0.8), *((side, 0.1) for side in beside[action])]:
                target = (row + steps[direction][0], column + steps[direction][1])
                rows[number, cells.index(target) if target in cells else number] += chance
        rows[[3, 6]] = start
        if action == 2:
            rows[9, [8, 9]] = 0.1, 0.0
        kernel.append([rows * (shown == o) for o in range(6)])
    rewards = np.full((4, 11), -0.04)
    rewards[:, 3], rewards[:, 6] = 1.0, -1.0
    return array_pomdp(kernel, rewards, start, 0.95)


def machine(discount: float, *, breaks: float = 0.3, cost: float = 0.5) -> tuple[ArrayPOMDP, float]:
    """A machine that breaks unseen; it earns 1 while good, replacing it costs; and the optimal value.

    Run k times, replace, again for ever: with g the discount,
    V = (sum over i < k of (g (1 - breaks))^i - g^k cost) / (1 - g^(k + 1)), the best k being best
    (replacing takes a step, and the new machine is good).
    """
    run = np.array([[1 - breaks, breaks], [0.0, 1.0]])
    replace = np.array([[1.0, 0.0], [1.0, 0.0]])
    rewards = np.array([[1.0, 0.0], [-cost, -cost]])
    pomdp = array_pomdp([[run], [replace]], rewards, np.array([1.0, 0.0]), discount)
    keep = discount * (1 - breaks)
    values = [
        ((1 - keep**k) / (1 - keep) - discount**k * cost) / (1 - discount ** (k + 1)) for k in range(1, 200)
    ]
    return pomdp, max([*values, 1 / (1 - keep)])


def line(length: int, discount: float, *, flagged: bool) -> ArrayPOMDP:
    """Walk a line of cells to its end, a terminal state: -1 a step; the cell is seen."""
    kernel, observed = [], np.arange(length) if flagged else np.zeros(length, dtype=int)
    for step in (-1, 1):
        rows = np.zeros((length, length))
        for cell in range(length - 1):
            rows[cell, max(cell + step, 0)] += 0.9
            rows[cell, cell] += 0.1
        shown = [rows] if flagged else [rows * (np.arange(length) == cell) for cell in range(length)]
        kernel.append(shown)
    rewards = np.full((2, length), -1.0)
    terminal = np.arange(length) == length - 1
    rewards[:, terminal] = 0.0
    initial = np.append(np.full(length - 1, 1 / (length - 1)), 0.0)
    return array_pomdp(kernel, rewards, initial, discount, terminal=terminal, observed=observed)


def line_value(length: int, discount: float) -> float:
    """The value of always walking right from the uniform start, where the cell is seen or not.

    From n steps away v_n = -1 + discount (0.9 v_(n-1) + 0.1 v_n).
    """
    values = [0.0]
    for _ in range(length - 1):
        values.append((-1 + 0.9 * discount * values[-1]) / (1 - 0.1 * discount))
    return sum(values) / (length - 1)

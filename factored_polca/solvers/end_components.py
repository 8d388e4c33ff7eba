"""End components of an MDP without discount: which may be entered, left, or must be refused.

An end component is a set of states with a set of actions that can keep the process inside it for
ever, every state reaching every other (de Alfaro 1997).  For the total expected reward at discount
1 the components decide whether a value exists:

  * the maximal components of the pairs with reward 0 are *collapsed* to one node each, with a pair
    `STAY` worth 0 (nothing is ever earned there again); what remains has no end component whose
    rewards are all 0 (Haddad & Monmege 2018 do this for reachability);
  * in each maximal component that remains, let g be the largest mean reward per step.
    g > 0: the value is infinite.  g = 0: the sum of the rewards does not settle.  Both are refused.
    g < 0: staying for ever is worth minus infinity, so optimal policies leave; this is what makes
    the Bellman operator T have one fixed point, with  L <= T L  =>  L <= V*  and  U >= T U  =>
    U >= V*  (Bertsekas & Tsitsiklis 1991).

The sign of g is exact where no reward in the component is positive (then g < 0, as some reward on
every cycle is negative) or none is negative (then g > 0).  With mixed signs it follows from
min_i d(i) <= g <= max_i d(i),  d = T h - h at discount 1, for *any* function h on the component
(Puterman 1994, theorem 8.5.6); h by relative value iteration, then by the linear program.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from factored_polca.explicit.arrays import BoolArray, FloatArray, IntArray
from factored_polca.models.errors import Fault, ModelError
from factored_polca.solvers.graph import prune, strong_components
from factored_polca.solvers.pairs import STAY, Pairs, running_total

RELATIVE_ITERATIONS = 2000
MEAN_TOLERANCE = 1e-11
NAMED_STATES = 5
NAMED_COMPONENTS = 5

Describe = Callable[[int], str]


@dataclass(frozen=True)
class Components:
    """Maximal end components of some pairs: `label` [node] (-1: in none), `inside` [p], `count`."""

    label: IntArray
    inside: BoolArray
    count: int


def maximal_end_components(pairs: Pairs, usable: BoolArray) -> Components:
    """The maximal end components of the pairs in `usable`.

    Repeats: strongly connected components; drop the pairs that may leave theirs and the nodes left
    without a pair; until nothing is dropped.
    """
    inside = usable & (np.diff(pairs.row) > 0)
    if not np.any(inside):
        return Components(np.full(pairs.nodes, -1, dtype=np.int64), inside, 0)
    while True:
        label = strong_components(pairs, inside)
        own = np.repeat(label[pairs.owner], np.diff(pairs.row))
        leaving = np.bincount(pairs.pair_of_entry[label[pairs.successor] != own], minlength=pairs.count) > 0
        kept = inside & ~leaving
        empty = np.bincount(pairs.owner[kept], minlength=pairs.nodes) == 0
        _, kept = prune(pairs, empty, kept)
        if np.array_equal(kept, inside):
            break
        inside = kept
    members = np.bincount(pairs.owner[inside], minlength=pairs.nodes) > 0
    compact = np.full(pairs.nodes, -1, dtype=np.int64)
    numbers, compact[members] = np.unique(label[members], return_inverse=True)
    return Components(compact, inside, len(numbers))


def collapse(pairs: Pairs, components: Components) -> tuple[Pairs, IntArray]:
    """`pairs` with each component made one node, and the new node of each old one.

    The pairs inside a component are replaced by one `STAY`.  Nodes keep their order; a component
    stands where its first member stood.
    """
    label = components.label
    member = label >= 0
    representative = np.arange(pairs.nodes)
    first = np.full(components.count, pairs.nodes, dtype=np.int64)
    np.minimum.at(first, label[member], np.flatnonzero(member))
    representative[member] = first[label[member]]
    _, node = np.unique(representative, return_inverse=True)
    node = node.astype(np.int64)
    outer = pairs.keep(~components.inside)
    stays = components.count
    owner = np.concatenate([node[outer.owner], node[first]])
    order = np.argsort(owner, kind="stable")
    length = np.concatenate([np.diff(outer.row), np.zeros(stays, dtype=np.int64)])[order]
    begin = np.concatenate([outer.row[:-1], np.zeros(stays, dtype=np.int64)])[order]
    row = running_total(length)
    entries = np.repeat(begin - row[:-1], length) + np.arange(row[-1])
    stay = np.full(stays, STAY, dtype=np.int64)
    collapsed = Pairs(
        start=running_total(np.bincount(owner, minlength=int(node.max()) + 1)),
        owner=owner[order],
        state=np.concatenate([outer.state, stay])[order],
        action=np.concatenate([outer.action, stay])[order],
        reward=np.concatenate([outer.reward, np.zeros(stays)])[order],
        row=row,
        successor=node[outer.successor[entries]].astype(np.int32),
        probability=outer.probability[entries],
        discount=pairs.discount,
    )
    return collapsed, node


def refuse_unbounded(pairs: Pairs, describe: Describe | None) -> None:
    """Check that every end component of `pairs` (zero-reward ones collapsed) loses reward for ever.

    Raises:
        ModelError: a component has a mean reward that is positive, or 0 with rewards that are not.
    """
    if not np.any(pairs.reward > 0):
        return
    components = maximal_end_components(pairs, pairs.action != STAY)
    faults = list(_component_faults(pairs, components, describe))
    if faults:
        raise ModelError(faults)


def _component_faults(pairs: Pairs, components: Components, describe: Describe | None) -> Iterator[Fault]:
    inside = np.flatnonzero(components.inside)
    label = components.label[pairs.owner[inside]]
    highest = np.full(components.count, -np.inf)
    np.maximum.at(highest, label, pairs.reward[inside])
    order = np.argsort(label, kind="stable")
    begin = np.searchsorted(label[order], np.arange(components.count + 1))
    named = 0
    for number in np.flatnonzero(highest > 0):
        component = _alone(pairs, inside[order[begin[number] : begin[number + 1]]])
        low, high = mean_reward_bounds(component)
        if high >= 0:
            named += 1
            yield _fault(low, high, np.unique(component.state), describe)
        if named == NAMED_COMPONENTS:
            return


def _fault(low: float, high: float, states: IntArray, describe: Describe | None) -> Fault:
    names = [describe(int(s)) if describe else f"state {s}" for s in states[:NAMED_STATES]]
    more = f"; and {len(states) - len(names)} more" if len(states) > len(names) else ""
    listed = "; ".join(names) + more
    path = ("discount",)
    if low > 0:
        return Fault(
            f"the value is infinite at discount 1: one can stay among these states for ever with a "
            f"positive mean reward: {listed}", path,
            "give a discount below 1, a horizon, or make the mean reward of such a loop negative",
        )  # fmt: skip
    return Fault(
        f"the value is undefined at discount 1: one can stay among these states for ever with a mean "
        f"reward of 0 (it lies in [{low:.3g}, {high:.3g}]) though the rewards on the way are not 0, so "
        f"that their sum does not settle: {listed}", path,
        "give a discount below 1, a horizon, or a small cost to each step of the loop",
    )  # fmt: skip


def _alone(pairs: Pairs, chosen: IntArray) -> Pairs:
    """The pairs `chosen`, sorted by node, over their own nodes renumbered; successors lie among them."""
    nodes, owner = np.unique(pairs.owner[chosen], return_inverse=True)
    length = np.diff(pairs.row)[chosen]
    row = running_total(length)
    entries = np.repeat(pairs.row[chosen] - row[:-1], length) + np.arange(row[-1])
    return Pairs(
        start=running_total(np.bincount(owner, minlength=len(nodes))),
        owner=owner.astype(np.int64),
        state=pairs.state[chosen],
        action=pairs.action[chosen],
        reward=pairs.reward[chosen],
        row=row,
        successor=np.searchsorted(nodes, pairs.successor[entries]).astype(np.int32),
        probability=pairs.probability[entries],
        discount=pairs.discount,
    )


def mean_reward_bounds(component: Pairs) -> tuple[float, float]:
    """Bounds on the largest mean reward per step of an end component (all nodes, all pairs inside).

    The upper bound is sound up to rounding, which is added; the lower bound too.
    """
    if component.reward.min() >= 0:
        # Some reward is positive and can be earned again and again; how often does not matter.
        return (float(np.nextafter(0, 1)), float(component.reward.max()))
    scale = float(np.abs(component.reward).max())
    h = np.zeros(component.nodes)
    low, high = -np.inf, np.inf
    for _ in range(RELATIVE_ITERATIONS):
        d, slack = _change(component, h)
        low, high = max(low, d.min() - slack), min(high, d.max() + slack)
        if low > 0 or high < 0 or high - low < MEAN_TOLERANCE * scale:
            return float(low), float(high)
        h = h + 0.5 * (d - d[0])
    d, slack = _change(component, _linear_program(component))
    return float(max(low, d.min() - slack)), float(min(high, d.max() + slack))


def _change(component: Pairs, h: FloatArray) -> tuple[FloatArray, float]:
    """T h - h at discount 1, and a bound on its rounding error."""
    q = component.reward + component.matrix @ h
    d = np.maximum.reduceat(q, component.start[:-1]) - h
    longest = int(np.diff(component.row).max())
    size = float(np.abs(component.reward).max() + np.abs(h).max())
    return d, 2.0**-52 * (longest + 8) * size


def _linear_program(component: Pairs) -> FloatArray:
    """h of: minimise g subject to g + h(i) >= R(p) + sum_t P(t | p) h(t) for each pair p of i."""
    from scipy.optimize import linprog
    from scipy.sparse import csr_array, hstack

    n, count = component.nodes, component.count
    own = csr_array((np.ones(count), (np.arange(count), component.owner)), shape=(count, n))
    gain = csr_array(np.ones((count, 1)))
    constraints = hstack([-gain, component.matrix - own]).tocsr()
    objective = np.zeros(n + 1)
    objective[0] = 1.0
    bounds = [(None, None), (0.0, 0.0)] + [(None, None)] * (n - 1)
    result = linprog(objective, A_ub=constraints, b_ub=-component.reward, bounds=bounds, method="highs")
    h = np.zeros(n) if result.x is None else np.asarray(result.x[1:], dtype=np.float64)
    return h

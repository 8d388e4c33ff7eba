"""The states that can be reached: the closure of the initial belief's support under the actions."""

from __future__ import annotations

from collections.abc import Iterable

from factored_polca.explicit.exact_mdp import ExactMDP


def reachable_states(mdp: ExactMDP, start: Iterable[int] | None = None) -> tuple[bool, ...]:
    """Whether each state can be reached from `start` (None: where the initial belief is positive).

    Terminal states are absorbing: nothing is reached through them.
    """
    waiting = [s for s, chance in enumerate(mdp.initial) if chance] if start is None else list(start)
    seen = set(waiting)
    while waiting:
        s = waiting.pop()
        after = {t for rows in mdp.rows for t in rows[s]} - seen
        seen |= after
        waiting.extend(after)
    return tuple(s in seen for s in range(mdp.states))

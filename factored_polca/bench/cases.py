"""The cases of the benchmark: shipped domains at several sizes, in families whose growth is fitted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Case:
    """A domain with parameters; `interchangeable` counts actions by what they do, not by name.

    `family` and `size` say which growth it is a point of, and where; `quick` cases take a few seconds,
    warm; `peer` is whether another program is asked for the same.
    """

    name: str
    domain: str
    settings: Mapping[str, str] = field(default_factory=dict)
    family: str | None = None
    size: int = 0
    interchangeable: bool = False
    quick: bool = False
    peer: bool = True


def _family(
    family: str, domain: str, sizes: tuple[int, ...], quick_to: int, peer_to: int, **settings: str
) -> list[Case]:
    return [
        Case(
            f"{family} {n}", domain, {"size": str(n), **settings}, family, n,
            quick=n <= quick_to, peer=n <= peer_to,
        )
        for n in sizes
    ]  # fmt: skip


CASES: tuple[Case, ...] = (
    *_family("linear", "linear", (16, 32, 48, 64, 128), 48, 48),
    *_family("expon", "expon", (8, 10, 12, 14), 12, 14),
    *_family("taxi", "taxi", (5, 10, 20, 40, 64), 20, 64),
    Case("taxi 5, 8 noise bits", "taxi", {"noise_bits": "8"}, quick=True),
    *_family("components", "components", (10, 20, 40, 60), 40, 10),
    *_family("sysadmin ring", "sysadmin", (6, 8, 10, 12), 10, 10),
    Case("sysadmin ring 10, interchangeable", "sysadmin", {"size": "10"}, interchangeable=True, quick=True),
    Case(
        "30 machines, interchangeable", "sysadmin", {"size": "30", "topology": "independent"},
        interchangeable=True, quick=True, peer=False,
    ),
)  # fmt: skip
"""In the order in which they run.  A peer that lists states is spared those beyond its means, and so is one
that knows no interchangeable actions: it is given the model with unnamed ones."""


def chosen(words: list[str], quick: bool) -> list[Case]:
    """The cases whose names contain one of `words` (all, if there are none), the quick ones if asked for.

    Raises:
        ValueError: a word that no case's name contains.
    """
    for word in words:
        if not any(word in case.name for case in CASES):
            raise ValueError(
                f"no case has {word!r} in its name; there are {', '.join(c.name for c in CASES)}"
            )
    picked = [case for case in CASES if not words or any(word in case.name for word in words)]
    return [case for case in picked if case.quick or not quick]

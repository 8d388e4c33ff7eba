"""The cases of the benchmark: shipped domains at several sizes, in families whose growth is fitted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Case:
    """A domain with parameters; `interchangeable` counts actions by what they do, not by name.

    `family` and `size` say which growth it is a point of, and where; `quick` cases take a few seconds,
    kernels loaded, `large` ones have 10^5 blocks or nearly so and run only where they are asked for.
    `engines` are the peer's that are worth asking: one that lists states is spared those beyond its means.
    Probabilities are rounded to fractions of `denominator` (0: each case by itself), for all sides, so that
    products of them are exact in the peer's doubles; None leaves them as they are.
    """

    name: str
    domain: str
    settings: Mapping[str, str] = field(default_factory=dict)
    family: str | None = None
    size: int = 0
    interchangeable: bool = False
    quick: bool = False
    large: bool = False
    engines: tuple[str, ...] = ()
    denominator: int | None = None


def _family(
    family: str,
    domain: str,
    sizes: Mapping[int, tuple[str, ...]],
    quick_to: int,
    denominator: int | None,
    large_from: int = 1000,
) -> list[Case]:
    return [
        Case(
            f"{family} {n}", domain, {"size": str(n)}, family, n, quick=n <= quick_to,
            large=n >= large_from, engines=engines, denominator=denominator,
        )
        for n, engines in sizes.items()
    ]  # fmt: skip


SPARSE, DD, BOTH = ("sparse",), ("dd",), ("sparse", "dd")

CASES: tuple[Case, ...] = (
    *_family("linear", "linear", {16: BOTH, 32: DD, 48: DD, 64: (), 128: ()}, 48, 256),
    *_family(
        "expon", "expon",
        {8: BOTH, 10: SPARSE, 12: SPARSE, 14: SPARSE, 16: SPARSE, 17: SPARSE, 18: SPARSE}, 12, 256, 16,
    ),
    *_family(
        "taxi", "taxi",
        {5: BOTH, 10: SPARSE, 20: SPARSE, 40: SPARSE, 64: SPARSE, 128: SPARSE, 256: SPARSE}, 20, None, 128,
    ),
    Case("taxi 5, 8 noise bits", "taxi", {"noise_bits": "8"}, quick=True, engines=BOTH, denominator=4),
    *_family("components", "components", {10: BOTH, 20: (), 40: (), 60: (), 100: ()}, 40, 0),
    *_family(
        "sysadmin ring", "sysadmin",
        {6: BOTH, 8: SPARSE, 10: SPARSE, 12: (), 14: (), 16: (), 18: (), 20: ()}, 10, 32, 16,
    ),
    Case(
        "sysadmin ring 10, interchangeable", "sysadmin", {"size": "10"}, interchangeable=True, quick=True,
        engines=DD, denominator=32,
    ),
    Case(
        "30 machines, interchangeable", "sysadmin", {"size": "30", "topology": "independent"},
        interchangeable=True, quick=True, denominator=4,
    ),
)  # fmt: skip
"""In the order in which they run."""


def chosen(words: list[str], quick: bool, large: bool = False) -> list[Case]:
    """The cases whose names contain one of `words` (all, if there are none), the quick ones if asked for.

    Large ones are among them only with `large`, or where one of `words` is the whole name.

    Raises:
        ValueError: a word that no case's name contains.
    """
    for word in words:
        if not any(word in case.name for case in CASES):
            raise ValueError(
                f"no case has {word!r} in its name; there are {', '.join(c.name for c in CASES)}"
            )
    picked = [case for case in CASES if not words or any(word in case.name for word in words)]
    return [
        case
        for case in picked
        if (case.quick or not quick) and (large or not case.large or case.name in words)
    ]

"""Texts in Cassandra's format, from its grammar (`factored_polca.formats.cassandra`)."""

from __future__ import annotations

from .choices import Choices
from .pieces import chances, discount, name, number

STATES = ("s0", "s1", "s2")
ACTIONS = ("go", "stay")
OBSERVATIONS = ("on", "off")

WORDS = tuple(
    text.encode()
    for text in (
        "T:", "O:", "R:", ":", "*", "identity", "uniform", "reset", "discount:", "values: cost", "states:",
        "actions:",
        "observations:", "start:", "start include:", "start exclude:", "#", "\n", "T: * : * : * 1",
        "T: *\nidentity\n",
        "O: *\nuniform\n", "R: * : * : * : * 1", "0", "1", "0.5 0.5", "states: 2", "states: 100000",
        "states: 99999999",
        "actions: 1000000", "observations: 100000", "T: 0 : 0 : 0 0.5", "states: a b c", "+", "-1", " : ",
        "1 0\n0 1\n",
        "actions: 100000\nstates: 100000\n",
    )
)  # fmt: skip


def cassandra_text(c: Choices) -> bytes:
    """A file."""
    n, m, k = 1 + c.below(3), 1 + c.below(2), 1 + c.below(2)
    mdp = c.rarely(4)
    lines = [f"discount: {discount(c)}", f"values: {'cost' if c.rarely(6) else name(c, ('reward',))}"]
    named = c.below(2) == 1
    lines.append(f"states: {_listed(c, STATES[:n], named)}")
    lines.append(f"actions: {_listed(c, ACTIONS[:m], named)}")
    if not mdp:
        lines.append(f"observations: {_listed(c, OBSERVATIONS[:k], named)}")
    if c.rarely(6):
        lines[-1], lines[-2] = lines[-2], lines[-1]
    match c.below(5):
        case 0:
            lines.append("start: " + " ".join(chances(c, n)))
        case 1:
            lines.append(f"start: {c.one(('uniform', name(c, STATES[:n] if named else ('0',))))}")
        case 2:
            word = c.one(("include", "exclude"))
            lines.append(
                f"start {word}: "
                + " ".join(name(c, STATES[:n] if named else ("0", "1")) for _ in c.some(1, 2))
            )
    if not c.rarely():
        lines += _table(c, f"T: {name(c, ACTIONS[:m]) if c.rarely() else '*'}", n, n, STATES)
    if not mdp and not c.rarely():
        lines += _table(c, "O: *", n, k, OBSERVATIONS)
    for _ in c.some(0, 3):
        lines.append(_entry(c, n, m, k, mdp))
    return "\n".join(lines).encode("utf-8", "surrogatepass")


def _listed(c: Choices, names: tuple[str, ...], named: bool) -> str:
    if not named:
        return str(len(names)) if not c.rarely() else number(c)
    return " ".join(name(c, (word,)) for word in names)


def _table(c: Choices, start: str, rows: int, columns: int, names: tuple[str, ...]) -> list[str]:
    match c.below(6):
        case 0:
            return [start, "uniform"]
        case 1:
            return [start, "identity"]
        case 2:
            return [f"{start} : * {c.one(('uniform', ' '.join(chances(c, columns)), 'reset'))}"]
        case 3:
            return [
                f"{start} : {r} : {name(c, names[j : j + 1]) if c.rarely() else j} {q}"
                for r in range(rows)
                for j, q in enumerate(chances(c, columns))
            ]
        case _:
            return [start, *(" ".join(chances(c, columns)) for _ in range(rows))]


def _entry(c: Choices, n: int, m: int, k: int, mdp: bool) -> str:
    def index(names: tuple[str, ...]) -> str:
        return c.one(("*", "*", "0", str(c.below(len(names))))) if not c.rarely() else name(c, names)

    table = c.one(("R", "R", "R", "R", "T", "O")) if c.rarely(4) else "R"
    wanted = [ACTIONS[:m], STATES[:n], STATES[:n], OBSERVATIONS[:k]]
    if table == "T" or mdp:
        wanted = wanted[:3]
    if table == "O":
        wanted = [ACTIONS[:m], STATES[:n], OBSERVATIONS[:k]]
    if c.rarely(6):
        del wanted[-1:]
    parts = " : ".join(index(names) for names in wanted)
    return f"{table}: {parts} {' '.join(number(c) for _ in range(1 if not c.rarely(6) else c.below(7)))}"

"""Random PRISM programs, deterministic in their seed: modules that synchronise, and what goes with them.

Two or three modules over small variables, some a renamed copy of the first; commands with labels whose
guards may overlap, in one module or several, and commands without; outcomes that assign several variables;
a global variable; constants, formulas, two reward structures.  No update leaves the range of its variable.
"""

from __future__ import annotations

from random import Random

ROWS = (("1",), ("1/2", "1/2"), ("p", "1-p"), ("0.2", "0.3", "0.5"), ("1/7", "6/7"), ("q", "q", "1-2*q"))


class _Program:
    def __init__(self, seed: int) -> None:
        self.random = Random(f"program {seed}")
        self.kind = self.random.choice(("mdp", "mdp", "dtmc"))
        self.count = self.random.randint(2, 3)
        self.top = self.random.randint(1, 2)

    def text(self) -> str:
        random = self.random
        lines = [
            self.kind, f"const int N = {self.top};", "const double p = 1/3;", "const double q = p/2;",
            "formula low = x0=0 | g=1;", "global g : [0..1] init 1;",
        ]  # fmt: skip
        copied = self.count > 2 and random.random() < 0.6
        for index in range(self.count - copied):
            lines += [f"module m{index}", *self.module(index), "endmodule"]
        if copied:
            last = self.count - 1
            renamed = random.choice(("", ", a=c"))
            lines.append(f"module m{last} = m0 [x0=x{last}, b0=b{last}{renamed}] endmodule")
        lines += ['label "goal" = x1=N & b0;', 'rewards "first"']
        lines += [f"{self.guard(range(self.count))} : {random.randint(0, 3)}*x1 + 1/3;" for _ in range(2)]
        lines += [
            f"[{label}] {self.guard(range(self.count))} : g + {k};" for k, label in enumerate(("a", ""))
        ]
        lines += ["endrewards", 'rewards "second" [a] true : low ? 2 : 3; true : x0; endrewards']
        return "\n".join(lines) + "\n"

    def module(self, index: int) -> list[str]:
        random = self.random
        lines = [f"  x{index} : [0..N] init {random.randint(0, self.top)};", f"  b{index} : bool;"]
        labels = ["a", "b", "a", ""] if index == 0 else random.choices(["a", "b", "c", "", ""], k=3)
        if index == 0:
            labels[random.randrange(4)] = random.choice(("a", ""))
        return lines + [self.command(index, label) for label in labels]

    def command(self, index: int, label: str) -> str:
        random = self.random
        row = random.choice(ROWS)
        outcomes = []
        for chance in row:
            changes = self.changes(index, label)
            outcomes.append(f"{chance} : {'&'.join(changes) or 'true'}")
        guard = self.guard(range(self.count) if random.random() < 0.5 else [index])
        return f"  [{label}] {guard} -> {' + '.join(outcomes)};"

    def changes(self, index: int, label: str) -> list[str]:
        random = self.random
        x, other = f"x{index}", f"x{random.randrange(self.count)}"
        numbers = (
            f"min({x}+1, N)",
            f"max({x}-1, 0)",
            "0",
            "N",
            other,
            f"mod({x}+1, N+1)",
            f"(low ? 0 : {other})",
        )
        truths = (f"!b{index}", "true", f"{other}=1", "low & g=1")
        changes = []
        if random.random() < 0.7:
            changes.append(f"(x{index}'={random.choice(numbers)})")
        if random.random() < 0.6:
            changes.append(f"(b{index}'={random.choice(truths)})")
        if not label and random.random() < 0.4:
            changes.append(f"(g'={random.choice(('0', '1-g', 'min(x1, 1)'))})")
        return changes

    def guard(self, modules: range | list[int]) -> str:
        random = self.random
        parts = []
        for _ in range(random.choice((0, 1, 1, 2))):
            i = random.choice(list(modules))
            parts.append(
                random.choice(
                    (f"x{i}=0", f"x{i}<N", f"x{i}>0", f"b{i}", f"!b{i}", "low", f"(b{i} => x{i}=N)")
                )
            )
        return " & ".join(parts) or "true"


def random_program(seed: int) -> str:
    """The text of a random program, an MDP or a DTMC."""
    return _Program(seed).text()

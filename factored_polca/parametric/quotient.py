"""The quotient of a process with parameters: its rows as functions, and the process at a setting.

    K_c(C; C', o)(t) = sum over x' in C' of T(x_C, p, x')(t) P_p(o | x', x_C)(t),    R_c(C)(t),    b0(C)(t)

with x_C the representative of block C, p the primitive that choice c stands for there, and t the parameters
that stay symbols (fully observed: without o).  Every entry is a register of one straight-line program
(`factored_polca.parametric.program`); so an instance costs a run of the program and a gather, and no walk
down a diagram.  The matrices of all instances share their structure, that of the generic setting; entries
that are 0 at a setting (a special value, as p = 0) are left out of its matrices.

Joint observations are merged where their columns are proportional as functions, decided by residues as in
`factored_polca.minimisation.joint_columns`; proportional columns stay so at every admissible setting.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array

from factored_polca.explicit.arrays import ArrayMDP, BoolArray, FloatArray, IntArray, SparseMatrix
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.minimisation import (
    Minimisation,
    Partition,
    Reduction,
    make_pomdp_quotient,
    make_quotient,
)
from factored_polca.minimisation.push import Int32Array
from factored_polca.models.model import rational
from factored_polca.parametric.process import ParametricProcess, checked_setting
from factored_polca.parametric.program import Program

CLEAR: Final = 1e-9
"""From how far a condition's function must be from 0 and 1 for floats to decide."""

Setting = Mapping[str, Fraction | float | str]
"""Values of parameters; a text or a float means its decimal exactly."""


@dataclass(frozen=True)
class RegisterMatrix:
    """A sparse matrix [C, C'] in CSR form whose entries are registers."""

    pointers: Int32Array  # [C], one more at the end
    columns: Int32Array  # [entry]
    registers: IntArray  # [entry]

    def at(self, values: FloatArray) -> SparseMatrix:
        """The matrix with the values [register] for its registers; zeros left out."""
        data, size = values[self.registers], len(self.pointers) - 1
        if data.all():
            return csr_array((data, self.columns, self.pointers), shape=(size, size))
        left = data != 0
        kept = np.concatenate([[0], np.cumsum(left)])[self.pointers]
        return csr_array((data[left], self.columns[left], kept), shape=(size, size))


@dataclass(frozen=True)
class ParametricQuotient:
    """A decision process over blocks whose numbers are functions of parameters.

    `primitive[c, b]` is the primitive that choice c stands for in block b, -1 where not applicable.
    `observations[c]` names the merged observations of choice c; a fully observed process has one.
    """

    process: ParametricProcess
    minimisation: Minimisation
    program: Program
    kernel: tuple[tuple[RegisterMatrix, ...], ...]  # [choice][o]
    rewards: IntArray  # [choice, block] registers
    initial: IntArray  # [block] registers
    primitive: Int32Array  # [choice, block]
    terminal: BoolArray  # [block]
    observed: IntArray  # [block] what is seen of it, from 0
    observations: tuple[tuple[str, ...], ...]  # [choice][o]
    conditions: IntArray  # [condition of the process] the register of its function
    bounded: BoolArray  # [condition] whether it is that of a probability

    @property
    def partition(self) -> Partition:
        """The blocks."""
        return self.minimisation.partition

    @property
    def partial(self) -> bool:
        """Whether the process is partially observed."""
        return self.process.process.partial

    @property
    def parameters(self) -> tuple[str, ...]:
        """The parameters that stay symbols."""
        return self.process.parameters

    def __repr__(self) -> str:
        name, listed = self.process.process.symbolic.model.name, ", ".join(self.parameters)
        return f"<ParametricQuotient of {name} over {listed}: {self.partition.blocks:,} blocks>"

    # -- instances ---------------------------------------------------------------------------

    def setting(self, values: Setting) -> dict[str, Fraction]:
        """A value for every parameter: those of `values`, the model's for the others.

        Raises:
            ModelError: unknown parameters, or a setting that is not admissible.
        """
        return checked_setting(self.process, {name: rational(value) for name, value in values.items()})

    def run(self, values: Setting) -> FloatArray:
        """The value of every register of the program at a setting.

        Raises:
            ModelError: see `setting`.
        """
        given = {name: rational(value) for name, value in values.items()}
        if given.keys() <= set(self.parameters):
            setting = {**self.process.nominal, **given}
            registers = self.run_if_clear(setting)
            if registers is not None:
                return registers
        return self.program.run(self.setting(values))

    def run_if_clear(self, setting: Mapping[str, Fraction]) -> FloatArray | None:
        """The registers at a setting of all parameters, if floats show that it is admissible."""
        try:
            registers = self.program.run(setting)
        except (ZeroDivisionError, OverflowError):
            return None
        tested = registers[self.conditions]
        below = np.where(self.bounded, 1.0 - tested, 1.0)
        clear = np.where(self.bounded, tested, np.abs(tested))
        return registers if bool(((clear > CLEAR) & (below > CLEAR)).all()) else None

    def mdp(self, values: Setting) -> ArrayMDP:
        """The quotient at a setting of the parameters.

        Raises:
            TypeError: the process is partially observed.
            ModelError: see `setting`.
        """
        if self.partial:
            raise TypeError("the process is partially observed; use pomdp(...)")
        return self.mdp_of(self.run(values))

    def pomdp(self, values: Setting) -> ArrayPOMDP:
        """The quotient of a partially observed process at a setting of the parameters.

        Raises:
            TypeError: the process is fully observed.
            ModelError: see `setting`.
        """
        if not self.partial:
            raise TypeError("the process is fully observed; use mdp(...)")
        return self.pomdp_of(self.run(values))

    def mdp_of(self, registers: FloatArray) -> ArrayMDP:
        """The quotient for the values of all registers."""
        symbolic = self.process.process.symbolic
        return ArrayMDP(
            self.process.process.names,
            tuple(matrices[0].at(registers) for matrices in self.kernel),
            registers[self.rewards],
            self.primitive >= 0,
            self.terminal,
            float(symbolic.model.discount),
        )

    def pomdp_of(self, registers: FloatArray) -> ArrayPOMDP:
        """The quotient of a partially observed process for the values of all registers."""
        return ArrayPOMDP(
            self.process.process.names,
            self.observations,
            tuple(tuple(matrix.at(registers) for matrix in matrices) for matrices in self.kernel),
            registers[self.rewards],
            self.terminal,
            self.observed,
            registers[self.initial],
            float(self.process.process.symbolic.model.discount),
        )

    def initial_distribution(self, values: Setting) -> FloatArray:
        """b0 over blocks at a setting, [block]."""
        return np.asarray(self.run(values)[self.initial])

    def exact_row(self, choice: int, block: int, values: Setting) -> dict[tuple[int, int], Fraction]:
        """The exact probability of each (next block, observation) at a setting; zeros left out."""
        entries = self._entries(choice, block)
        found = self.program.run_exactly(self.setting(values), np.array([r for _, r in entries], np.int64))
        return {key: found[register] for key, register in entries if found[register]}

    def exact_reward(self, choice: int, block: int, values: Setting) -> Fraction:
        """The exact reward at a setting; 0 where the choice is not applicable."""
        register = self.rewards[choice, block]
        return self.program.run_exactly(self.setting(values), np.array([register]))[int(register)]

    def reduction(self, values: Setting) -> Reduction:
        """The reduction at a setting by the same partition: it projects beliefs and lifts policies.

        It is made anew from the model's numbers at the setting, without the program: slower, and a check.

        Raises:
            ModelError: see `setting`.
        """
        process = self.process.at(self.setting(values))
        partition = replace(self.partition, symbolic=process.symbolic)
        found = replace(self.minimisation, process=process, partition=partition)
        if process.partial:
            return Reduction(found, make_pomdp_quotient(process, partition))
        return Reduction(found, make_quotient(process, partition))

    # -- functions ---------------------------------------------------------------------------

    def row(self, choice: int, block: int) -> dict[tuple[int, int], Fraction]:
        """The probability of each (next block, observation), as functions of the parameters.

        They are of the type `RationalFunction`, or Fractions where they are constant.

        Raises:
            LimitReached: functions of more degrees, terms or digits than are written out.
        """
        entries = self._entries(choice, block)
        found = self.program.functions(np.array([register for _, register in entries], dtype=np.int64))
        return {key: found[register] for key, register in entries}

    def reward(self, choice: int, block: int) -> Fraction:
        """The reward as a function of the parameters."""
        register = int(self.rewards[choice, block])
        return self.program.functions(np.array([register]))[register]

    def expression(self, block: int, action: str, next_block: int, observation: int = 0) -> Any:
        """An entry as a sympy expression in the parameters, factored.

        Raises:
            KeyError: no such action; the message lists those there are.
        """
        return _sympy(self.row(self._choice(action), block).get((next_block, observation), Fraction(0)))

    def reward_expression(self, block: int, action: str) -> Any:
        """A reward as a sympy expression in the parameters, factored."""
        return _sympy(self.reward(self._choice(action), block))

    def to_sympy(self) -> dict[str, Any]:
        """The rows as sympy matrices [C, C'] by action, or lists of them by observation.

        Raises:
            LimitReached: functions of more degrees, terms or digits than are written out.
        """
        import sympy

        result: dict[str, Any] = {}
        size = self.partition.blocks
        for c, name in enumerate(self.process.process.names):
            entries: list[dict[tuple[int, int], Any]] = [{} for _ in self.kernel[c]]
            for block in range(size):
                for (target, o), function in self.row(c, block).items():
                    entries[o][block, target] = _sympy(function)
            matrices = [sympy.SparseMatrix(size, size, found) for found in entries]
            result[name] = matrices if self.partial else matrices[0]
        return result

    def _choice(self, action: str) -> int:
        names = self.process.process.names
        if action not in names:
            raise KeyError(f"no action {action!r}; there are {', '.join(names)}")
        return names.index(action)

    def _entries(self, choice: int, block: int) -> list[tuple[tuple[int, int], int]]:
        """((next block, observation), register) of a row."""
        result = []
        for o, matrix in enumerate(self.kernel[choice]):
            part = slice(int(matrix.pointers[block]), int(matrix.pointers[block + 1]))
            pairs = zip(matrix.columns[part].tolist(), matrix.registers[part].tolist(), strict=True)
            result += [((target, o), register) for target, register in pairs]
        return result


def _sympy(value: Fraction) -> Any:
    """A number or function as a sympy expression."""
    import sympy

    from factored_polca.models.rational_functions import RationalFunction

    if isinstance(value, RationalFunction):
        return value.to_sympy()
    return sympy.Rational(value.numerator, value.denominator)


def register_matrix(rows: list[dict[int, int]], blocks: int) -> RegisterMatrix:
    """A matrix from its rows [C] {C': register}, entries outside the blocks left out."""
    kept = [sorted((c, r) for c, r in row.items() if c < blocks) for row in rows]
    pointers = np.cumsum([0, *map(len, kept)]).astype(np.int32)
    columns = np.array([c for row in kept for c, _ in row], dtype=np.int32)
    registers: npt.NDArray[np.int64] = np.array([r for row in kept for _, r in row], dtype=np.int64)
    return RegisterMatrix(pointers, columns, registers)

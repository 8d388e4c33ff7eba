"""Parametric models: minimised once with parameters as symbols, instantiated at each setting."""

from factored_polca.parametric.conditions import Condition
from factored_polca.parametric.process import (
    ParametricProcess,
    compile_parametric,
    parametric_flat_process,
    parametric_process,
)
from factored_polca.parametric.quotient import ParametricQuotient
from factored_polca.parametric.reduction import make_parametric_quotient, reduce_parametric

__all__ = [
    "Condition",
    "ParametricProcess",
    "ParametricQuotient",
    "compile_parametric",
    "make_parametric_quotient",
    "parametric_flat_process",
    "parametric_process",
    "reduce_parametric",
]

"""Exact model minimisation on diagrams: criterion, partition, refinement, quotient, the way back."""

from factored_polca.minimisation.certify import Certificate, certify
from factored_polca.minimisation.criterion import Choice, DecisionProcess, flat_process
from factored_polca.minimisation.interchangeable import InterchangeableQuotient, interchangeable_quotient
from factored_polca.minimisation.observations import ObservationCount, observation_counts
from factored_polca.minimisation.partition import Partition, partition_from
from factored_polca.minimisation.pomdp_quotient import PomdpQuotient, make_pomdp_quotient
from factored_polca.minimisation.quotient import Quotient, make_quotient
from factored_polca.minimisation.reduction import Reduction, reduce
from factored_polca.minimisation.refine import Minimisation, minimise
from factored_polca.minimisation.unreduced import Unreduced, unreduced, unreduced_mdp, unreduced_pomdp

__all__ = [
    "Certificate",
    "Choice",
    "DecisionProcess",
    "InterchangeableQuotient",
    "Minimisation",
    "ObservationCount",
    "Partition",
    "PomdpQuotient",
    "Quotient",
    "Reduction",
    "Unreduced",
    "certify",
    "flat_process",
    "interchangeable_quotient",
    "make_pomdp_quotient",
    "make_quotient",
    "minimise",
    "observation_counts",
    "partition_from",
    "reduce",
    "unreduced",
    "unreduced_mdp",
    "unreduced_pomdp",
]

"""Execution of plans: the polling controller, and trackers of beliefs."""

from factored_polca.control.block_tracker import BlockBelief, BlockTracker, make_block_tracker
from factored_polca.control.controller import Controller, Decision, Poll
from factored_polca.control.diagram_tracker import DiagramBelief, DiagramTracker
from factored_polca.control.particle_tracker import Depleted, ParticleBelief, ParticleTracker
from factored_polca.control.received import Received
from factored_polca.control.tracker import (
    Belief,
    ChosenTracker,
    Tracker,
    choose_tracker,
    independent_belief,
)
from factored_polca.explicit.belief import ImpossibleObservation

__all__ = [
    "Belief",
    "BlockBelief",
    "BlockTracker",
    "ChosenTracker",
    "Controller",
    "Decision",
    "Depleted",
    "DiagramBelief",
    "DiagramTracker",
    "ImpossibleObservation",
    "ParticleBelief",
    "ParticleTracker",
    "Poll",
    "Received",
    "Tracker",
    "choose_tracker",
    "independent_belief",
    "make_block_tracker",
]

"""Simulation of plans on the original model."""

from factored_polca.simulation.sampler import Sampler
from factored_polca.simulation.simulate import Simulation, default_steps, simulate

__all__ = ["Sampler", "Simulation", "default_steps", "simulate"]

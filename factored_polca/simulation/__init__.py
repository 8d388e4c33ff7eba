"""Simulation of plans on the original model, and of flat policies on arrays."""

from factored_polca.simulation.pomdp import simulate_policy
from factored_polca.simulation.sampler import Sampler
from factored_polca.simulation.simulate import Simulation, default_steps, simulate

__all__ = ["Sampler", "Simulation", "default_steps", "simulate", "simulate_policy"]

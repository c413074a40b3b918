"""Variants of a pipeline, run at several seeds, and the values that metrics have there."""

from .experiment import SECONDS, Experiment
from .variant import Variant, run_file, steps_for

__all__ = ["SECONDS", "Experiment", "Variant", "run_file", "steps_for"]

"""Variants of a pipeline, run at several seeds, and the values that metrics have there."""

from .experiment import SECONDS, Experiment, Values
from .variant import Variant, run_file, steps_for

__all__ = ["SECONDS", "Experiment", "Values", "Variant", "run_file", "steps_for"]

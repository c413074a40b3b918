"""From operators to a pipeline: checks of the arguments, the order of the steps, the signals."""

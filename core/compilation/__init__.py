"""Compiled kernels: where they are kept from run to run, and who compiles them when."""

"""The framework: data, operator, pipeline, configuration, registry, random streams, execution.
Knows no operator.
"""

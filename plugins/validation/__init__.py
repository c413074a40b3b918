"""The claims of the paper that zonda follows, measured again: claims, runs, verdicts, and the page
that shows them.
"""

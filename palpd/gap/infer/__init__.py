"""Fits of hypotheses, their evidence, the search over sets of effects, and what the likeliest sets say of the gap."""

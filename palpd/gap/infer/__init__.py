"""Fits of hypotheses, their evidence, the search over sets, and what the best ones say of the gap."""

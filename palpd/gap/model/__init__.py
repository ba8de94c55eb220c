"""Predictions of the simulated cell for the observations, their columns for tolerances, and the coordinates of effects."""

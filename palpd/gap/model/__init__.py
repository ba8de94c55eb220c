"""Predictions f of the simulated cell for the bins y, the columns A of its tolerances, and the coordinates u of effects."""

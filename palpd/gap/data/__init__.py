"""From the rows of a recording to binned observations: phases, bins, noise as stated and as measured, rounding, scatter."""

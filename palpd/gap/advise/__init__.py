"""What to record next: the motions that a plan can describe, which hypotheses each would separate, and the rivals of a law."""

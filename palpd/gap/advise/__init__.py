"""What to record next: the motions that can be made, what each would separate, the rivals of a law."""

"""A diagnosis as one page: its text, figures and sketches."""

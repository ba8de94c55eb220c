"""One emulated cell for all tests of this folder: each begins at rest above a wall of its own."""

from palpd.testing.fixtures import cb3, cell

__all__ = ["cb3", "cell"]

"""`palpd setup`: from an empty folder to the first press, step by step (docs/how-to/setup.md)."""

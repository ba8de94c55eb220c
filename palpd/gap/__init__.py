"""Where measurement and simulation disagree, which effects or laws explain it, how far the gap closes.

docs/explanation/inference.md states the model. The docstrings here use its symbols.
"""

"""Test cells whose physics is MuJoCo's: rigs, tissue, sensor, effects and the sealed truth, written from the contract alone.

The contract is docs/reference/contract.md.
"""

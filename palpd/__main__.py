"""`python -m palpd` is `palpd`."""

from palpd.cli import main

main()

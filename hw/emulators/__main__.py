"""`python -m hw.emulators`: the emulators, until stopped."""

import argparse
import sys
from pathlib import Path

from hw.emulators.controller_state import MODELS
from hw.emulators.process import emulate
from palpd.errors import PalpdError


def main() -> int:
    """Parse the command line and run."""
    parser = argparse.ArgumentParser(prog="python -m hw.emulators", description="A UR controller and a HEX-70 before one emulated cell.")
    parser.add_argument("--model", choices=sorted(MODELS), default="ur5", help="ur5: CB3, 125 Hz; ur5e: e-Series, 500 Hz")
    parser.add_argument("--cell", type=Path, help="cell file (default: the paper's phantom)")
    parser.add_argument("--host", default="127.0.0.1", help="address that the controller listens on")
    parser.add_argument("--sensor-link", type=Path, help="link to make to the sensor's terminal device")
    parser.add_argument("--control", type=Path, help="unix socket for faults and truth")
    parser.add_argument("--seed", type=int, default=0, help="seed of every random number")
    parser.add_argument("--mount-rotation-rad", type=float, default=0.0, help="rotation of the sensor about the flange's z")
    parser.add_argument("--fz-parts-at", choices=("reading", "load"), default="reading", help="where Fz changes its slope")
    parser.add_argument("--no-realtime", dest="realtime", action="store_false", help="do not ask for SCHED_FIFO")
    parser.add_argument("--end-with-parent", action="store_true", help="end when the process that started this one is gone")
    parser.add_argument("--effects", type=Path, help="a Python file of a user's effects that the cell file may name")
    parser.add_argument("--net-ft-port", type=int, help="an ATI Net F/T in place of the HEX-70, with its page on this port")
    try:
        emulate(**vars(parser.parse_args()))
    except PalpdError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())

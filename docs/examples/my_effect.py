"""An effect of one's own: the pulse in a vessel below the tip makes the contact force beat.

`palpd diagnose RECORDING --cell cell.yaml --effects my_effect.py` weighs it against the library's, and a cell file may name it.
A law changes the samples `s` of its site (here what the tip feels, s.contact_N); bounds and starts follow the size of the recording.
"""

import numpy as np

from palpd.cell.effects import Effect, Parameter


def pulse(s, p, memory):
    beat = np.sin(2 * np.pi * p["frequency_Hz"] * s.t_s + p["phase_rad"])
    s.contact_N = s.contact_N * (1 + p["share"] * beat)


EFFECTS = [
    Effect(
        "tissue.pulse",
        site="tissue",
        what="the contact force beats with a pulse",
        parameters=(
            Parameter("share", "1", lower=0.0, upper=1.0, typical=(0.05,)),
            Parameter("frequency_Hz", "Hz", lower=0.5, upper=4.0, typical=(1.0, 1.5), nominal=None, log=True),
            Parameter("phase_rad", "rad", lower=-np.pi, upper=np.pi, typical=(0.0, 2.0, -2.0), nominal=None),
        ),
        law=pulse,
    )
]

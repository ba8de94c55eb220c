"""Makes recordings/ from a checkout of github.com/dfki-ric-underactuated-lab/double_pendulum.

`python -m benchmarks.arena.dp_acrobot_pilco.convert FOLDER`
"""

from benchmarks.arena.converters import double_pendulum, folders

RECORDINGS = {
    "h1.csv": "acrobot/real_hardware_v2/src_data/mcpilco/experiment01/trajectory.csv",
    "h2.csv": "acrobot/real_hardware_v2/src_data/mcpilco/experiment02/trajectory.csv",
    "h3.csv": "acrobot/real_hardware_v2/src_data/mcpilco/experiment03/trajectory.csv",
    "h4.csv": "acrobot/real_hardware_v2/src_data/mcpilco/experiment04/trajectory.csv",
    "j1.csv": "acrobot/real_hardware_v2/src_data/mcpilco/experiment10/trajectory.csv",
    "j2.csv": "acrobot/real_hardware_v2/src_data/mcpilco/experiment08/trajectory.csv",
    "j3.csv": "acrobot/real_hardware_v2/src_data/mcpilco/experiment06/trajectory.csv",
    "j4.csv": "acrobot/real_hardware_v2/src_data/mcpilco/experiment07/trajectory.csv",
    "j5.csv": "acrobot/real_hardware_v2/src_data/mcpilco/experiment05/trajectory.csv",
    "j6.csv": "acrobot/real_hardware_v2/src_data/mcpilco/experiment09/trajectory.csv",
}

if __name__ == "__main__":
    double_pendulum(*folders(__file__), RECORDINGS, joint=2, rate_Hz=33, every=1)

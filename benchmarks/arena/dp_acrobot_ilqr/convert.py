"""Makes recordings/ from a checkout of github.com/dfki-ric-underactuated-lab/double_pendulum.

`python -m benchmarks.arena.dp_acrobot_ilqr.convert FOLDER`
"""

from benchmarks.arena.converters import double_pendulum, folders

RECORDINGS = {
    "h1.csv": "acrobot/real_hardware_v2/src_data/ilqr_tvlqr_lqr/experiment01/trajectory.csv",
    "h2.csv": "acrobot/real_hardware_v2/src_data/ilqr_tvlqr_lqr/experiment02/trajectory.csv",
    "h3.csv": "acrobot/real_hardware_v2/src_data/ilqr_tvlqr_lqr/experiment03/trajectory.csv",
    "h4.csv": "acrobot/real_hardware_v2/src_data/ilqr_tvlqr_lqr/experiment04/trajectory.csv",
    "j1.csv": "acrobot/real_hardware_v2/src_data/ilqr_tvlqr_lqr/experiment08/trajectory.csv",
    "j2.csv": "acrobot/real_hardware_v2/src_data/ilqr_tvlqr_lqr/experiment09/trajectory.csv",
    "j3.csv": "acrobot/real_hardware_v2/src_data/ilqr_tvlqr_lqr/experiment06/trajectory.csv",
    "j4.csv": "acrobot/real_hardware_perturbed_v2/src_data/ilqr_tvlqr_lqr/experiment03/trajectory.csv",
    "j5.csv": "acrobot/real_hardware_perturbed_v2/src_data/ilqr_tvlqr_lqr/experiment01/trajectory.csv",
    "j6.csv": "acrobot/real_hardware_perturbed_v2/src_data/ilqr_tvlqr_lqr/experiment05/trajectory.csv",
    "j7.csv": "acrobot/real_hardware_perturbed_v2/src_data/ilqr_tvlqr_lqr/experiment02/trajectory.csv",
    "j8.csv": "acrobot/real_hardware_v2/src_data/ilqr_tvlqr_lqr/experiment07/trajectory.csv",
    "j9.csv": "acrobot/real_hardware_perturbed_v2/src_data/ilqr_tvlqr_lqr/experiment04/trajectory.csv",
    "j10.csv": "acrobot/real_hardware_v2/src_data/ilqr_tvlqr_lqr/experiment05/trajectory.csv",
    "j11.csv": "acrobot/real_hardware_v2/src_data/ilqr_tvlqr_lqr/experiment10/trajectory.csv",
    "j12.csv": "acrobot/real_hardware_perturbed_v2/src_data/ilqr_tvlqr_lqr/experiment06/trajectory.csv",
}

if __name__ == "__main__":
    double_pendulum(*folders(__file__), RECORDINGS, joint=2, rate_Hz=400, every=4)

"""
Published results of the same tasks, to stand beside ours.

Source: Zhang et al., Learning Agile and Robust Omnidirectional Aerial Motion on
Overactuated Tiltable-Quadrotors: tables of continuous pose reaching in simulation
(100 random poses) and in the real world (five waypoints), and the text on tracking.
"""

from __future__ import annotations

RANDOM_POSES = {
    'NMPC': {'mean': {'U_position_m': 0.02, 'U_orientation_deg': 40.99,
                      'L_position_m': 0.31, 'L_orientation_deg': 51.75},
             'max': {'U_position_m': 0.116, 'U_orientation_deg': 136.97,
                     'L_position_m': 0.76, 'L_orientation_deg': 143.15},
             'hover_speed_mean_m_s': 0.008, 'hover_angular_speed_mean_rad_s': 0.007,
             'joint_error_mean_rad': 0.004, 'thrust_mean_N': 9.17},
    'RL': {'mean': {'U_position_m': 0.08, 'U_orientation_deg': 5.89,
                    'L_position_m': 0.18, 'L_orientation_deg': 13.59},
           'max': {'U_position_m': 0.232, 'U_orientation_deg': 85.49,
                   'L_position_m': 0.58, 'L_orientation_deg': 104.35},
           'hover_speed_mean_m_s': 0.015, 'hover_angular_speed_mean_rad_s': 0.012,
           'joint_error_mean_rad': 0.026, 'thrust_mean_N': 10.08},
}

WAYPOINTS = {
    'NMPC, real robot': {'mean': {'U_position_m': 0.042, 'U_orientation_deg': 4.350},
                         'max': {'U_position_m': 0.074, 'U_orientation_deg': 8.225}},
    'RL, real robot': {'mean': {'U_position_m': 0.077, 'U_orientation_deg': 4.261},
                       'max': {'U_position_m': 0.114, 'U_orientation_deg': 5.561}},
}

LEMNISCATE = {
    'NMPC, real robot': {'position_mean_m': 0.05, 'position_std_m': 0.02,
                         'orientation_mean_deg': 5.19, 'orientation_std_deg': 2.46},
    'RL, real robot': {'position_mean_m': 0.16, 'position_std_m': 0.04,
                       'orientation_mean_deg': 8.06, 'orientation_std_deg': 2.45},
}


def pose_results(task: str) -> dict[str, dict]:
    """Published results of a pose task, in the form of our metrics; empty where there are none."""
    if task.startswith('random'):
        return RANDOM_POSES
    return WAYPOINTS if task == 'waypoints' else {}


def tracking_results(task: str) -> dict[str, dict]:
    """Published tracking results of a task."""
    return LEMNISCATE if task == 'lemniscate' else {}

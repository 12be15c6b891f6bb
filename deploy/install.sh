#!/bin/sh
# Prepare the onboard computer: names of the serial ports, real-time limits, a service for the
# bridges. It changes system files only. A second run changes nothing.
#
#   sudo deploy/install.sh [OPTION...]
#
#   --user NAME          user of the nodes; default: the user who called sudo
#   --workspace DIR      colcon workspace with .venv and install; default: ~NAME/ws
#   --servo-serial TEXT  serial number of the servos' adapter (U2D2); default: any
#   --board-serial TEXT  serial number of the motor board (STM32); default: any
#   --robot FILE         robot file of the bridges; default: the shipped one
#   --servo-bus FILE     file in place of params/servo_bus.yaml
#   --motor-board FILE   file in place of params/motor_board.yaml
#   --no-service         do not install the service
#   --uninstall          remove all installed files
#   --root DIR           dry run: write below DIR and call no system program
#
# The service runs the only bridges of the robot: it opens both ports and reads. It switches no
# torque on, and the motor board cannot be armed; docs/tutorials/hardware_flight.md flies.
set -eu

ROOT=
NAME=${SUDO_USER:-$(id -un)}
WORKSPACE=
SERVO_SERIAL=
BOARD_SERIAL=
ROBOT=
SERVO_BUS=
MOTOR_BOARD=
SERVICE=yes
REMOVE=

RULES=/etc/udev/rules.d/99-beetle-omni.rules
LIMITS=/etc/security/limits.d/99-beetle-omni.conf
UNIT=beetle-omni-bridges.service
UNIT_FILE=/etc/systemd/system/$UNIT

say() { printf 'install: %s\n' "$1"; }
fail() { printf 'install: error: %s\n' "$1" >&2; exit 2; }

value() { [ $# -ge 2 ] && [ -n "$2" ] || fail "$1: expected a value"; }

while [ $# -gt 0 ]; do
    case $1 in
        --user) value "$@"; NAME=$2; shift ;;
        --workspace) value "$@"; WORKSPACE=$2; shift ;;
        --servo-serial) value "$@"; SERVO_SERIAL=$2; shift ;;
        --board-serial) value "$@"; BOARD_SERIAL=$2; shift ;;
        --robot) value "$@"; ROBOT=$2; shift ;;
        --servo-bus) value "$@"; SERVO_BUS=$2; shift ;;
        --motor-board) value "$@"; MOTOR_BOARD=$2; shift ;;
        --root) value "$@"; ROOT=${2%/}; shift ;;
        --no-service) SERVICE= ;;
        --uninstall) REMOVE=yes ;;
        -h|--help) sed -n '2,/^set -eu/s/^# \{0,1\}//p' "$0"; exit 0 ;;
        *) fail "unknown option '$1'; --help lists them" ;;
    esac
    shift
done

# The values go into files of the system, so that they may hold no more than names do.
plain() {
    case $2 in
        *[!A-Za-z0-9_./@:+-]*) fail "$1 '$2': expected letters, digits and _ . / @ : + - alone" ;;
    esac
}
for pair in "--user=$NAME" "--workspace=$WORKSPACE" "--servo-serial=$SERVO_SERIAL" \
        "--board-serial=$BOARD_SERIAL" "--robot=$ROBOT" "--servo-bus=$SERVO_BUS" \
        "--motor-board=$MOTOR_BOARD"; do
    plain "${pair%%=*}" "${pair#*=}"
done
case $WORKSPACE in ''|/*) ;; *) fail "--workspace '$WORKSPACE': expected an absolute path" ;; esac
for pair in "--robot=$ROBOT" "--servo-bus=$SERVO_BUS" "--motor-board=$MOTOR_BOARD"; do
    case ${pair#*=} in
        '') ;;
        /*) [ -f "${pair#*=}" ] || fail "${pair%%=*} ${pair#*=}: no such file" ;;
        *) fail "${pair%%=*} '${pair#*=}': expected an absolute path" ;;
    esac
done

if [ -z "$ROOT" ]; then
    [ "$(id -u)" = 0 ] || fail 'needs root: sudo deploy/install.sh, or --root DIR to try it'
    id "$NAME" >/dev/null 2>&1 || fail "--user $NAME: no such user"
    HOME_OF=$(getent passwd "$NAME" | cut -d: -f6)
elif [ ! -d "$ROOT" ]; then
    fail "--root $ROOT: no such folder"
else
    HOME_OF=/home/$NAME
fi
WORKSPACE=${WORKSPACE:-$HOME_OF/ws}

# Call a program of the system, unless this is a dry run.
system() { [ -n "$ROOT" ] || "$@"; }

CHANGED=
# Write standard input to $1, if it is different.
put() {
    file=$ROOT$1
    mkdir -p "${file%/*}"
    temporary=$(mktemp "$file.XXXXXX")
    cat >"$temporary"
    if cmp -s "$temporary" "$file"; then
        rm -f "$temporary"
        say "unchanged $file"
    else
        chmod 644 "$temporary"
        mv "$temporary" "$file"
        CHANGED="$CHANGED $1"
        say "wrote $file"
    fi
}

drop() {
    if [ -e "$ROOT$1" ]; then
        rm -f "$ROOT$1"
        CHANGED="$CHANGED $1"
        say "removed $ROOT$1"
    fi
}

reload() {
    case $CHANGED in *"$RULES"*)
        system udevadm control --reload
        system udevadm trigger --subsystem-match=tty --subsystem-match=usb-serial ;;
    esac
    case $CHANGED in *"$UNIT_FILE"*) system systemctl daemon-reload ;; esac
}

if [ -n "$REMOVE" ]; then
    [ ! -e "$ROOT$UNIT_FILE" ] || system systemctl disable --now "$UNIT" || true
    drop "$UNIT_FILE"
    drop "$LIMITS"
    drop "$RULES"
    reload
    say 'removed; the group dialout of the user stays'
    exit 0
fi

put "$RULES" <<RULE
# Written by beetle_omni_ros, deploy/install.sh.
# Servos: U2D2 or another FTDI FT232H. Answers are handed over after 1 ms instead of 16.
SUBSYSTEM=="tty", ATTRS{idVendor}=="0403", ATTRS{idProduct}=="6014",${SERVO_SERIAL:+ ATTRS{serial\}==\"$SERVO_SERIAL\",} SYMLINK+="beetle_servos", GROUP="dialout", MODE="0660", ENV{ID_MM_DEVICE_IGNORE}="1"
ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{latency_timer}="1"
# Motor board: USB of an STM32. ModemManager keeps its hands off.
SUBSYSTEM=="tty", ATTRS{idVendor}=="0483", ATTRS{idProduct}=="5740",${BOARD_SERIAL:+ ATTRS{serial\}==\"$BOARD_SERIAL\",} SYMLINK+="motor_board", GROUP="dialout", MODE="0660", ENV{ID_MM_DEVICE_IGNORE}="1"
RULE

put "$LIMITS" <<LIMIT
# Written by beetle_omni_ros, deploy/install.sh. Nodes of the control loop run at real-time
# priority 1, and keep their memory.
$NAME - rtprio 10
$NAME - memlock unlimited
$NAME - nice -10
LIMIT

system usermod -aG dialout "$NAME"

if [ -n "$SERVICE" ]; then
    put "$UNIT_FILE" <<SERVICE
# Written by beetle_omni_ros, deploy/install.sh.
[Unit]
Description=Bridges to servos and motor board, without torque and disarmed
After=network.target
StartLimitIntervalSec=0

[Service]
User=$NAME
SupplementaryGroups=dialout
LimitRTPRIO=10
LimitMEMLOCK=infinity
ExecStart=/bin/bash -c '. /opt/ros/jazzy/setup.bash && . $WORKSPACE/.venv/bin/activate && . $WORKSPACE/install/setup.bash && exec python3 -m beetle_omni_ros.start composed joint_bridge_node rotor_bridge_node --ros-args -p joint_bridge_node:autostart:=configure -p joint_bridge_node:port:=/dev/beetle_servos -p rotor_bridge_node:autostart:=configure -p rotor_bridge_node:port:=/dev/motor_board${ROBOT:+ -p joint_bridge_node:robot_file:=$ROBOT -p rotor_bridge_node:robot_file:=$ROBOT}${SERVO_BUS:+ -p joint_bridge_node:servo_bus_file:=$SERVO_BUS}${MOTOR_BOARD:+ -p rotor_bridge_node:motor_board_file:=$MOTOR_BOARD}'
# SIGINT: torque off, disarmed, ports closed.
KillSignal=SIGINT
TimeoutStopSec=10
Restart=on-failure
RestartSec=2

[Install]
WantedBy=multi-user.target
SERVICE
else
    [ ! -e "$ROOT$UNIT_FILE" ] || system systemctl disable --now "$UNIT" || true
    drop "$UNIT_FILE"
fi

reload
if [ -n "$SERVICE" ]; then
    system systemctl enable "$UNIT"
    say "at the next start of the computer, or after: systemctl start $UNIT"
fi
say 'done; log in again for the group dialout and the limits'

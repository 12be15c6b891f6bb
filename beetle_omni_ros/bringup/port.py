"""Check of a serial port: existence, permission, processes that use it, latency timer."""

import grp
import os
from pathlib import Path
import pwd
import stat

from beetle_omni_ros.bringup.finding import FAIL, Finding, OK

SYS, PROC = Path('/sys'), Path('/proc')
SHOWN_COMMAND = 90      # characters of a command line
USB_DEPTH = 6           # folders from a tty up to its USB device


def port_finding(item: str, path: str, sys_root: Path = SYS, proc_root: Path = PROC) -> Finding:
    """
    Check a port without opening it; ``path`` may be a link.

    ``values['holders']`` of the finding is the number of processes that have it open.
    """
    try:
        status = os.stat(path)
    except PermissionError:
        return Finding(item, FAIL, f'{path}: no permission for its folder',
                       'ask the owner of the folder')
    except OSError:
        if os.path.islink(path):
            return Finding(item, FAIL, f'{path}: the link leads to {os.readlink(path)}, which '
                           'does not exist', 'plug the adapter in again')
        return _absent(item, path, sys_root)
    if not stat.S_ISCHR(status.st_mode):
        return Finding(item, FAIL, f'{path}: no serial port',
                       'name the device, such as /dev/ttyUSB0')
    if not os.access(path, os.R_OK | os.W_OK):
        return _forbidden(item, path, status)
    holding = holders(path, proc_root)
    if holding:
        names = '; '.join(f'{pid} ({command})' for pid, command in holding)
        return Finding(item, FAIL, f'{path}: used by process {names}', _free(holding),
                       {'holders': len(holding)})
    real = os.path.realpath(path)
    name = path if real == path else f'{path} ({real})'
    product = usb_product(real, sys_root)
    return Finding(item, OK, f'{name}, {product}' if product else name)


def _absent(item, path, sys_root):
    ports = usb_ports(sys_root)
    if ports:
        present = '; '.join(f'{device}: {product}' for device, product in ports.items())
        remedy = (f'name one of the present ports ({present}), or give it this name by the udev '
                  'rule of docs/how-to/hardware.md')
    else:
        remedy = 'no USB serial port is present: plug the adapter in, check `dmesg`'
    return Finding(item, FAIL, f'{path}: no such port', remedy)


def _forbidden(item, path, status):
    user, group = _name(pwd.getpwuid, os.geteuid()), _name(grp.getgrgid, status.st_gid)
    found = f'{path}: no permission for {user} ({stat.filemode(status.st_mode)}, group {group})'
    wanted = stat.S_IRGRP | stat.S_IWGRP
    if status.st_mode & wanted != wanted or group == 'root':
        remedy = 'install the udev rule of docs/how-to/hardware.md: GROUP="dialout", MODE="0660"'
    elif user in _members(group):
        remedy = f'{user} is in group {group}, this session is not yet: log out and in again'
    else:
        remedy = f'sudo usermod -aG {group} {user}, then log out and in again'
    return Finding(item, FAIL, found, remedy)


def _name(look_up, number):
    try:
        return look_up(number)[0]
    except KeyError:
        return str(number)


def _members(group):
    try:
        return grp.getgrnam(group).gr_mem
    except KeyError:
        return []


def _free(holding):
    if any('ModemManager' in command for _, command in holding):
        return 'sudo systemctl disable --now ModemManager: it opens every new port as a modem'
    return 'stop that process, or check the bridges through ROS (source ROS, same ROS_DOMAIN_ID)'


def holders(path: str, proc_root: Path = PROC) -> list[tuple[int, str]]:
    """
    Other processes of this user that have a port open: (process ID, command line).

    The process at the other end of a pseudo-terminal is the device and is left out.
    """
    device, found = os.stat(path).st_rdev, []
    for folder in sorted(proc_root.glob('[0-9]*')):
        if int(folder.name) == os.getpid():
            continue
        try:
            entries = list((folder / 'fd').iterdir())
        except OSError:
            continue
        if any(_is_device(entry, device) for entry in entries) \
                and not _is_emulator(folder, entries, os.minor(device), path):
            found.append((int(folder.name), _command(folder)))
    return found


def _is_device(entry, device):
    try:
        status = os.stat(entry)
    except OSError:
        return False
    return stat.S_ISCHR(status.st_mode) and status.st_rdev == device


def _is_emulator(folder, entries, index, path):
    """Whether a process holds the other end of this pseudo-terminal."""
    if not os.path.realpath(path).startswith('/dev/pts/'):
        return False
    for entry in entries:
        try:
            if os.readlink(entry).endswith('ptmx') and \
                    f'tty-index:\t{index}\n' in (folder / 'fdinfo' / entry.name).read_text():
                return True
        except OSError:
            continue
    return False


def _command(folder):
    try:
        text = (folder / 'cmdline').read_bytes().replace(b'\0', b' ').decode(errors='replace')
    except OSError:
        text = ''
    program, _, rest = text.strip().partition(' ')
    text = f'{os.path.basename(program)} {rest}'.strip() or 'unknown'
    return text if len(text) <= SHOWN_COMMAND else text[:SHOWN_COMMAND - 3] + '...'


def latency_finding(item: str, path: str, limit: int, sys_root: Path = SYS) -> Finding:
    """Check the latency timer of a USB adapter, at most ``limit`` [ms], with the port open."""
    name = Path(os.path.realpath(path)).name
    file = sys_root / 'bus' / 'usb-serial' / 'devices' / name / 'latency_timer'
    try:
        timer = int(file.read_text())
    except (OSError, ValueError):
        return Finding(item, OK, 'none: no FTDI adapter')
    values = {'latency_timer_ms': timer}
    if timer <= limit:
        return Finding(item, OK, f'{timer} ms', values=values)
    return Finding(item, FAIL, f'{timer} ms: each answer waits for it', f'echo {limit} | sudo tee '
                   f'{file}; permanently: the udev rule of docs/how-to/hardware.md', values)


def usb_ports(sys_root: Path = SYS) -> dict[str, str]:
    """USB serial ports of this computer: device -> maker, product and serial number."""
    names = sorted(path.name for kind in ('ttyUSB*', 'ttyACM*')
                   for path in (sys_root / 'class' / 'tty').glob(kind))
    return {f'/dev/{name}': usb_product(name, sys_root) or 'unknown' for name in names}


def usb_product(device: str, sys_root: Path = SYS) -> str:
    """Maker, product and serial number of the USB device of a tty; '' if there is none."""
    folder = Path(os.path.realpath(sys_root / 'class' / 'tty' / Path(device).name / 'device'))
    for _ in range(USB_DEPTH):
        if (folder / 'idVendor').is_file():
            read = {name: _text(folder / name) for name in
                    ('manufacturer', 'product', 'idVendor', 'idProduct', 'serial')}
            name = ' '.join(filter(None, (read['manufacturer'], read['product'])))
            identity = f"{read['idVendor']}:{read['idProduct']}"
            serial = f", serial {read['serial']}" if read['serial'] else ''
            return f'{name} ({identity}{serial})'.strip()
        folder = folder.parent
    return ''


def _text(path):
    try:
        return path.read_text(errors='replace').strip()
    except OSError:
        return ''

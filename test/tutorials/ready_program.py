"""
A `beetle_omni` with loaded modules: each call is a process that is forked from it.

``python ready_program.py SOCKET`` loads the modules once and serves. A shell starts the program
``CLIENT`` instead. It passes on its streams, folder, environment and arguments, and ends with the
status of the call. Loading the modules takes 2 s of CPU time, a short flight takes 4 s.
"""

import gc
from importlib import import_module
import json
import os
import socket
import sys

MODULES = ('beetle_omni_ros.cli', 'beetle_omni_ros.flight.evaluate',
           'beetle_omni_ros.flight.faults', 'beetle_omni_ros.identify.flights.command',
           'beetle_omni_ros.show.report')
CLIENT = """#!{python} -IS
import json, os, socket, sys
with socket.socket(socket.AF_UNIX) as server:
    server.connect({address!r})
    socket.send_fds(server, [b'.'], [0, 1, 2])
    server.sendall(json.dumps([os.getcwd(), dict(os.environ), sys.argv[1:]]).encode())
    server.shutdown(socket.SHUT_WR)
    sys.exit(int(server.recv(8) or 1))
"""


def serve(address):
    """Answer calls until the parent ends."""
    calls = 0
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(address)
        server.listen()
        while True:
            call, _ = server.accept()
            while calls and os.waitpid(-1, os.WNOHANG)[0]:
                calls -= 1
            if not os.fork():       # its parent serves the next call
                server.close()
                return _answer(call)
            call.close()
            calls += 1


def _answer(call):
    """Run one call in a process, wait for its end and send its status."""
    _, streams, *_ = socket.recv_fds(call, 1, 3)
    folder, environment, arguments = json.loads(b''.join(iter(lambda: call.recv(65536), b'')))
    child = os.fork()
    if child:
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        call.sendall(str(status if status >= 0 else 128 - status).encode())
        os._exit(0)
    call.close()
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
        os.close(stream)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    sys.argv = ['beetle_omni', *arguments]
    from beetle_omni_ros import start
    return start.beetle_omni()


if __name__ == '__main__':
    for module in MODULES:
        import_module(module)
    gc.collect()
    gc.freeze()         # collections would copy the modules into each process
    gc.set_threshold(50_000, 20, 20)
    sys.exit(serve(sys.argv[1]))

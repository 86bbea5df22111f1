"""`srf` for a shell, without the imports of each start: a process that holds all modules forks for each command.

    python tests/srf_server.py SOCKET               serves, until its standard input ends
    python tests/srf_server.py SOCKET ARGUMENT ...  is `srf ARGUMENT ...`, run by that process

A command has its caller's arguments, folder, environment and streams, and leaves nothing behind for the next.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import json
import os
import pkgutil
import selectors
import socket
import sys
from typing import NoReturn

FAMILY = socket.AF_UNIX


def ask(place: str, arguments: list[str]) -> int:
    """Have a command run, and return its exit code."""
    with socket.socket(FAMILY) as line:
        line.connect(place)
        asked = json.dumps([arguments, os.getcwd(), dict(os.environ)]).encode()  # noqa: PTH109
        socket.send_fds(line, [len(asked).to_bytes(8, "big")], [0, 1, 2])
        line.sendall(asked)
        return int(line.recv(16))


def prepare() -> None:
    """Import what commands import; what needs a library that is not here stays where it is."""
    import srfcli

    for found in pkgutil.walk_packages(srfcli.__path__, "srfcli."):
        if not found.name.endswith("__main__") and ".codegen.models." not in found.name:
            importlib.import_module(found.name)
    for name in ("matplotlib.figure", "matplotlib.backends.backend_svg"):
        importlib.import_module(name)


def run(line: socket.socket) -> NoReturn:
    """Be the command that comes over a connection."""
    head, streams, _, _ = socket.recv_fds(line, 8, 3)
    with line.makefile("rb") as rest:
        arguments, folder, environment = json.loads(rest.read(int.from_bytes(head, "big")))
    for own, given in enumerate(streams):
        os.dup2(given, own)
        os.close(given)
    sys.stdin, sys.stdout, sys.stderr = open(0), open(1, "w"), open(2, "w", buffering=1, errors="backslashreplace")  # noqa: SIM115
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    sys.argv = ["srf", *arguments]
    from srfcli.cli.main import main

    main()


def answer(line: socket.socket) -> NoReturn:
    """Run the command that comes over a connection, say what it ended with, and end."""
    if (child := os.fork()) == 0:
        run(line)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    line.sendall(b"%d" % (code if code >= 0 else 128 - code))
    os._exit(0)


def reap(options: int) -> None:
    """Take note of those who have answered, so that their time counts as this process's."""
    with contextlib.suppress(ChildProcessError):
        while os.waitpid(-1, options)[0]:
            pass


def serve(place: str) -> None:
    """Answer one command after another."""
    prepare()
    gc.freeze()  # what is collected in a copy is its own
    with socket.socket(FAMILY) as listening, selectors.DefaultSelector() as either:
        listening.bind(place)
        listening.listen()
        print("ready", flush=True)
        for source in (listening, sys.stdin):
            either.register(source, selectors.EVENT_READ)
        while all(key.fileobj is listening for key, _ in either.select()):
            line, _ = listening.accept()
            if os.fork() == 0:
                listening.close()
                answer(line)
            line.close()
            reap(os.WNOHANG)
        reap(0)


if __name__ == "__main__":
    if len(sys.argv) == 2:
        serve(sys.argv[1])
    else:
        sys.exit(ask(sys.argv[1], sys.argv[2:]))

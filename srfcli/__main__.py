"""The process `srf`, as it is installed and as `python -m srfcli`: Ctrl-C before its modules are there, and after."""

from __future__ import annotations

import sys


def main() -> None:
    """Run `srf` and exit. Before the first command is reached, and after the last, Ctrl-C ends the process without a word."""
    told = sys.excepthook
    sys.excepthook = lambda kind, *what: None if kind is KeyboardInterrupt else told(kind, *what)
    import signal  # takes longer than all before

    from srfcli.cli.main import main as run

    try:
        run()
    finally:
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, signal.SIG_DFL)


if __name__ == "__main__":
    main()

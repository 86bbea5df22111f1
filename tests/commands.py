"""The command as a test types it, in this process."""

from __future__ import annotations

from click.testing import CliRunner, Result

from srfcli.cli.main import cli


def srf(*arguments: object, code: int = 0) -> Result:
    """Run `srf` with these words; `code` is the exit code that is expected."""
    done = CliRunner().invoke(cli, [str(a) for a in arguments], prog_name="srf")
    assert done.exit_code == code, (done.output, done.exception)
    return done

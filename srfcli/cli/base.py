"""What every `srf` command shares: the switches of a run, classes for commands and groups, and the reporting of errors."""

from __future__ import annotations

import contextlib
import difflib
import io
import logging
import os
import re
import sys
import traceback
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn, TextIO, cast

import click

from srfcli.core.errors import ExpressionError, SrfError, did_you_mean, printable

EXIT_OK, EXIT_UNEXPECTED, EXIT_USAGE, EXIT_PARTIAL, EXIT_CONDITION, EXIT_INTERRUPTED = 0, 1, 2, 3, 4, 130
STDOUT, STDERR = "standard output", "standard error"

CONTEXT: dict[str, Any] = {"help_option_names": ["-h", "--help"], "max_content_width": 110, "show_default": True}


@dataclass
class Session:
    """The switches of one run of `srf`; -q, -v, --debug and --trust may stand before or after the command's name."""

    arguments: tuple[str, ...] = ()
    quiet: bool = False
    verbose: int = 0
    debug: bool = False
    trust: bool = False

    @staticmethod
    def current() -> Session:
        """Return the running command's session, or a fresh one outside of any command."""
        context = click.get_current_context(silent=True)
        return (context.find_object(Session) if context else None) or Session()

    def say(self, text: str) -> None:
        """Write one line to stderr, unless -q was given."""
        if not self.quiet:
            click.echo(printable(text, line=True), err=True)

    def detail(self, text: str) -> None:
        """Write one line to stderr if -v was given."""
        if self.verbose and not self.quiet:
            click.echo(printable(text, line=True), err=True)


def _switch(context: click.Context, parameter: click.Parameter, value: Any) -> None:
    session = context.find_object(Session)
    if value and session is not None:
        setattr(session, str(parameter.name), value)


def switches() -> list[click.Option]:
    """Return the options -q, -v, --debug and --trust; they set the session and are no argument of the command."""
    common: dict[str, Any] = {"expose_value": False, "callback": _switch, "is_eager": True}
    return [
        click.Option(["-q", "--quiet"], is_flag=True, help="Print errors alone to stderr; notes below a table stay.", **common),
        click.Option(["-v", "--verbose"], count=True, show_default=False, help="Print more detail to stderr.", **common),
        click.Option(["--debug"], is_flag=True, help="Show the traceback of an error.", **common),
        click.Option(["--trust"], is_flag=True, help="Run Python that an experiment or srf.toml names.", **common),
    ]


class WithExamples(click.Command):
    """A command or a group whose epilog, the examples, is printed as it is written: a wrapped command line cannot be copied."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the epilog, its common indentation replaced by two spaces."""
        if self.epilog:
            import inspect  # only for help

            formatter.write("\nExamples:\n")
            for line in inspect.cleandoc(self.epilog).splitlines():
                formatter.write(f"  {line}".rstrip() + "\n")


class SrfCommand(WithExamples):
    """A command with examples and the switches."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.params.extend(switches())


class SrfGroup(WithExamples, click.Group):
    """A group that lists its commands in the order of their registration and reports every error in the form of `srf`."""

    command_class = SrfCommand

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **{"no_args_is_help": False, **kwargs})

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the commands in the order of their registration."""
        return list(self.commands)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Show the help, and succeed, where nothing was asked."""
        if not args and not (self.invoke_without_command or ctx.resilient_parsing):
            click.echo(ctx.get_help(), color=ctx.color)
            ctx.exit(EXIT_OK)
        return super().parse_args(ctx, args)

    def resolve_command(self, ctx: click.Context, args: list[str]) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the command that `args` begin with; raises SrfError with the nearest names for a misspelt one."""
        name = args[0]
        if name in self.commands or name.startswith("-") or ctx.resilient_parsing:
            return super().resolve_command(ctx, args)
        raise SrfError(f"no such command {name!r} of {ctx.command_path}", did_you_mean(name, self.commands))

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands with their first sentence, all of it."""
        with formatter.section("Commands"):
            formatter.write_dl(self.summaries())

    def summaries(self) -> list[tuple[str, str]]:
        """Return the commands' names and first sentences."""
        return [(name, command.get_short_help_str(limit=1000)) for name, command in self.commands.items()]

    def main(self, args: Sequence[str] | None = None, prog_name: str | None = None, **extra: Any) -> NoReturn:  # type: ignore[override]
        """Run the command line and leave with its exit code; every error ends here."""
        arguments = list(sys.argv[1:] if args is None else args)
        session = Session(tuple(arguments))
        extra.pop("standalone_mode", None)
        sys.exit(_run(self, arguments, session, prog_name=prog_name or "srf", obj=session, **extra))


class Screen:
    """A text stream that replaces control characters in whatever is written to it; `unescaped` is the stream below.

    All output to stdout and stderr passes through one, also tracebacks and the messages of libraries. It has no `buffer`: bytes
    written to that would bypass it.
    """

    def __init__(self, stream: TextIO, name: str) -> None:
        self.unescaped, self.called = stream, name

    def write(self, text: str | bytes) -> int:
        """Write the text, printable; bytes, in which click writes a shell's completions, are UTF-8."""
        shown = text if isinstance(text, str) else text.decode("utf-8", "replace")
        with self._named():
            self.unescaped.write(printable(shown))
        return len(text)

    def flush(self) -> None:
        """Flush the stream below."""
        with self._named():
            self.unescaped.flush()

    @contextlib.contextmanager
    def _named(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:  # a full disk, for example; the error itself does not name the stream
            error.filename = error.filename or self.called
            raise

    def writelines(self, lines: Iterable[str]) -> None:
        """Write every text, printable."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        if name in ("buffer", "detach"):
            raise AttributeError(name)
        return getattr(self.unescaped, name)


class _Told(logging.Handler):
    """A log handler that writes each warning of the package as one line on stderr."""

    def __init__(self, session: Session) -> None:
        super().__init__(logging.WARNING)
        self.session = session

    def emit(self, record: logging.LogRecord) -> None:
        self.session.say(f"Warning: {record.getMessage()}")


def _open_streams() -> None:
    """Open standard streams that were closed (>&-) on the null device: else the next file that is opened takes their number."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:  # the lowest free number is that of the closed stream
            handle = os.open(os.devnull, os.O_RDWR)
            setattr(sys, name, os.fdopen(handle, mode, encoding="utf-8", closefd=False))


def _run(group: click.Group, arguments: list[str], session: Session, **extra: Any) -> int:
    _open_streams()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # an ASCII terminal shows ? for a Greek letter, it does not fail
    out, err = (cast(TextIO, Screen(s, n)) for s, n in ((sys.stdout, STDOUT), (sys.stderr, STDERR)))
    log, told = logging.getLogger("srfcli"), _Told(session)
    log.addHandler(told)
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # NumPy warns of overflows; rows and statuses report them
            return _ended(group, arguments, session, **extra)
    finally:
        log.removeHandler(told)


def _ended(group: click.Group, arguments: list[str], session: Session, **extra: Any) -> int:
    """Run the command, report any error on stderr, and return the exit code."""
    try:
        code = click.Group.main(group, arguments, standalone_mode=False, **extra)
        sys.stdout.flush()  # here, where a closed pipe can still be caught
        return code if isinstance(code, int) else EXIT_OK
    except SystemExit as stop:  # click's own end, on a closed pipe among others
        return stop.code if isinstance(stop.code, int) else EXIT_UNEXPECTED
    except (KeyboardInterrupt, click.Abort) as error:
        return _end("interrupted", None, EXIT_INTERRUPTED, error, session)
    except SrfError as error:
        caret = error.caret() if isinstance(error, ExpressionError) else None
        command = _named_command(group, arguments)[1]
        told = as_options(error.message, command)
        hint = as_options(error.hint, command) if error.hint else None
        return _end(told, hint, error.exit_code, error, session, caret=caret)
    except click.ClickException as error:
        told, hint = _usage_text(error, group, arguments)
        return _end(told, hint, error.exit_code, error, session)
    except OSError as error:
        closed = isinstance(error, BrokenPipeError)
        if closed or error.filename == STDOUT:
            _silence_stdout()
        if closed:
            return EXIT_UNEXPECTED
        where = f"{error.filename}: " if error.filename else ""
        return _end(f"{where}{error.strerror or error}", None, EXIT_UNEXPECTED, error, session)
    except Exception as error:
        if isinstance(error, ArithmeticError) or type(error).__name__ == "LinAlgError":  # NumPy's, not imported for it
            text = f"nothing can be computed at these values: {error}"
            hint = "A parameter at the end of its range, 0 above all, may leave nothing to solve; --debug shows where."
            return _end(text, hint, EXIT_PARTIAL, error, session)
        text = f"unexpected {type(error).__name__}: {error}" if str(error) else f"unexpected {type(error).__name__}"
        return _end(text, "Run with --debug for the traceback.", EXIT_UNEXPECTED, error, session)


def _end(message: str, hint: str | None, code: int, error: BaseException, session: Session, *, caret: str | None = None) -> int:
    with contextlib.suppress(OSError):
        sys.stdout.flush()  # so that results stand before the error
    if session.debug:
        traceback.print_exception(error)
    lines = [f"Error: {' '.join(message.split())}", *([caret] if caret else []), *([f"Try: {hint}"] if hint else [])]
    with contextlib.suppress(OSError):
        click.echo("\n".join(lines), err=True)
    return code


def _silence_stdout() -> None:
    """Point stdout at the null device: the interpreter flushes it once more at exit, which would fail."""
    with contextlib.suppress(OSError, ValueError):
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, sys.stdout.fileno())
        os.close(nothing)


def _usage_text(error: click.ClickException, group: click.Group, arguments: Sequence[str]) -> tuple[str, str | None]:
    """Return click's error as a message in the form of `srf`, and a hint."""
    path, command = _named_command(group, arguments)
    choices = getattr(getattr(getattr(error, "param", None), "type", None), "choices", None)
    if choices and (found := re.search(r"'([^']*)' is not one of", error.format_message())):
        message = error.format_message().partition(" is not one of")[0]
        return f"{message[:1].lower()}{message[1:]} is not one of its values", did_you_mean(found[1], choices)
    if not isinstance(error, click.NoSuchOption):
        message = error.format_message().strip().rstrip(".")
        return message[:1].lower() + message[1:], f"{path} --help"
    name = error.option_name
    options = [o for p in command.params for o in (*p.opts, *p.secondary_opts) if o.startswith("--")]
    close = ["--free"] if name == "--fix" and "--free" in options else difflib.get_close_matches(name, options, n=1, cutoff=0.75)
    hints = [f"Did you mean '{close[0]}'?"] if close else []
    if "--set" in options and name.startswith("--") and name[2:].isidentifier():
        if name[2:] in ("V", "W0", "eps") and "--over" in options:
            hints.append(f"Here it is swept: --over {name[2:]}=VALUE.")
        else:
            hints.append(f"A law's parameter is set with --set {name[2:]}=VALUE.")
    return f"no such option {name} of {path}", " ".join([*hints, f"The options are listed by {path} --help"])


def as_options(text: str, command: click.Command) -> str:
    """Return `text` with each parameter that the library names in backticks replaced by the option of `command`."""
    options = {p.name: next((o for o in p.opts if o.startswith("--")), None) for p in command.params}
    return re.sub(r"`(\w+)`", lambda m: options.get(m[1]) or m[0], text)


def _named_command(group: click.Group, arguments: Sequence[str]) -> tuple[str, click.Command]:
    """Return the full name of the command that `arguments` name, and the command; click's parser errors do not have them."""
    path, command = "srf", cast(click.Command, group)
    for word in arguments:
        if isinstance(command, click.Group) and word in command.commands:
            path, command = f"{path} {word}", command.commands[word]
    return path, command

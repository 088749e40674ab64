"""The roof: mounts the commands, and is the one door through which errors leave.

Everything heavy is imported inside the commands, so that ``--help`` is instant.
"""

from __future__ import annotations

import os
import signal
import sys
import traceback
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from utopic_cli import __version__
from utopic_cli.commands.align import align
from utopic_cli.commands.apply import apply
from utopic_cli.commands.batch import batch
from utopic_cli.commands.bench import bench, group
from utopic_cli.commands.bench_batch import batch_bench
from utopic_cli.commands.bench_confidence import confidence
from utopic_cli.commands.bench_speed import speed
from utopic_cli.commands.bench_synthetic import mount as mount_synthetic
from utopic_cli.commands.bench_variants import mount as mount_variants
from utopic_cli.commands.calibrate import calibrate
from utopic_cli.commands.console import PlainUsage, debug_wanted
from utopic_cli.commands.demo import demo
from utopic_cli.commands.info import info
from utopic_cli.commands.teach import teach
from utopic_cli.commands.train import train
from utopic_cli.commands.transformation import transformation
from utopic_cli.errors import UtopicError
from utopic_cli.io.files import printable

# The base class of usage errors has moved between Typer's versions (click, then a copy of it),
# so it is taken from a class that is exported by all of them.
_USAGE_ERROR: Any = typer.BadParameter.__mro__[2]
_PASSED_ON = (typer.Exit, typer.Abort)

_MEANT = {
    ("batch", "-o"): "--out-dir",
    ("batch", "--output"): "--out-dir",
    ("transformation", "--to"): "--form",
}
"""What a command has in the place of an option that it doesn't have."""

_ALIGN = "Align scans"
_FIRST = "First steps"
_OWN = "Weights of your own"


class Door(TyperGroup):
    """A command group that turns every exception into one line on stderr and an exit code.

    It stands here and not around ``main`` so that a shell and Typer's ``CliRunner`` see the same.
    """

    def invoke(self, ctx: Any) -> Any:
        """Run the chosen command; see the README for the exit codes."""
        try:
            return super().invoke(ctx)
        except _PASSED_ON:
            raise
        except _USAGE_ERROR as error:
            if type(error).__name__ == "NoArgsIsHelpError":  # "utopic bench" alone asks for help
                raise
            command = error.ctx.command_path if error.ctx else "utopic"
            what = _one_line(error.format_message()).replace("Value error, ", "").rstrip(".")
            option = getattr(error, "option_name", "")
            meant = _MEANT.get((str(error.ctx and error.ctx.info_name), option))
            what = f"No such option: {option}; did you mean {meant}?" if meant else what
            _leave(ctx, f"error: {what}; see '{command} --help'", 2)
        except KeyboardInterrupt:
            _leave(ctx, "interrupted", 130)
        except BrokenPipeError:
            _leave(ctx, "error: the output can't be written: whoever read it is gone", 5)
        except UtopicError as error:
            _leave(ctx, f"error: {_one_line(error)}", error.exit_code)
        except Exception as error:
            what = f"{type(error).__name__}: {_one_line(error)}".rstrip(": ")
            _leave(ctx, f"error: unexpected {what}; this is a bug, run with --debug for the traceback", 1)


def _one_line(error: BaseException | str) -> str:
    return " ".join(printable(str(error)).splitlines())


def _leave(ctx: Any, message: str, exit_code: int) -> None:
    if debug_wanted(ctx):
        traceback.print_exc(file=sys.stderr)
    typer.echo(f"utopic: {message}", err=True)
    raise typer.Exit(exit_code)


app = typer.Typer(
    cls=Door,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Exit codes: 0 aligned; 1 a bug of ours; 2 usage; 3 aligned, do not trust it; "
    "4 an input can't be used; 5 an output can't be written; 6, 7 batch: in parts, nothing aligned; "
    "130 interrupted.",
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"utopic-cli {__version__}")
        raise typer.Exit()


@app.callback()
def roof(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit."),
    ] = False,
) -> None:
    """Align overlapping 3D scans: two files in, one transformation out.

    [bold]p_target = T_target_source @ p_source[/bold]

    SOURCE is the scan that moves and is named first, TARGET stays.
    Scans come in any unit, any pose and any density.

    Example: [bold]utopic align a.ply b.ply --out-dir result[/bold]
    """


app.command(rich_help_panel=_ALIGN)(align)
app.command(rich_help_panel=_ALIGN)(batch)
app.command(rich_help_panel=_ALIGN)(apply)
app.command(rich_help_panel=_ALIGN)(transformation)
app.command(rich_help_panel=_FIRST)(demo)
app.command(rich_help_panel=_FIRST)(info)
app.command(rich_help_panel=_OWN)(train)
app.command(rich_help_panel=_OWN)(teach)
app.command(rich_help_panel=_OWN)(calibrate)
bench.command()(confidence)
bench.command("batch")(batch_bench)
mount_synthetic(bench)
mount_variants(bench)
bench.command()(speed)
group(bench)
app.add_typer(bench, name="bench", rich_help_panel=_OWN)
for one in (*app.registered_commands, *bench.registered_commands):
    one.cls = PlainUsage


def main() -> None:
    """Entry point of the ``utopic`` command."""
    # Asked to end by a scheduler or ``timeout``: tidy up as after Ctrl-C.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    # Threads that spin while they wait for each other make a busy machine two to four times slower.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    app(prog_name="utopic")


if __name__ == "__main__":
    main()

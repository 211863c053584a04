"""The command ``regnet``; one module for each subcommand.

Exit codes: 0 success; 1 the work failed, with one line on stderr, or an error in the program itself, with its
traceback; 2 wrong usage or unusable input, with one line on stderr; 3 valid input in which no grasp was found; 4 a data
set with damaged files; 130 interrupted.
"""

from __future__ import annotations

import sys
import traceback
from collections.abc import Sequence
from typing import Annotated, Any

import typer

from regnet_core import __version__
from regnet_core.cli import calibrate, detect, evaluate, generate, inspect, models, simulate, train
from regnet_core.errors import InvalidInputError, RegnetError

_USAGE_ERROR: Any = typer.BadParameter.__mro__[2]
"""ClickException. typer does not export it, and whether it is that of the package click depends on typer's version."""

app = typer.Typer(
    name="regnet",
    help="Grasps for parallel-jaw grippers in point clouds.",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)
app.command(epilog=detect.EXIT_CODES)(detect.detect)
app.command()(models.models)
app.command()(generate.generate)
app.command()(inspect.inspect)
app.command()(train.train)
app.command()(evaluate.evaluate)
app.command()(simulate.simulate)
app.command()(calibrate.calibrate)


@app.callback(invoke_without_command=True)
def _regnet(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and leave.")] = False,
) -> None:
    if version:
        typer.echo(f"regnet {__version__}")
        raise typer.Exit
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command with these arguments (those of the process when not given) and return its exit code."""
    try:
        code = app(args=None if arguments is None else list(arguments), prog_name="regnet", standalone_mode=False)
    except (typer.Abort, KeyboardInterrupt):
        return _fail("interrupted", 130)
    except (InvalidInputError, OSError) as error:
        return _fail(str(error), 2)
    except RegnetError as error:
        return _fail(str(error), 1)
    except Exception as error:
        if isinstance(error, _USAGE_ERROR):
            return _fail(error.format_message(), 2)
        traceback.print_exc()
        return _fail(f"internal error: {type(error).__name__}: {error}", 1)
    return code if isinstance(code, int) else 0


def _fail(message: str, code: int) -> int:
    print(f"regnet: {' '.join(message.split())}", file=sys.stderr)
    return code

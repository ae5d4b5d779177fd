"""The console program ``taichi-mrf``: parse, call, print. Errors become exit codes only here."""

import os
import sys
from collections.abc import Sequence
from typing import Annotated

import tyro

import taichi_mrf
from taichi_mrf.cli.bench import Bench
from taichi_mrf.cli.calibrate import Calibrate
from taichi_mrf.cli.diff import Diff
from taichi_mrf.cli.eval import Eval
from taichi_mrf.cli.export import Export
from taichi_mrf.cli.flags import registry
from taichi_mrf.cli.import_map import Import
from taichi_mrf.cli.info import Info
from taichi_mrf.cli.laser import Laser, laser_settings
from taichi_mrf.cli.live import Live
from taichi_mrf.cli.map import Map, file_settings
from taichi_mrf.cli.tune import Tune
from taichi_mrf.errors import TaichiMRFError

PROGRAM = "taichi-mrf"
WITH_SETTINGS = ("map", "live", "tune")
"""Commands whose flags change the parameters of --config's file."""

Command = Map | Live | Tune | Export | Import | Diff | Info | Bench | Calibrate | Eval | Laser

BAD_INPUT = 2
ABORTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return the exit status: 0, or 2 after one line on stderr that says what is
    wrong, or 128 plus the signal's number for a run that was stopped."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if arguments == ["--version"]:
        print(f"{PROGRAM} {taichi_mrf.__version__}")
        return 0
    try:
        return parse(arguments).run()
    except TaichiMRFError as error:
        print(f"{PROGRAM}: {error}", file=sys.stderr)
        return BAD_INPUT
    except BrokenPipeError:  # the reader of our output has seen enough, as in `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        print(f"{PROGRAM}: {error.filename or 'input or output'}: {error.strerror or error}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print(f"{PROGRAM}: aborted", file=sys.stderr)
        return ABORTED


def parse(arguments: Sequence[str]) -> Command:
    """The command that the arguments ask for. Exits with status 2 where they cannot be parsed."""
    settings = file_settings(arguments[1:] if arguments and arguments[0] in WITH_SETTINGS else [])
    laser = laser_settings(arguments[1:] if arguments[:1] == ["laser"] else [])
    commands = (
        Annotated[
            Map,
            tyro.conf.subcommand(
                "map", default=Map(tyro.MISSING, tyro.MISSING, settings=settings), prefix_name=False
            ),
        ]
        | Annotated[Live, tyro.conf.subcommand("live", default=Live(settings=settings), prefix_name=False)]
        | Annotated[
            Tune,
            tyro.conf.subcommand("tune", default=Tune(tyro.MISSING, settings=settings), prefix_name=False),
        ]
        | Annotated[Export, tyro.conf.subcommand("export", prefix_name=False)]
        | Annotated[Import, tyro.conf.subcommand("import", prefix_name=False)]
        | Annotated[Diff, tyro.conf.subcommand("diff", prefix_name=False)]
        | Annotated[Info, tyro.conf.subcommand("info", prefix_name=False)]
        | Annotated[Bench, tyro.conf.subcommand("bench", default=Bench(), prefix_name=False)]
        | Annotated[Calibrate, tyro.conf.subcommand("calibrate", prefix_name=False)]
        | Annotated[Eval, tyro.conf.subcommand("eval", prefix_name=False)]
        | Annotated[
            Laser,
            tyro.conf.subcommand(
                "laser", default=Laser(tyro.MISSING, tyro.MISSING, settings=laser), prefix_name=False
            ),
        ]
    )
    return tyro.cli(
        commands,
        prog=PROGRAM,
        description="Probabilistic occupancy maps from depth cameras.",
        args=arguments,
        registry=registry,
    )

"""The console program ``taichi-mrf``: parse, call, print. Errors become exit codes only here."""

import os
import sys
from collections.abc import Sequence

import taichi_mrf
from taichi_mrf.cli.parser import parse
from taichi_mrf.cli.shared.terminal import PROGRAM, READ_WRONG, print_problem
from taichi_mrf.errors import ReadWrongError, TaichiMRFError

BAD_INPUT = 2
ABORTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return the exit status: 0, or 2 (4 for a recording that is surely read wrong) after
    one line on stderr that says what is wrong, or 128 plus the signal's number for a run that was stopped."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if arguments == ["--version"]:
        print(f"{PROGRAM} {taichi_mrf.__version__}")
        return 0
    try:
        command, options = parse(arguments)
        return command.run(options)
    except ReadWrongError as error:
        print_problem(str(error))
        return READ_WRONG
    except TaichiMRFError as error:
        print_problem(str(error))
        return BAD_INPUT
    except BrokenPipeError:  # the reader of our output has seen enough, as in `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        print_problem(f"{error.filename or 'input or output'}: {error.strerror or error}")
        return BAD_INPUT
    except KeyboardInterrupt:
        print_problem("aborted")
        return ABORTED

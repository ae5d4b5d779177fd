"""The process of one task: it reads the task, runs it, answers, and ends when its parent does.

The task comes through stdin, which then stays open: its end means that the parent has died. The answer goes
to the original stdout; what the task prints goes to stderr.
"""

import os
import pickle
import struct
import threading
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import IO, Any

from taichi_mrf.errors import ClusterError

_LENGTH = struct.Struct("<Q")
_STDIN, _STDOUT, _STDERR = range(3)
ORPHANED = 70
"""Exit status of a process whose parent has died."""


@dataclass(frozen=True)
class Answer:
    """The outcome of a task: its result, or the exception and where it was raised."""

    result: Any = None
    error: Exception | None = None
    where: str = ""


def main() -> None:
    """Run the one task that comes through stdin."""
    answers = os.fdopen(os.dup(_STDOUT), "wb")
    os.dup2(_STDERR, _STDOUT)
    with os.fdopen(os.dup(_STDIN), "rb", buffering=0) as stdin:
        payload = read_block(stdin)
    if payload is None:
        return
    threading.Thread(target=_end_with_the_parent, daemon=True).start()
    with answers:
        write_block(answers, answer_to(payload))


def answer_to(payload: bytes) -> bytes:
    """The pickled Answer to a pickled (function, task)."""
    try:
        function, task = pickle.loads(payload)
        return pickle.dumps(Answer(function(task)))
    except Exception as error:
        return _pickled_error(error)


def pickled_task(function: Callable[[Any], Any], task: Any) -> bytes:
    """Bytes of a function and its task, as :func:`answer_to` takes them."""
    return pickle.dumps((function, task))


def result_of(answer: bytes) -> Any:
    """The result in a pickled Answer. Raises the exception that the answer holds."""
    said: Answer = pickle.loads(answer)
    if said.error is not None:
        raise said.error from ClusterError(f"in the process of the task:\n{said.where}")
    return said.result


def write_block(stream: IO[bytes], block: bytes) -> None:
    """Write a block of bytes with its length before it."""
    stream.write(_LENGTH.pack(len(block)) + block)
    stream.flush()


def read_block(stream: IO[bytes]) -> bytes | None:
    """Block that :func:`write_block` wrote; None if the stream ends before the block does."""
    head = _read(stream, _LENGTH.size)
    if len(head) < _LENGTH.size:
        return None
    (length,) = _LENGTH.unpack(head)
    block = _read(stream, length)
    return block if len(block) == length else None


def _read(stream: IO[bytes], count: int) -> bytes:
    """Up to ``count`` bytes; fewer only at the stream's end."""
    pieces = []
    while count and (piece := stream.read(min(count, 1 << 20))):
        pieces.append(piece)
        count -= len(piece)
    return b"".join(pieces)


def _pickled_error(error: Exception) -> bytes:
    """The exception if it can be pickled, else its text."""
    where = traceback.format_exc()
    try:
        block = pickle.dumps(Answer(error=error, where=where))
        pickle.loads(block)
    except Exception:  # pickling runs the exception's own code
        return pickle.dumps(Answer(error=ClusterError(f"{type(error).__name__}: {error}"), where=where))
    return block


def _end_with_the_parent() -> None:
    # Not through sys.stdin, whose lock would be held by this thread when the interpreter ends.
    while os.read(_STDIN, 1):
        pass
    os._exit(ORPHANED)

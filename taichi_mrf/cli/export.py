"""What ``taichi-mrf export`` does: look at the names, load the map, write each file, say what was written."""

import json
import os
import time
from pathlib import Path
from typing import Any

from taichi_mrf.cli.options.export import Export
from taichi_mrf.cli.shared.terminal import Terminal
from taichi_mrf.errors import ConfigError
from taichi_mrf.export.chunk_store import SUFFIX
from taichi_mrf.export.formats import ExportedMap, export_map, export_note, writer_of
from taichi_mrf.methods.chunked import ChunkedMap
from taichi_mrf.methods.chunked_part import take_part
from taichi_mrf.methods.registry import load_map
from taichi_mrf.system import runtime


def run_export(options: Export) -> int:
    """Carry out the command; returns the exit status. Raises TaichiMRFError.

    All names are looked at before the map is read, which can take long.
    """
    if not options.to:
        raise ConfigError("--to needs at least one file")
    for path in options.to:
        writer_of(path)
        if os.path.realpath(path) == os.path.realpath(options.map):
            raise ConfigError(f"{path}: the map itself would be overwritten")
    runtime.init(options.arch)
    console = Terminal()
    m = _opened(options)
    written: list[dict[str, Any]] = []
    for path in options.to:
        begin = time.perf_counter()
        files = export_map(m, path, options.options)
        seconds = round(time.perf_counter() - begin, 3)
        for file in files:
            written.append({"file": str(file), "bytes": _size(file), "seconds": seconds})
            if not options.json:
                _tell(console, file, seconds)
        note = export_note(m, path, options.options)
        if note is not None and not options.json:
            console.say(f"{path.name}: {note}")
    if options.json:
        print(json.dumps(written, indent=2))
    return 0


def _opened(options: Export) -> ExportedMap:
    """The map, or the part of a map in chunks that was asked for."""
    if options.map.suffix == SUFFIX:
        return take_part(ChunkedMap.open(options.map), options.lower, options.upper)
    if options.lower is not None or options.upper is not None:
        raise ConfigError(f"--lower and --upper take a part of a map in chunks; {options.map} is none")
    return load_map(options.map)


def _size(path: Path) -> int:
    """Bytes of a file, or of all files in a folder."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


def _tell(console: Terminal, file: Path, seconds: float) -> None:
    size = f"{_size(file) / 1e6:.2f} MB, {seconds:.1f} s"
    console.say(f"{file} ({size})")

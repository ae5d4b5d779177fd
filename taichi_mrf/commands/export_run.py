"""What ``taichi-mrf export`` does: look at the names, load the map, write each file, say what was written."""

import json
import os
import time
from pathlib import Path
from typing import Any

from rich.console import Console

from taichi_mrf import runtime
from taichi_mrf.commands.export import Export
from taichi_mrf.errors import ConfigError
from taichi_mrf.export.formats import export_map, writer_of
from taichi_mrf.maps.create import load_map


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
    console = Console()
    m = load_map(options.map)
    written: list[dict[str, Any]] = []
    for path in options.to:
        begin = time.perf_counter()
        files = export_map(m, path, options.options)
        seconds = round(time.perf_counter() - begin, 3)
        for file in files:
            written.append({"file": str(file), "bytes": file.stat().st_size, "seconds": seconds})
            if not options.json:
                _tell(console, file, seconds)
    if options.json:
        print(json.dumps(written, indent=2))
    return 0


def _tell(console: Console, file: Path, seconds: float) -> None:
    size = f"{file.stat().st_size / 1e6:.2f} MB, {seconds:.1f} s"
    console.print(f"{file} ({size})", markup=False, highlight=False, soft_wrap=True)

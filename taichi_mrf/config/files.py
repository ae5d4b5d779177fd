"""Parameter files: where the shipped ones are, and YAML that is read without trust.

YAML's aliases let a file of a few hundred bytes stand for billions of values. No parameter needs them, and
they are refused.
"""

from pathlib import Path
from typing import Any

import yaml

import taichi_mrf
from taichi_mrf.errors import ConfigError, said
from taichi_mrf.system.files import exists, is_file, is_folder, read_text

_SUFFIX = ".yaml"
_MOST_BYTES = 1_000_000
"""Far more than all parameters with their comments."""


class _PlainLoader(yaml.SafeLoader):
    """PyYAML's safe loader without aliases and without keys that stand twice, of which it takes the last."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark
            raise yaml.composer.ComposerError(None, None, "aliases (*name) are not supported", mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        first: dict[str, yaml.Node] = {}
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and first.setdefault(key.value, key) is not key:
                problem = f"'{key.value[:100]}' stands twice"
                raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
        return super().construct_mapping(node, deep)


def parse_yaml(text: str) -> Any:
    """The plain values of a YAML text. Raises ValueError, whose text says what is wrong where."""
    try:
        return yaml.load(text, _PlainLoader)
    except (yaml.YAMLError, RecursionError) as error:
        raise ValueError(said(error)) from error


def read_yaml(path: Path) -> Any:
    """The plain values of a YAML file. Raises ConfigError, which names the file."""
    text = read_text(path, ConfigError, most_bytes=_MOST_BYTES)
    try:
        return parse_yaml(text)
    except ValueError as error:  # also for the 31st of February
        raise ConfigError(f"{path}: not valid YAML: {said(error)}") from error


def find_config(name: str | Path) -> Path:
    """The path of a parameter file: ``name`` itself if there is such a file, else the shipped file of that
    name, such as ``kinect1``. Raises ConfigError, which lists the shipped files, if there is neither."""
    path, shipped = Path(name), shipped_configs()
    if not is_file(path) and path.parent == Path() and path.suffix in ("", _SUFFIX) and path.stem in shipped:
        return shipped[path.stem]
    if not exists(path):
        names = ", ".join(shipped)
        raise ConfigError(f"{path}: no such file, nor a shipped configuration of that name ({names})")
    return path


def shipped_configs() -> dict[str, Path]:
    """The parameter files that come with the package, by their names."""
    package = Path(taichi_mrf.__file__).parent
    # A wheel holds them inside the package, a checkout beside it.
    folder = next(f for f in (package / "configs", package.parent / "configs") if is_folder(f))
    return {path.stem: path for path in sorted(folder.glob(f"*{_SUFFIX}"))}

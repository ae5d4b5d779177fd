"""Writes configs/default.yaml: every parameter with its help text and its default, from the dataclasses.

    python docs/make_default_yaml.py

Run it after a change of a parameter. The first lines of the file, up to the empty one, are kept.
"""

from pathlib import Path

from taichi_mrf.config.schema import Config
from taichi_mrf.config.text import commented_yaml

PATH = Path(__file__).resolve().parents[1] / "configs" / "default.yaml"


def main() -> None:
    heading, _, _ = PATH.read_text(encoding="utf-8").partition("\n\n")
    PATH.write_text(f"{heading}\n\n{commented_yaml(Config())}", encoding="utf-8")


if __name__ == "__main__":
    main()

"""Checks that the options of several commands share."""

from taichi_mrf.errors import ConfigError


def check_least(options: object, **least: int) -> None:
    """Raise ConfigError, which names the flag, if a field of the options is a number below its least."""
    for name, lowest in least.items():
        value = getattr(options, name)
        if isinstance(value, int) and value < lowest:
            raise ConfigError(f"--{name.replace('_', '-')} must be at least {lowest}, not {value}")


def check_port(port: int) -> None:
    """Raise ConfigError unless a page can be served at this port."""
    if not 0 <= port <= 65535:
        raise ConfigError(f"--port must lie between 0 and 65535, not {port}")

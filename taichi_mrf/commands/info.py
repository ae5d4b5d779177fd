"""``taichi-mrf info``: the backend that would be used, and what else there is."""

from dataclasses import dataclass

from taichi_mrf.config import Arch


@dataclass(frozen=True)
class Info:
    """Show the backend that runs here and why, what each backend can do, and versions."""

    arch: Arch = "auto"
    """Backend to start."""

    def run(self) -> int:
        """Start the backend and print the tables. Raises BackendError."""
        from rich.console import Console
        from rich.table import Table

        from taichi_mrf import runtime

        runtime.init(self.arch)
        choice = runtime.choice()
        assert choice is not None
        table = Table("backend", "here", "can do", title="Backends", title_justify="left")
        for status in runtime.backends():
            here = status.device if status.problem is None else f"no: {status.problem}"
            table.add_row(status.name, here, status.ability)
        console = Console(soft_wrap=False)
        console.print(f"Runs on [bold]{choice.name}[/]: {choice.device}, {choice.reason}.")
        for name, why in choice.rejected.items():
            console.print(f"Not on {name}: {why}.")
        console.print(table)
        for name, version in runtime.versions().items():
            console.print(f"{name} {version}", highlight=False)
        return 0

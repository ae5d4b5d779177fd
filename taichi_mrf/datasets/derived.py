"""What datasets have in common that show the frames of another one in another way."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from taichi_mrf.datasets.base import Dataset


@dataclass
class Derived(Dataset):
    """As many frames as ``source`` has, by the same names; what a frame is, the class says that derives from
    this one."""

    source: Dataset = field(kw_only=True)

    @property
    def endless(self) -> bool:
        """Whether the source is."""
        return self.source.endless

    @property
    def frame_names(self) -> Sequence[str]:
        """The source's."""
        return self.source.frame_names

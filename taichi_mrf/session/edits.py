"""Edits of keyframes that can be taken back and made again.

They are kept where requests are carried out one after the other: the page knows the state of a keyframe only
once the answer has come, and its users press on before.
"""

from collections.abc import Collection

from taichi_mrf.viewer.messages import Move, Switch

Edit = Switch | Move

Pair = tuple[Edit, Edit]
"""What takes an edit of one keyframe back, and what makes it again."""


class EditHistory:
    """The edits that were carried out, those of one press together, and how many presses count now."""

    def __init__(self) -> None:
        self._presses: list[list[Pair]] = []
        self._done = 0
        self._joined: list[Pair] = []

    @property
    def can_undo(self) -> bool:
        """True if there is an edit to take back."""
        return self._done > 0

    @property
    def can_redo(self) -> bool:
        """True if there is an edit to make again."""
        return self._done < len(self._presses)

    def note(self, press: list[Pair]) -> None:
        """Add the edits of one press, if there are any; those that were taken back are gone then."""
        if press:
            self._presses[self._done :] = [press]
            self._done += 1

    def join(self, pair: Pair) -> None:
        """Note a keyframe that has joined the map of an earlier recording: all of them are taken back at
        once."""
        if any(press is self._joined for press in self._presses[: self._done]):
            self._joined.append(pair)
        else:
            self._joined = [pair]
            self.note(self._joined)

    def next(self, again: bool) -> list[Edit]:
        """The edits that take the last press back, or make the next one ``again``; empty if there is none."""
        if again:
            return [forth for _, forth in self._presses[self._done]] if self.can_redo else []
        return [back for back, _ in self._presses[self._done - 1]] if self.can_undo else []

    def step(self, again: bool) -> None:
        """Note that :meth:`next` was carried out."""
        self._done += 1 if again else -1

    def forget(self, keyframes: Collection[int]) -> None:
        """Edits of these keyframes can no longer be taken back."""
        for press in self._presses:
            press[:] = [pair for pair in press if pair[1].keyframe not in keyframes]
        self._done = sum(map(bool, self._presses[: self._done]))
        self._presses = [press for press in self._presses if press]

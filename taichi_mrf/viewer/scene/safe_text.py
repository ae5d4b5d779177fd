"""Text from data, such as the name of a frame, as the page may show it: every character is itself, none is
markup.

viser renders HTML inside markdown, so an unescaped file name could run a script in the page. All text that
is not written in this package passes through one of these two functions before it reaches a markdown or an
HTML widget. Other widgets (dropdowns, labels, notifications) show plain text.
"""

import html
import string
import unicodedata

LONGEST = 1000
"""Characters of one text in markdown; the rest is cut off."""

_PUNCTUATION = {ord(c): f"&#{ord(c)};" for c in string.punctuation}
_INVISIBLE = {"Cc", "Cf", "Cs", "Co", "Cn"}


def in_markdown(text: str) -> str:
    """One paragraph of markdown that reads as ``text``: line breaks become spaces."""
    one_line = _visible(" ".join(text.split()))
    if len(one_line) > LONGEST:
        one_line = one_line[: LONGEST - 1] + "…"
    return one_line.translate(_PUNCTUATION)


def in_html(text: str) -> str:
    """HTML that reads as ``text``, inside an element or an attribute in quotes; line breaks stay."""
    return "\n".join(html.escape(_visible(line)) for line in text.split("\n"))


def _visible(text: str) -> str:
    """Without control characters, some of which turn the direction of the text around."""
    return "".join("\N{REPLACEMENT CHARACTER}" if unicodedata.category(c) in _INVISIBLE else c for c in text)

"""The code that pages of the documentation print."""

import re


def code_of(page: str, kind: str = "python") -> list[str]:
    """The blocks of code of a kind in the text of a page; those of shell commands have none, ""."""
    found = re.findall(r"^```(\w*)\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    return [code for each, code in found if each == kind]

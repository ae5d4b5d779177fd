"""Values that clients write into widgets: taken as the stock client sends them, else clamped or refused."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from live_program import wait_for
from raw_viewer_client import RawClient, widget_message

from taichi_mrf.viewer.transport import connection
from taichi_mrf.viewer.transport.guard import LARGEST_NUMBER, LONGEST_TEXT, is_same, value_to_set

if TYPE_CHECKING:
    from guarded_page import GuardedPage

pytest_plugins = ["guarded_page"]


@pytest.mark.parametrize(
    ("name", "sent", "in_force"),
    [
        ("slider", 0.30000000000000004, 0.3),
        ("slider", 1, 1.0),
        ("whole slider", 6, 6),
        ("number", 0.1, 0.1),
        ("whole number", -7, -7),
        ("checkbox", True, True),
        ("text", "häuser", "häuser"),
        ("dropdown", "b", "b"),
        ("range", [0.1, 0.8], (0.1, 0.8)),
        ("rgb", [4, 5, 6], (4, 5, 6)),
        ("vector", [1, 0.5, -1], (1.0, 0.5, -1.0)),
        ("button", True, True),
        ("button group", "y", "y"),
    ],
)
def test_what_the_stock_client_sends_is_taken(
    guarded: GuardedPage, stranger: RawClient, name: str, sent: Any, in_force: Any
) -> None:
    stranger.say(widget_message(guarded.uuid(name), sent))
    wait_for(lambda: len(guarded.events) == 1, "the callback")
    assert guarded.events == [(name, in_force)]
    assert guarded.widgets[name].value == in_force
    assert type(guarded.widgets[name].value) is type(in_force)


@pytest.mark.parametrize(
    ("name", "sent", "in_force"),
    [
        ("slider", 1e300, 1.0),
        ("slider", -5, 0.1),
        ("slider", 0.777, 0.8),
        ("whole slider", 2**64 - 1, 10),
        ("whole slider", 6.9, 6),
        ("number", 1e300, 5.0),
        ("number", 0.1 + 1e-5, 0.1),
        ("whole number", 2**64 - 1, LARGEST_NUMBER),
        ("whole number", -1e300, -LARGEST_NUMBER),
        ("text", "x" * 60_000, "x" * LONGEST_TEXT),
        ("range", [-3.0, 1e9], (0.0, 1.0)),
        ("rgb", [-1, 128.4, 1e12], (0, 128, 255)),
        ("vector", [-2, 1e300, 0.12], (-1.0, float(LARGEST_NUMBER), 0.1)),
    ],
)
def test_a_value_out_of_range_is_clamped_and_sent_back(
    guarded: GuardedPage,
    stranger: RawClient,
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    sent: Any,
    in_force: Any,
) -> None:
    monkeypatch.setattr(connection, "TYPING_REST_S", 0.05)
    stranger.say(widget_message(guarded.uuid(name), sent))
    told = stranger.hear_type("GuiUpdateMessage", uuid=guarded.uuid(name))["updates"]["value"]
    assert told == (list(in_force) if isinstance(in_force, tuple) else in_force)
    guarded.settle(stranger)
    assert guarded.widgets[name].value == in_force
    assert type(guarded.widgets[name].value) is type(in_force)


WRONG_TYPES = {
    "slider": ["0.5", True, [0.5], "", math.nan, math.inf, -math.inf, None, {}],
    "whole slider": ["4", False, math.nan, math.inf, [[]], b"4"],
    "number": ["1", True, math.nan, -math.inf, [1]],
    "whole number": ["1", True, math.nan, math.inf],
    "checkbox": [1, 0, "true", "", [True], math.nan],
    "text": [1, True, ["a"], None, b"bytes"],
    "dropdown": ["c", "", 0, True, ["a"], "a" * 1000],
    "range": [
        [0.5],
        [0.1, 0.2, 0.3],
        0.5,
        "ab",
        [math.nan, 0.5],
        [0.8, 0.2],
        [0.5, 0.5],
        [True, False],
        [0] * 50_000,
    ],
    "rgb": [[1, 2], [1, 2, 3, 4], "abc", [1, 2, math.nan], ["1", "2", "3"], 7],
    "vector": [[0, 0], [0, 0, math.inf], "abc", 0.0],
    "button": [False, 1, "true", "", [True]],
    "button group": ["z", "", 0, ["x"]],
    "upload": ["file", True, ["a"], 0],
    "progress": [50.0, 99, True],
    "disabled": [True, 1],
    "hidden": [True],
    "in a hidden folder": [True],
}


@pytest.mark.parametrize("name", WRONG_TYPES)
def test_wrong_values_change_nothing(guarded: GuardedPage, stranger: RawClient, name: str) -> None:
    before = guarded.state()
    for value in WRONG_TYPES[name]:
        stranger.say(widget_message(guarded.uuid(name), value))
    guarded.settle(stranger)
    assert guarded.state() == before
    assert guarded.events == []


def test_a_client_whose_value_was_refused_is_told_what_is_in_force(
    guarded: GuardedPage, stranger: RawClient
) -> None:
    stranger.say(widget_message(guarded.uuid("disabled"), True))
    assert stranger.hear_type("GuiUpdateMessage", uuid=guarded.uuid("disabled"))["updates"] == {
        "value": False
    }


KINDS = sorted(WRONG_TYPES)
ANY_NUMBER = st.integers(-(2**63), 2**64 - 1) | st.floats()
ANY_VALUE = st.booleans() | ANY_NUMBER | st.text() | st.lists(ANY_NUMBER, max_size=5)


@given(sent=ANY_VALUE, name=st.sampled_from(KINDS))
def test_a_value_is_taken_in_the_widgets_own_type_or_refused(
    running_page: GuardedPage, sent: Any, name: str
) -> None:
    widget = running_page.widgets[name]
    taken = value_to_set(widget, sent)
    assert is_same(sent, widget.value) in (True, False)
    assert taken is None or (type(taken) is type(widget.value) and is_same(sent, taken) in (True, False))


@given(
    sent=ANY_VALUE, name=st.sampled_from(["slider", "whole slider", "number", "whole number", "range", "rgb"])
)
def test_a_number_that_is_taken_is_in_range(running_page: GuardedPage, sent: Any, name: str) -> None:
    widget = running_page.widgets[name]
    taken = value_to_set(widget, sent)
    if taken is None:
        return
    values = taken if isinstance(taken, tuple) else (taken,)
    current = widget.value if isinstance(widget.value, tuple) else (widget.value,)
    lower, upper = (0, 255) if name == "rgb" else (widget.min, widget.max)
    assert len(values) == len(current)
    for value, before in zip(values, current, strict=True):
        assert type(value) is type(before)
        assert (-LARGEST_NUMBER if lower is None else lower) <= value
        assert value <= (LARGEST_NUMBER if upper is None else upper)
    if isinstance(sent, float | int) and math.isfinite(sent) and "slider" in name:
        steps = (taken - lower) / widget.step
        assert math.isclose(steps, round(steps), abs_tol=1e-6)
        assert abs(taken - min(max(sent, lower), upper)) <= widget.step / 2 + 1e-9

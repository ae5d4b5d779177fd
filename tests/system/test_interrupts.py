"""Ctrl-C while a map is being changed."""

import os
import signal
import threading

import pytest

from taichi_mrf.system.interrupts import interrupts_noted, interrupts_wait


@pytest.mark.usefixtures("own_interrupts")
def test_an_interrupt_takes_effect_after_the_block() -> None:
    handler, done = signal.getsignal(signal.SIGINT), []

    def change() -> None:
        with interrupts_wait():
            os.kill(os.getpid(), signal.SIGINT)
            done.append("the rest of the block")

    with pytest.raises(KeyboardInterrupt):
        change()
    assert done
    assert signal.getsignal(signal.SIGINT) is handler


def test_the_handler_of_the_program_is_called_and_stays() -> None:
    called: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: called.append(number))
    try:
        with interrupts_wait():
            os.kill(os.getpid(), signal.SIGINT)
            assert called == []
        assert called == [signal.SIGINT]
        with pytest.raises(ValueError, match="its own"), interrupts_wait():
            raise ValueError("its own")
        os.kill(os.getpid(), signal.SIGINT)
        assert len(called) == 2
    finally:
        signal.signal(signal.SIGINT, before)


def test_another_thread_is_left_alone() -> None:
    handler, seen = signal.getsignal(signal.SIGINT), []

    def work() -> None:
        with interrupts_wait():
            seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [handler]


@pytest.mark.usefixtures("own_interrupts")
def test_the_first_ctrl_c_is_noted_and_the_second_raises() -> None:
    with interrupts_noted() as came:
        assert not came()
        signal.raise_signal(signal.SIGINT)
        assert came()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)

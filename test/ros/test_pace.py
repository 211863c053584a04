"""When the next message is begun: at the time asked for, less what its preparation usually takes."""

from __future__ import annotations

import math

import pytest

from regnet_ros.pace import Lead, Pace, Usual


def test_the_usual_time_is_the_median_of_the_last_five() -> None:
    usual = Usual()
    assert usual.seconds is None
    for seconds in (9.0, 1.0, 2.0, 3.0, 4.0):
        usual.add(seconds)
    assert usual.seconds == 3.0
    for seconds in (1.0, 1.0, 1.0):
        usual.add(seconds)
    assert usual.seconds == 1.0


def test_the_first_one_does_not_wait_and_a_lost_one_is_waited_for_two_seconds() -> None:
    pace = Pace()
    assert pace.pause(100.0) == -math.inf
    pace.begun(100.0)
    pace.sent(100.5)
    assert pace.pause(101.0) == pytest.approx(1.0)
    assert pace.pause(102.0) == pytest.approx(0.0)


def test_preparation_ends_when_the_message_is_wanted() -> None:
    pace = Pace()
    pace.begun(0.0)
    pace.sent(0.25)
    pace.wanted(10.0)
    assert pace.pause(9.0) == pytest.approx(0.75)
    assert pace.pause(9.75) == pytest.approx(0.0)
    pace.wanted(11.0)  # somebody slower
    assert pace.pause(9.75) == pytest.approx(0.0)
    pace.wanted(9.0)  # who has finished early
    assert pace.pause(8.0) == pytest.approx(0.75)


def test_a_request_is_for_one_message() -> None:
    pace = Pace()
    pace.wanted(1.0)
    pace.begun(0.9)
    pace.sent(1.0)
    assert pace.pause(1.0) == pytest.approx(1.9)


def test_what_came_to_nothing_leaves_its_request_open() -> None:
    pace = Pace()
    pace.wanted(1.0)
    pace.begun(0.9)
    pace.failed()
    assert pace.pause(1.0) <= 0.0


def test_a_request_that_arrives_before_the_message_is_known_to_be_sent_is_for_the_next_one() -> None:
    pace = Pace()
    pace.begun(1.0)
    pace.wanted(1.6)
    pace.sent(1.1)
    assert pace.pause(1.2) == pytest.approx(0.3)


def test_what_is_late_is_asked_for_sooner_and_what_waits_later() -> None:
    lead = Lead()
    lead.add(0.04, most=1.0)
    assert lead.seconds == pytest.approx(0.02)
    lead.add(-0.01, most=1.0)  # it waited for no longer than it may
    assert lead.seconds == pytest.approx(0.02)
    lead.add(-0.06, most=1.0)
    assert lead.seconds == pytest.approx(0.015)
    lead.add(-9.0, most=1.0)
    assert lead.seconds == 0.0
    lead.add(60.0, most=1.0)  # a pause of the camera says nothing about the usual delay
    assert lead.seconds == pytest.approx(0.05)
    for _ in range(9):
        lead.add(60.0, most=0.1)
    assert lead.seconds == 0.1


@pytest.mark.parametrize("delay", [0.0, 0.015, 0.04])
def test_after_some_messages_the_next_one_is_there_in_time(delay: float) -> None:
    """A work of 0.1 s each, and messages that come so long after the time that they were asked for."""
    lead, lates, asked_ahead = Lead(), [], 0.0
    for _ in range(40):
        late = delay - asked_ahead
        lead.add(late, most=0.1)
        lates.append(late)
        asked_ahead = lead.seconds
    assert max(lates[10:]) <= 0.005 and min(lates[10:]) >= -0.02

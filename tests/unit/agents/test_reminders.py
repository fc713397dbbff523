"""A message that awaits an answer is repeated soon, and then ever more patiently."""

from agents.reminders import Reminders


def test_the_waits_double_until_the_answer_comes():
    reminders = Reminders(beat_s=10.0)
    assert reminders.next_due() == float("inf")
    reminders.start("a", now=5.0)
    due = []
    for _ in range(3):
        due.append(reminders.next_due())
        assert reminders.take_due(reminders.next_due()) == ["a"]
    assert due == [6.0, 8.0, 12.0]
    reminders.stop("a")
    assert reminders.take_due(100.0) == []


def test_a_new_message_begins_anew_and_neighbours_are_reminded_each_in_its_time():
    reminders = Reminders(beat_s=10.0)
    reminders.start("a", now=0.0)
    reminders.start("b", now=0.5)
    assert reminders.take_due(1.0) == ["a"]
    assert reminders.take_due(1.5) == ["b"]
    reminders.start("a", now=2.0)
    assert reminders.take_due(3.0) == ["a"]

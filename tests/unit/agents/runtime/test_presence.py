"""A name is present as long as any of its incarnations shows a token."""

from agents.messages.keys import incarnation_of, live_key, name_of_live
from agents.messages.packing import Incarnation
from agents.runtime.presence import Presence, begin_incarnation, read_leave
from dsse_core.split_identity import END_OF_TIME, SplitIdentity

OLD, NEW = (live_key("r", "area", "area1", Incarnation(start, 7)) for start in (1_000, 2_000))


def test_a_token_with_a_split_is_one_of_the_incarnation():
    presence, split = Presence(), SplitIdentity("1a2b3c4d5e6f7081", END_OF_TIME - 1, "55aa66bb77cc88dd")
    key = live_key("r", "area", "area1", Incarnation(16**14 - 1, 16**8 - 1), split)
    assert incarnation_of(key) == Incarnation(16**14 - 1, 16**8 - 1)
    assert presence.take(key, True)
    assert presence.take(key, False)


def test_a_token_says_whose_it_is():
    assert name_of_live(OLD) == ("area", "area1")
    assert OLD != NEW


def test_the_token_of_an_old_incarnation_that_vanishes_late_does_not_hide_the_new_incarnation():
    presence = Presence()
    assert presence.take(OLD, True)
    assert presence.take(NEW, True)
    assert not presence.take(OLD, False)
    assert presence.take(NEW, False)


def test_who_is_forgotten_is_there_when_it_is_seen_again():
    presence = Presence()
    presence.take(OLD, True)
    presence.take(NEW, True)
    assert presence.forget() == [("area", "area1")]
    assert presence.names == set()
    assert not presence.take(OLD, False)
    assert presence.take(NEW, True)


def test_a_leave_message_counts_before_and_after_the_end_of_its_token_but_not_while_another_incarnation_is_there():
    presence = Presence()
    presence.take(OLD, True)
    assert presence.take_leave(OLD)
    assert not presence.take(OLD, False)
    presence.take(OLD, True)
    presence.take(OLD, False)
    assert presence.take_leave(OLD)
    presence.take(NEW, True)
    assert not presence.take_leave(OLD)


def test_a_token_seen_twice_is_no_updates_and_one_never_seen_cannot_vanish():
    presence = Presence()
    assert presence.take(OLD, True)
    assert not presence.take(OLD, True)
    assert not presence.take(NEW, False)
    assert presence.take(OLD, False)
    assert not presence.take(OLD, False)


def test_the_incarnations_of_a_name_are_distinguished_from_the_oldest_to_the_newest_and_no_chunk_that_is_none():
    presence = Presence()
    for key in (NEW, OLD, NEW.replace("-", "x"), NEW + "0"):
        presence.take(key, True)
    assert presence.incarnations_of("area", "area1") == [Incarnation(1_000, 7), Incarnation(2_000, 7)]
    assert presence.incarnations_of("area", "area2") == []


def test_a_leave_message_is_a_word_or_two_and_nothing_else():
    assert read_leave(b"SIGTERM") == "SIGTERM"
    for other in (b"", b"\xff", b"a\nb", b"x" * 41):
        assert read_leave(other) == ""


def test_two_incarnations_that_begin_in_the_same_millisecond_differ():
    assert len({begin_incarnation().random for _ in range(10)}) == 10

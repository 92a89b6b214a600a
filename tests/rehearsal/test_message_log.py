"""Messages wait for room, stay until they are read or for some seconds, and can all be read again."""

from rehearsal.message_log import LETTERS, LINES, MOST_KEPT, READ_S, MessageLog

LONG = "word " * (LETTERS * LINES // 5)


def log_of(*texts: str) -> MessageLog:
    log = MessageLog()
    for number, text in enumerate(texts):
        log.add(text, float(number))
    return log


def test_a_message_stays_for_some_seconds_from_when_it_is_shown():
    log = log_of("undo")
    # It was added long before the window drew it.
    assert log.shown(100.0) == log.shown(99.9 + READ_S) == ("undo",)
    assert log.shown(100.1 + READ_S) == ()


def test_what_does_not_fit_waits_and_keeps_its_order():
    log = log_of("first", LONG, "last")
    assert log.shown(0.0) == ("first",)
    assert log.shown(READ_S) == (LONG,)
    assert log.shown(2 * READ_S) == ("last",)
    assert log_of("a", "b", "c", "d").shown(0.0) == ("a", "b", "c")


def test_read_messages_leave_room_for_those_that_wait():
    log = log_of("first", LONG)
    assert log.shown(0.0) == ("first",)
    log.dismiss()
    assert log.shown(0.1) == (LONG,)
    log.dismiss()
    assert log.shown(0.2) == ()


def test_a_message_again_is_shown_once_and_for_its_whole_time():
    log = log_of("no bookmark")
    assert log.shown(0.0) == ("no bookmark",)
    log.add("no bookmark", 1.0)
    assert log.shown(READ_S - 1) == log.shown(2 * READ_S - 2) == ("no bookmark",)
    assert log.shown(2 * READ_S) == ()
    assert len(log_of("a", "a", "a").shown(0.0)) == 1


def test_all_are_kept_with_their_times():
    log = log_of("first", "second")
    assert list(log.kept) == [(0.0, "first"), (1.0, "second")]
    assert len(log_of(*map(str, range(MOST_KEPT + 5))).kept) == MOST_KEPT

"""Progress without a terminal: plain lines, at once."""

import time

from pushjax._internal import progress as bars


def lines(capsys) -> list[str]:
    return capsys.readouterr().err.splitlines()


def test_each_tenth_is_a_line(capsys):
    with bars.progress_bar("counting") as progress:
        assert lines(capsys) == ["pushjax: counting"]
        for done in range(101):
            progress(done, 100)
            expected = [f"pushjax: counting: {done}%"] if done % 10 == 0 < done else []
            assert lines(capsys) == expected
        progress.note("left out: one")
        progress.say("then this")
        progress(0, 0)
        progress(1, 3)
        assert lines(capsys) == ["pushjax: left out: one", "pushjax: then this", "pushjax: then this: 33%"]


def test_slow_work_is_not_silent(capsys, monkeypatch):
    """Work that reports nothing, as a compilation, has a line after each silence, with how far it has come."""
    monkeypatch.setattr(bars, "SILENCE", 0.05)
    with bars.progress_bar("working") as progress:
        time.sleep(0.3)
        progress.say("counting")
        progress(1, 1000)
        time.sleep(0.3)
    seen = lines(capsys)
    words = seen.index("pushjax: counting")
    assert words >= 3
    assert seen[0] == "pushjax: working"
    assert set(seen[1:words]) == {"pushjax: working: 0 s"}
    assert len(seen) >= words + 3
    assert set(seen[words + 1 :]) == {"pushjax: counting: 0 s (1 of 1000 done)"}
    time.sleep(0.1)
    assert lines(capsys) == []  # nothing is said after the end

"""Progress without a terminal: plain lines, at once."""

from pushjax._internal import progress_bar as bars


def lines(capsys) -> list[str]:
    return capsys.readouterr().err.splitlines()


def test_each_tenth_is_a_line(capsys):
    with bars.progress_bar() as progress:
        progress.say("counting")
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
    clock = [0.0]
    monkeypatch.setattr(bars.time, "monotonic", lambda: clock[0])
    with bars.progress_bar() as progress:
        for done, now in ((0, 20.0), (1, 20.5), (2, 25.0), (3, 31.0)):
            clock[0] = now
            progress(done, 1000)
    assert lines(capsys) == ["pushjax: 0%", "pushjax: 0%"]  # after 20.5 s, and 10 s later

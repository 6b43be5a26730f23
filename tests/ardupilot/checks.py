"""Counts checks, and waits for conditions."""

import contextlib
import time

counts = {"ok": 0, "FAIL": 0, "skipped": 0}


class Failed(Exception):
    """A flight did not reach the state to be checked."""


def say(text):
    print(text, flush=True)


def check(name, good, detail=""):
    word = "ok" if good else "FAIL"
    counts[word] += 1
    say("%-5s %s%s" % (word, name, ": %s" % detail if detail else ""))


def skip(name, why):
    counts["skipped"] += 1
    say("skipped: %s: %s" % (name, why))


@contextlib.contextmanager
def attempt(name):
    """Counts a flight that does not reach its state as a failure of this check."""
    try:
        yield
    except Failed as why:
        check(name, False, why)


def wait(what, done, within_s):
    """Returns the value of `done` as soon as it is true."""
    end = time.monotonic() + within_s
    while not (seen := done()):
        if time.monotonic() > end:
            raise Failed("waited %.0f s in vain for %s" % (within_s, what))
        time.sleep(0.005)
    return seen


def summary():
    say("%d passed, %d failed, %d skipped" % tuple(counts.values()))
    return 1 if counts["FAIL"] else 0

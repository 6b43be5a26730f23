"""Describes the failure of a plugin in one sentence that begins with the student's line."""

from __future__ import annotations

import linecache
import os
import sysconfig
from types import TracebackType

_OURS = os.path.dirname(os.path.abspath(__file__))
# Folders of library code.
_LIBRARIES = tuple(
    os.path.abspath(path) + os.sep
    for name in ("stdlib", "platstdlib", "purelib", "platlib")
    if (path := sysconfig.get_path(name))
)


def sentence(error: BaseException, method: str) -> str:
    """Returns the sentence for the runtime: place, error, and the source line.

    ``my_plugin.py:12 in on_image: ZeroDivisionError: division by zero (speed = 1 / x)``
    """
    if isinstance(error, KeyboardInterrupt):
        return "the plugin was interrupted (Ctrl-C)"
    what = type(error).__name__
    detail = " ".join(str(error).split())
    if isinstance(error, SystemExit):
        what, detail = "the plugin called exit", f"status {error.code or 0}"
    if isinstance(error, SyntaxError) and error.filename:
        # The error's own file and line are more useful than those of the import.
        return f"{os.path.basename(error.filename)}:{error.lineno}: {what}: {error.msg}"
    if isinstance(error, AttributeError):
        detail += _what_it_has(getattr(error, "obj", None))
    message = f"{what}: {detail}" if detail else what
    own = _own_line(error.__traceback__)
    if own is None:
        return f"in {method}: {message}"
    path, line, function = own
    source = linecache.getline(path, line).strip()
    inside = function if function == method else f"{function}, called from {method}"
    return f"{os.path.basename(path)}:{line} in {inside}: {message}" + (f" ({source})" if source else "")


def without_our_frames(traceback: TracebackType | None) -> TracebackType | None:
    """Returns the traceback, beginning with the student's first line."""
    at = traceback
    while at is not None and _path(at).startswith(_OURS + os.sep):
        at = at.tb_next
    # If all frames are of this package, keep them.
    return at or traceback


def _what_it_has(thing: object) -> str:
    """Returns all names of one of our types, as a hint for a wrong name."""
    if not type(thing).__module__.startswith("vizflyt"):
        return ""
    names = [name for name in dir(type(thing)) if not name.startswith("_")]
    return f"; it has {', '.join(names)}"


def _own_line(traceback: TracebackType | None) -> tuple[str, int, str] | None:
    """Returns file, line and function of the innermost frame in the student's code."""
    own = None
    while traceback is not None:
        path = _path(traceback)
        if not path.startswith((_OURS + os.sep, "<frozen", *_LIBRARIES)):
            own = (path, traceback.tb_lineno, traceback.tb_frame.f_code.co_name)
        traceback = traceback.tb_next
    return own


def _path(traceback: TracebackType) -> str:
    name = traceback.tb_frame.f_code.co_filename
    # `<stdin>` and a notebook's cell are not files.
    return name if name.startswith("<") else os.path.abspath(name)

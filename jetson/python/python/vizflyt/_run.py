"""Main loop of a plugin: waits for the runtime, calls the plugin, sends its replies.

Written in Python, so that a debugger can step through it and a traceback shows the student's lines. While it waits, it
does not hold the interpreter's lock.
"""

from __future__ import annotations

import difflib
import faulthandler
import inspect
import sys
import time
import warnings
from collections.abc import Iterator
from types import FunctionType

from ._failure import sentence, without_our_frames
from ._plugin import Plugin
from ._vizflyt import NotFiniteError, PluginEnd, Setpoint, waiting_services

SERVICE_OPTION = "--vizflyt-service"
# Short, so that Ctrl-C takes effect. [s]
WAIT_S = 0.1
# Exit status: no runtime to attach to.
NOT_ATTACHED = 2
# Arguments of each method, without self.
METHODS = {"on_start": ("info",), "on_image": ("obs",), "on_event": ("event",), "on_stop": ()}


class HeldImagesWarning(UserWarning):
    """The plugin keeps images of earlier calls, so that new ones have to be copied."""


def run(plugin: type[Plugin] | Plugin, *, service: str | None = None) -> None:
    """Runs a plugin until the end of the flight.

    ``vizflyt fly my_plugin.py`` starts the program and passes the address of its images on the command line. A plugin
    started by hand (``python my_plugin.py``, a debugger, a notebook) attaches to the user's only runtime that waits for
    a plugin (``vizflyt fly --attach``). If several wait, choose one with ``service``.

    ``plugin`` is a class derived from :class:`Plugin`, or an instance of one.

    An exception in the plugin ends the flight with a landing. The runtime receives the reason, and the exception is
    raised to the caller. Only a number that is not finite (:class:`NotFiniteError`) is printed and counts as a reply
    that the runtime rejects: the vehicle holds, and continues with the next valid setpoint.
    """
    end = _attach(service)
    where = "__init__"
    _prepare_output()
    try:
        plugin = _instance(plugin)
        for where in _serve(plugin, end):  # noqa: B007 - the failure names the last one
            pass
    except (Exception, SystemExit, KeyboardInterrupt) as error:
        error.__traceback__ = without_our_frames(error.__traceback__)
        try:
            end.failed(sentence(error, where))
        except RuntimeError:
            # The runtime sees that the process ends.
            pass
        raise


def _serve(plugin: Plugin, end: PluginEnd) -> Iterator[str]:
    """Runs the flight; yields the name of each method before it is called."""
    started = False
    copied = False
    refused = 0
    while True:
        end.wait(WAIT_S)
        while (message := end.receive()) is not None:
            what, content = message
            if what == "start":
                yield "on_start"
                plugin.on_start(content)
                end.ready(type(plugin).__name__)
                started = True
            elif what == "event":
                yield "on_event"
                plugin.on_event(content)
            else:
                yield "on_stop"
                plugin.on_stop()
                if what == "stop":
                    return
                print("plugin: the runtime is gone; ending", file=sys.stderr)
                raise SystemExit(1)
        if not started:
            continue
        obs = end.observation()
        if obs is None:
            continue
        if obs.is_copy and not copied:
            copied = True
            warnings.warn(HELD, HeldImagesWarning, stacklevel=2)
        seq = obs.seq
        yield "on_image"
        entered_ns = time.monotonic_ns()
        try:
            answer = plugin.on_image(obs)
        except NotFiniteError as error:
            refused += 1
            # Only the 1st, 10th, 100th and so on, because a NaN is usually followed by others.
            if str(refused).strip("0") == "1":
                print(f"plugin: {sentence(error, 'on_image')} ({refused} so far)", file=sys.stderr)
            end.answer_not_finite(seq, entered_ns)
            continue
        finally:
            # Returns the memory to the runtime, unless the plugin keeps an image.
            del obs
        if answer is not None and not isinstance(answer, Setpoint):
            raise TypeError(_wrong_answer(answer))
        end.answer(seq, entered_ns, answer)


HELD = (
    "the plugin keeps images of earlier calls, so new ones are copied until it releases some; "
    "keep what you need with .copy(), or only the newest image"
)


def _attach(service: str | None) -> PluginEnd:
    service = service or _service_argument(sys.argv)
    try:
        if service is None:
            waiting = waiting_services()
            if len(waiting) > 1:
                raise ConnectionError(
                    f"{len(waiting)} runtimes wait for a plugin: choose one with "
                    f"{SERVICE_OPTION} X, X being one of {', '.join(waiting)}"
                )
            if not waiting:
                name = sys.argv[0] or "my_plugin.py"
                raise ConnectionError(
                    "no runtime waits for a plugin; start one with `vizflyt fly --attach` in another "
                    f"terminal, or fly with `vizflyt fly {name}`"
                )
            service = waiting[0]
        return PluginEnd(service)
    except ConnectionError as error:
        print(f"plugin: {error}", file=sys.stderr)
        raise SystemExit(NOT_ATTACHED) from None


def _service_argument(arguments: list[str]) -> str | None:
    """Returns the value of `--vizflyt-service`, given as `--vizflyt-service X` or `--vizflyt-service=X`."""
    for at, argument in enumerate(arguments):
        if argument == SERVICE_OPTION:
            return arguments[at + 1] if at + 1 < len(arguments) else None
        if argument.startswith(SERVICE_OPTION + "="):
            return argument[len(SERVICE_OPTION) + 1 :]
    return None


def _prepare_output() -> None:
    # On a pipe, print would buffer thousands of lines.
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(line_buffering=True)
    # After a crash in compiled code, print the Python line that called it.
    if not faulthandler.is_enabled():
        try:
            faulthandler.enable()
        except (AttributeError, OSError, ValueError):
            # The stderr of a notebook is not a file.
            pass


def _instance(plugin: type[Plugin] | Plugin) -> Plugin:
    """Checks the plugin's class before take-off; returns an instance of it."""
    kind = plugin if isinstance(plugin, type) else type(plugin)
    if not issubclass(kind, Plugin):
        raise TypeError(
            f"{kind.__name__} is not a plugin: define it as class {kind.__name__}(vizflyt.Plugin)"
        )
    if kind.on_image is Plugin.on_image:
        own = [name for name, value in vars(kind).items() if isinstance(value, FunctionType)]
        close = difflib.get_close_matches("on_image", own, n=1, cutoff=0.5)
        hint = f"; rename {close[0]} to on_image?" if close else ""
        raise TypeError(f"{kind.__name__} has no method on_image(self, obs){hint}")
    if isinstance(plugin, type):
        plugin = plugin()
    for name, arguments in METHODS.items():
        method = getattr(plugin, name)
        wanted = f"def {name}({', '.join(('self', *arguments))})"
        if inspect.iscoroutinefunction(method):
            raise TypeError(f"{kind.__name__}.{name} is async, but is not awaited: write {wanted}")
        try:
            inspect.signature(method).bind(*arguments)
        except TypeError as error:
            raise TypeError(f"{kind.__name__}.{name} must be {wanted}: {error}") from None
    return plugin


def _wrong_answer(answer: object) -> str:
    what = type(answer).__name__
    hint = "a vizflyt.Setpoint, such as Setpoint.velocity([1, 0, 0]), or None"
    if callable(answer):
        name = getattr(answer, "__name__", what)
        return f"on_image returned the function {name} itself; call it: {name}(...)"
    shape = f" of shape {answer.shape}" if hasattr(answer, "shape") else ""
    return f"on_image returned a {what}{shape}; return {hint}"

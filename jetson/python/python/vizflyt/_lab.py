"""A lab flown by hand from a notebook: look, step, fly, land."""

from __future__ import annotations

import atexit
import threading
import time
from collections.abc import Callable
from types import TracebackType

from ._run import WAIT_S
from ._vizflyt import ArenaInfo, Event, Observation, PluginEnd, Setpoint, waiting_services

# A step's setpoint stays in force for this time, as a plugin's does. [s]
STEP_S = 0.5
# Timeouts. Take-off takes about 6 s, landing at most 60 s. [s]
TAKE_OFF_WITHIN_S, LAND_WITHIN_S = 60.0, 90.0
# Timeout for the next image. [s]
IMAGE_WITHIN_S = 10.0
# Prefix of the runtime's note about a rejected setpoint.
REFUSED = "setpoint refused: "
START = "start one with `vizflyt fly --attach`, in a terminal or another cell, and call vizflyt.attach() again"

_attached: Lab | None = None


def attach(*, service: str | None = None, wait_s: float = 30.0) -> Lab:
    """Attaches to a lab that waits for a plugin (``vizflyt fly --attach``), and returns it on the ground, with images.

        lab = vizflyt.attach()
        lab.take_off()
        obs = lab.fly(Setpoint.velocity([1, 0, 0], axes="heading"), seconds=2)
        lab.land()

    Waits up to `wait_s` for such a lab [s]. If several labs wait, choose one with `service`.

    Raises ConnectionError if there is no lab, RuntimeError if one is already attached, because only one is possible.
    """
    global _attached
    if _attached is not None and _attached.is_attached:
        raise RuntimeError(f"{_attached} is already attached: continue with it, or end it first with close()")
    until_s = time.monotonic() + wait_s
    while service is None:
        waiting = waiting_services()
        if len(waiting) > 1:
            raise ConnectionError(
                f"{len(waiting)} labs wait for a plugin: choose one with vizflyt.attach(service=X), "
                f"X being one of {', '.join(map(repr, waiting))}"
            )
        if waiting:
            service = waiting[0]
        elif time.monotonic() < until_s:
            time.sleep(WAIT_S)
        else:
            raise ConnectionError(f"no lab waits for a plugin; {START}")
    # The only reference to the connection's end. When it is dropped, the runtime sees that the plugin is gone.
    _attached = Lab(PluginEnd(service))
    try:
        _attached._wait(lambda lab: lab._info is not None, IMAGE_WITHIN_S, "the lab does not answer")
    except BaseException:
        _attached._let_go()
        raise
    return _attached


class Lab:
    """A lab flown by hand; :func:`attach` returns it.

    As in the real lab, time continues between two calls. A thread replies to every image. Without a request it replies
    **hold**: after :meth:`fly`, 0.5 s after :meth:`step`, and while you read and think. So the deadlines of plugins
    never land the vehicle, but the course's time limit and an empty battery do. The guard has the last word, as with
    any plugin.

    Ctrl-C ("interrupt the kernel") ends a call, and the vehicle holds. When the kernel ends, the vehicle lands. As a
    context manager, the lab lands the vehicle at the end of the block.
    """

    def __init__(self, end: PluginEnd):
        self.events: list[Event] = []
        """Events of this flight, the newest last."""
        self._info: ArenaInfo | None = None
        self._phase = "connecting"
        # Requested camera, and the newest observation with an image of it.
        self._camera: str | None = None
        self._newest: Observation | None = None
        # Requested setpoint and its end.
        self._asked: Setpoint | None = None
        self._asked_until_s = 0.0
        # Reason of a rejected setpoint: before the vehicle is commanded to hold, and after.
        self._refusal: str | None = None
        self._refused: str | None = None
        self._takes_off = self._lands = self._leaves = False
        # Reason why the lab is detached, and whether the flight ended normally.
        self._over: str | None = None
        self._is_whole = False
        self._news = threading.Condition()
        self._thread = threading.Thread(target=self._serve, args=(end,), name="vizflyt lab", daemon=True)
        self._thread.start()

    @property
    def info(self) -> ArenaInfo:
        """The arena: fence, limits, cameras, allowed setpoints."""
        assert self._info is not None
        return self._info

    @property
    def phase(self) -> str:
        """Phase of the flight: 'connecting', 'preparing', 'taking_off', 'flying', 'holding' (the guard holds the
        vehicle), 'landing' or 'landed'.
        """
        return self._phase

    @property
    def is_attached(self) -> bool:
        """Whether the flight continues, on the ground or in the air."""
        return self._over is None

    @property
    def is_flying(self) -> bool:
        """Whether the vehicle is in the air and accepts setpoints."""
        return self.is_attached and self._phase in ("flying", "holding")

    def look(self, camera: str | None = None) -> Observation:
        """Waits for the next image of a camera (default: the course's first), and returns the observation that
        contains it. This also works on the ground.

        The observation contains other cameras if they were rendered at the same instant. Its `imu` are the samples
        since the previous observation, not since your last look.

        Raises LookupError if the vehicle has no such camera.
        """
        cameras = [known.name for known in self.info.cameras]
        if camera is not None and camera not in cameras:
            raise LookupError(f"there is no camera {camera!r}; this vehicle has {', '.join(map(repr, cameras))}")
        with self._news:
            self._camera, self._newest = camera or next(iter(cameras), None), None
        self._wait(lambda lab: lab._newest is not None, IMAGE_WITHIN_S, "no image has come")
        newest = self._newest
        assert newest is not None
        return newest

    def take_off(self) -> Observation:
        """Takes off, waits until the vehicle holds at its take-off height, and returns the observation there."""
        if self.is_flying:
            raise RuntimeError("the vehicle is already in the air")
        self._takes_off = True
        self._wait(lambda lab: lab.is_flying, TAKE_OFF_WITHIN_S, "the vehicle has not taken off")
        return self.look()

    def step(self, setpoint: Setpoint) -> Observation:
        """Requests `setpoint` and returns the observation with the next image: one iteration of a loop.

        The setpoint stays in force until the next call, at most 0.5 s; then the vehicle holds.
        """
        self._ask(setpoint, STEP_S)
        return self.look()

    def fly(self, setpoint: Setpoint, seconds: float) -> Observation:
        """Flies `setpoint` for `seconds` [s], holds, and returns the next observation. Ctrl-C ends it early."""
        self._ask(setpoint, seconds)
        until_s = self._asked_until_s
        try:
            over = lambda lab: time.monotonic() >= until_s or not lab.is_flying
            self._wait(over, seconds + TAKE_OFF_WITHIN_S, "fly() did not end")
        finally:
            self._asked = None
        self._check_flying()
        return self.look()

    def land(self) -> str:
        """Lands, waits until the flight is over, and returns the reason of its end in a sentence."""
        self._check_attached()
        if not self._takes_off:
            raise RuntimeError("the vehicle is on the ground; close() ends a flight that has not started")
        self._lands = True
        self._wait(lambda lab: not lab.is_attached, LAND_WITHIN_S, "the vehicle has not landed")
        if not self._is_whole:
            self._check_attached()
        return self._reason()

    def close(self) -> None:
        """Ends the flight: lands if the vehicle is in the air, then detaches from the lab. Can be called again."""
        try:
            if self.is_attached and self._takes_off:
                self.land()
        finally:
            self._let_go()

    def __enter__(self) -> Lab:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        name = self._info.name if self._info else "?"
        return f"<Lab {name}: {self._phase if self.is_attached else f'over, {self._reason()}'}>"

    # ---- on the caller's thread ----

    def _ask(self, setpoint: Setpoint, seconds: float) -> None:
        if not isinstance(setpoint, Setpoint):
            what = type(setpoint).__name__
            raise TypeError(f"a {what} is not a vizflyt.Setpoint; give one, such as Setpoint.velocity([1, 0, 0])")
        if setpoint.kind == "land":
            raise ValueError("call land(), which waits until the vehicle has landed")
        if setpoint.kind == "offset":
            raise ValueError(
                "an offset is relative to the vehicle's position at each image; give "
                "Setpoint.waypoints([d_m], speed_mps, axes=...), which begins at the current position"
            )
        self._check_flying()
        with self._news:
            self._check_refused()
            self._asked, self._asked_until_s = setpoint, time.monotonic() + seconds

    def _wait(self, holds: Callable[[Lab], bool], seconds: float, otherwise: str) -> None:
        """Waits until `holds` returns True. Raises an error if the flight ends or the setpoint is rejected before."""
        until_s = time.monotonic() + seconds
        with self._news:
            while not holds(self):
                self._check_attached()
                self._check_refused()
                if time.monotonic() >= until_s:
                    last = f"; the last event: {self.events[-1].text}" if self.events else ""
                    raise TimeoutError(f"{otherwise} within {seconds:.0f} s{last}")
                self._news.wait(WAIT_S)

    def _check_attached(self) -> None:
        if not self.is_attached:
            raise ConnectionError(f"the flight is over: {self._reason()}. For the next one {START}")

    def _check_flying(self) -> None:
        self._check_attached()
        if self._phase in ("landing", "landed"):
            raise ConnectionError(f"the vehicle is landing: {self._reason()}. After landing {START}")
        if not self.is_flying:
            raise RuntimeError("the vehicle is on the ground; call take_off() first")

    def _check_refused(self) -> None:
        if self._refused is not None:
            refused, self._refused = self._refused, None
            raise ValueError(refused)

    def _reason(self) -> str:
        ended = [event.text for event in self.events if event.kind == "ended"]
        return ended[0] if ended else self._over or "no reason was given"

    def _let_go(self) -> None:
        """Detaches from the lab; the runtime lands a vehicle that is in the air."""
        self._leaves = True
        self._thread.join(10 * WAIT_S)

    # ---- on the lab's thread ----

    def _serve(self, end: PluginEnd) -> None:
        over = "the notebook has detached from the lab"
        is_ready = False
        try:
            while not self._leaves:
                end.wait(WAIT_S)
                while (message := end.receive()) is not None:
                    what, content = message
                    if what == "stop":
                        over, self._is_whole = "the flight has ended", True
                        return
                    if what == "gone":
                        over = "the lab is gone: its program has ended"
                        return
                    self._take(content)
                if self._takes_off and not is_ready:
                    # The runtime takes off after this message.
                    end.ready("notebook")
                    is_ready = True
                if self._info is not None and (obs := end.observation()) is not None:
                    entered_ns = time.monotonic_ns()
                    answer = self._answer(obs)
                    if is_ready:
                        end.answer(obs.seq, entered_ns, answer)
                    # Returns the memory to the runtime, unless the caller keeps an image.
                    del obs
            if not is_ready:
                end.failed("the notebook has detached from the lab before take-off")
        except Exception as error:
            over = f"{type(error).__name__}: {error}"
        finally:
            with self._news:
                self._over = over
                self._news.notify_all()

    def _take(self, content: ArenaInfo | Event) -> None:
        with self._news:
            if isinstance(content, ArenaInfo):
                self._info = content
            else:
                self.events.append(content)
                self._phase = content.details.get("phase", self._phase)
                if content.text.startswith(REFUSED):
                    self._refusal = content.text
            self._news.notify_all()

    def _answer(self, obs: Observation) -> Setpoint:
        with self._news:
            if self._camera is None or any(image.name == self._camera for image in obs.cameras):
                self._newest = obs
            if self._refusal is not None:
                # Repeating the rejected setpoint would end in a landing. Reply with hold once before the next request:
                # the runtime reports another rejection only after a valid setpoint.
                self._asked, self._refused, self._refusal = None, self._refusal, None
            self._news.notify_all()
            if self._lands:
                return Setpoint.land()
            if self._asked is not None and time.monotonic() < self._asked_until_s:
                return self._asked
            return Setpoint.hold()


@atexit.register
def _end_with_the_interpreter() -> None:
    if _attached is not None:
        _attached._let_go()

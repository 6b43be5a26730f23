"""A lab flown by hand, from a notebook: look, step, fly, land."""

from __future__ import annotations

import atexit
import threading
import time
from collections.abc import Callable
from types import TracebackType

from ._run import WAIT_S
from ._vizflyt import ArenaInfo, Event, Observation, PluginEnd, Setpoint, waiting_services

# How long a step's setpoint stays in force: as a plugin's does. [s]
STEP_S = 0.5
# Take-off takes some six seconds, landing a minute at most. [s]
TAKE_OFF_WITHIN_S, LAND_WITHIN_S = 60.0, 90.0
# If no camera has an image for this long, something is wrong. [s]
IMAGE_WITHIN_S = 10.0
# How the runtime's note of a setpoint that does not count begins.
REFUSED = "setpoint refused: "
START = "start one with `vizflyt fly --attach`, in a terminal or another cell, and call vizflyt.attach() again"

_attached: Lab | None = None


def attach(*, service: str | None = None, wait_s: float = 30.0) -> Lab:
    """Attaches to a lab that waits for a plugin, ``vizflyt fly --attach``, and returns it: on the ground, seeing.

    ::

        lab = vizflyt.attach()
        lab.take_off()
        obs = lab.fly(Setpoint.velocity([1, 0, 0], axes="heading"), seconds=2)
        lab.land()

    Waits up to `wait_s` for such a lab [s]. Where several wait, `service` chooses.

    Raises ConnectionError if there is none, RuntimeError if one is attached already: one at a time.
    """
    global _attached
    if _attached is not None and _attached.is_attached:
        raise RuntimeError(f"{_attached} is attached already: go on with it, or end it first, by close()")
    until_s = time.monotonic() + wait_s
    while service is None:
        waiting = waiting_services()
        if len(waiting) > 1:
            raise ConnectionError(
                f"{len(waiting)} labs wait for a plugin: choose one by vizflyt.attach(service=X), "
                f"X being one of {', '.join(map(repr, waiting))}"
            )
        if waiting:
            service = waiting[0]
        elif time.monotonic() < until_s:
            time.sleep(WAIT_S)
        else:
            raise ConnectionError(f"no lab waits for a plugin; {START}")
    # Nobody else keeps the end of the connection: who lets go of it is gone, for the runtime.
    _attached = Lab(PluginEnd(service))
    try:
        _attached._wait(lambda lab: lab._info is not None, IMAGE_WITHIN_S, "the lab does not answer")
    except BaseException:
        _attached._let_go()
        raise
    return _attached


class Lab:
    """A lab that is flown by hand: what :func:`attach` returns.

    Time does not stand still between two calls, as it does not in the real lab. A thread answers every image. Whenever
    nobody asks for anything it answers **hold**: after :meth:`fly`, 0.5 s after :meth:`step`, while you read and think.
    So the deadlines of plugins never land the vehicle; the course's time limit and an empty battery do. The guard has
    the last word, as over any plugin.

    Ctrl-C ("interrupt the kernel") ends a call, and the vehicle holds. When the kernel ends, the vehicle lands. As a
    context manager it lands at the end of the block.
    """

    def __init__(self, end: PluginEnd):
        self.events: list[Event] = []
        """What has happened in this flight, the newest last."""
        self._info: ArenaInfo | None = None
        self._phase = "connecting"
        # The camera that is looked through, and the newest with an image of it.
        self._camera: str | None = None
        self._newest: Observation | None = None
        # What is asked for, and until when.
        self._asked: Setpoint | None = None
        self._asked_until_s = 0.0
        # Why the runtime refused it: before the vehicle is told to hold, and after.
        self._refusal: str | None = None
        self._refused: str | None = None
        self._takes_off = self._lands = self._leaves = False
        # Why nobody is attached any more, and whether the flight came to its end before.
        self._over: str | None = None
        self._is_whole = False
        self._news = threading.Condition()
        self._thread = threading.Thread(target=self._serve, args=(end,), name="vizflyt lab", daemon=True)
        self._thread.start()

    @property
    def info(self) -> ArenaInfo:
        """The arena: fence, limits, cameras, which setpoints it takes."""
        assert self._info is not None
        return self._info

    @property
    def phase(self) -> str:
        """Where the flight is: 'connecting', 'preparing', 'taking_off', 'flying', 'holding' (the guard holds the
        vehicle), 'landing' or 'landed'.
        """
        return self._phase

    @property
    def is_attached(self) -> bool:
        """Whether the flight goes on, on the ground or in the air."""
        return self._over is None

    @property
    def is_flying(self) -> bool:
        """Whether the vehicle is in the air and takes setpoints."""
        return self.is_attached and self._phase in ("flying", "holding")

    def look(self, camera: str | None = None) -> Observation:
        """Waits for the next image of a camera, the course's first if it is not named, and returns the observation
        that holds it: what the vehicle sees now, on the ground too.

        Other cameras are in it as far as they were drawn at the same instant. Its `imu` are the samples since the
        observation before it, not since your last look.

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
        """Takes off, waits until the vehicle is at its height, where it holds, and returns what it sees."""
        if self.is_flying:
            raise RuntimeError("the vehicle is in the air already")
        self._takes_off = True
        self._wait(lambda lab: lab.is_flying, TAKE_OFF_WITHIN_S, "the vehicle is not in the air")
        return self.look()

    def step(self, setpoint: Setpoint) -> Observation:
        """Asks for `setpoint` and returns the next image: one turn of a loop.

        It stays in force until the next call, 0.5 s at most; then the vehicle holds.
        """
        self._ask(setpoint, STEP_S)
        return self.look()

    def fly(self, setpoint: Setpoint, seconds: float) -> Observation:
        """Flies `setpoint` for `seconds` [s], then holds, and returns what the vehicle sees. Ctrl-C ends it early."""
        self._ask(setpoint, seconds)
        until_s = self._asked_until_s
        try:
            over = lambda lab: time.monotonic() >= until_s or not lab.is_flying
            self._wait(over, seconds + TAKE_OFF_WITHIN_S, "time stands still")
        finally:
            self._asked = None
        self._check_flying()
        return self.look()

    def land(self) -> str:
        """Lands, waits until the flight is over, and returns in a sentence how it ended."""
        self._check_attached()
        if not self._takes_off:
            raise RuntimeError("the vehicle is on the ground; close() ends a flight that has not begun")
        self._lands = True
        self._wait(lambda lab: not lab.is_attached, LAND_WITHIN_S, "the vehicle is not down")
        if not self._is_whole:
            self._check_attached()
        return self._reason()

    def close(self) -> None:
        """Ends the flight: lands if the vehicle is in the air, and lets go of the lab. Does nothing after the end."""
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
            raise TypeError(f"a {what} is no vizflyt.Setpoint; give one, such as Setpoint.velocity([1, 0, 0])")
        if setpoint.kind == "land":
            raise ValueError("call land(): it waits until the vehicle is down")
        if setpoint.kind == "offset":
            raise ValueError(
                "an offset counts anew from where each image finds the vehicle; give "
                "Setpoint.waypoints([d_m], speed_mps, axes=...), which begins where it is"
            )
        self._check_flying()
        with self._news:
            self._check_refused()
            self._asked, self._asked_until_s = setpoint, time.monotonic() + seconds

    def _wait(self, holds: Callable[[Lab], bool], seconds: float, otherwise: str) -> None:
        """Waits until it holds; raises what becomes of flight or setpoint if that comes first."""
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
            raise ConnectionError(f"the vehicle lands: {self._reason()}. When it is down {START}")
        if not self.is_flying:
            raise RuntimeError("the vehicle is on the ground; call take_off() first")

    def _check_refused(self) -> None:
        if self._refused is not None:
            refused, self._refused = self._refused, None
            raise ValueError(refused)

    def _reason(self) -> str:
        ended = [event.text for event in self.events if event.kind == "ended"]
        return ended[0] if ended else self._over or "nobody has said why"

    def _let_go(self) -> None:
        """Lets go of the lab; the runtime lands a vehicle that is in the air."""
        self._leaves = True
        self._thread.join(10 * WAIT_S)

    # ---- on the lab's thread ----

    def _serve(self, end: PluginEnd) -> None:
        over = "the notebook has let go of the lab"
        is_ready = False
        try:
            while not self._leaves:
                end.wait(WAIT_S)
                while (message := end.receive()) is not None:
                    what, content = message
                    if what == "stop":
                        over, self._is_whole = "it has ended", True
                        return
                    if what == "gone":
                        over = "the lab is gone, its program has ended"
                        return
                    self._take(content)
                if self._takes_off and not is_ready:
                    # This is what the runtime takes off by.
                    end.ready("notebook")
                    is_ready = True
                if self._info is not None and (obs := end.observation()) is not None:
                    entered_ns = time.monotonic_ns()
                    answer = self._answer(obs)
                    if is_ready:
                        end.answer(obs.seq, entered_ns, answer)
                    # The memory goes back to the runtime unless the caller keeps an image.
                    del obs
            if not is_ready:
                end.failed("the notebook has let go of the lab before take-off")
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
                # Asked for on, it would end in a landing. And a hold comes first, whatever is asked next: only after
                # a good setpoint the runtime says that it refuses another.
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

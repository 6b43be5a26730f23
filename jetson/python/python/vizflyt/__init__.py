"""Write a drone's autonomy in Python; fly it in a photorealistic world.

A plugin is a class with the method ``on_image``:

    import vizflyt

    class Creep(vizflyt.Plugin):
        def on_image(self, obs):
            front = obs.camera("front")
            if front is None:                                # no image yet
                return None
            ahead_m = front.depth_m(front.width_px // 2, front.height_px // 2) or 9.0
            return vizflyt.Setpoint.velocity([min(max(ahead_m - 2.0, 0.0), 1.0), 0, 0], axes="heading")

    if __name__ == "__main__":
        vizflyt.run(Creep)

Frames: ``world`` is x east, y north, z up; ``body`` is x forward, y left, z up; ``cam`` is x right,
y down, z forward. Units are SI, and names end in them: ``_m _mps _rad _radps _ns _px``. Times are
nanoseconds of ``time.monotonic_ns()``. Rotations are quaternions xyzw.

Images are read-only numpy arrays in shared memory; nothing is copied. To draw into an image, or to keep it for a long
time, take a ``.copy()``.
"""

from typing import TYPE_CHECKING, Any

from ._lab import Lab, attach
from ._log import Images, Imu, Log, LogImage, Motion, Poses, Sent
from ._picture import Picture, show
from ._plugin import Plugin
from ._run import HeldImagesWarning, run
from ._vizflyt import (
    ArenaInfo,
    Battery,
    CameraImage,
    CameraInfo,
    Event,
    ImuSample,
    Intrinsics,
    Limits,
    NotFiniteError,
    Observation,
    ObservationBuffer,
    Pose,
    Rehearsal,
    SensorInfo,
    SensorReading,
    Setpoint,
    Vehicle,
    Volume,
    __version__,
    course_map,
    publish_odometry,
)

if TYPE_CHECKING:
    from .gym import Env, VectorEnv

__all__ = [
    "ArenaInfo",
    "Battery",
    "CameraImage",
    "CameraInfo",
    "Env",
    "Event",
    "HeldImagesWarning",
    "Images",
    "Imu",
    "ImuSample",
    "Intrinsics",
    "Lab",
    "Limits",
    "Log",
    "LogImage",
    "Motion",
    "NotFiniteError",
    "Observation",
    "ObservationBuffer",
    "Picture",
    "Plugin",
    "Pose",
    "Poses",
    "Rehearsal",
    "SensorInfo",
    "SensorReading",
    "Sent",
    "Setpoint",
    "VectorEnv",
    "Vehicle",
    "Volume",
    "__version__",
    "attach",
    "course_map",
    "publish_odometry",
    "run",
    "show",
]


def __getattr__(name: str) -> Any:
    # Plugins that do not use Gymnasium do not import it.
    if name in ("Env", "VectorEnv"):
        from . import gym

        return getattr(gym, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

"""Writes the packets for the bridge's tests with pymavlink: firmware-esp/bridge/tests/data/pymavlink.bin, with their
contents in pymavlink.txt; and reference packets of obstacle distances, protocol/core/src/mavlink/distances.txt.

    target/clients/bin/python tests/clients/capture.py

Every message of the dialect once, with small values in integer fields and fractions in float fields; some as MAVLink 1,
some signed.
"""

import math
from pathlib import Path

from pymavlink.dialects.v10 import ardupilotmega as v1
from pymavlink.dialects.v20 import ardupilotmega as v2

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "firmware-esp/bridge/tests/data"
# MANUAL_CONTROL has another name for its target system.
SYSTEM = {69: "target"}


def value(index, kind, length):
    """Returns a value that identifies its position; the target fields differ from the rest."""
    if kind == "char":
        return ("text%d" % index).encode()[:length] if length else b"x"
    number = 1.5 if kind in ("float", "double") else 3 + index % 100
    return [number] * length if length else number


def message(dialect, cls, index):
    fields = []
    for place, (name, kind) in enumerate(zip(cls.fieldnames, cls.fieldtypes)):
        length = cls.array_lengths[cls.ordered_fieldnames.index(name)]
        if name == SYSTEM.get(cls.id, "target_system"):
            fields.append(7)
        elif name == "target_component":
            fields.append(9)
        else:
            fields.append(value(index + place, kind, length))
    return cls(*fields)


def distances():
    """Returns the packets, in hexadecimal, of a range finder that looks down, a sonar that looks 20 degrees below the
    nose, and a LiDAR with walls ahead and to the right."""
    link = v2.MAVLink(None, srcSystem=1, srcComponent=191)
    half = math.radians(-20) / 2
    nowhere = [1201] * 72
    nowhere[0], nowhere[18] = 200, 300
    range_m = {"min_distance": 20, "max_distance": 1200}
    cone = {"covariance": 255, "horizontal_fov": 0.25, "vertical_fov": 0.5}
    down = v2.MAVLink_distance_sensor_message(
        time_boot_ms=55,
        current_distance=123,
        type=v2.MAV_DISTANCE_SENSOR_LASER,
        id=3,
        orientation=v2.MAV_SENSOR_ROTATION_PITCH_270,
        quaternion=[0, 0, 0, 0],
        signal_quality=50,
        **range_m,
        **cone,
    )
    below = v2.MAVLink_distance_sensor_message(
        time_boot_ms=56,
        current_distance=1201,
        type=v2.MAV_DISTANCE_SENSOR_ULTRASOUND,
        id=4,
        orientation=v2.MAV_SENSOR_ROTATION_CUSTOM,
        quaternion=[math.cos(half), 0, math.sin(half), 0],
        signal_quality=0,
        **range_m,
        **cone,
    )
    around = v2.MAVLink_obstacle_distance_message(
        time_usec=9,
        sensor_type=v2.MAV_DISTANCE_SENSOR_LASER,
        distances=nowhere,
        increment=5,
        increment_f=5,
        angle_offset=0,
        frame=v2.MAV_FRAME_BODY_FRD,
        **range_m,
    )
    messages = [down, below, around]
    return [message.pack(link).hex() for message in messages]


def main():
    packets, lines = [], []
    for number, (id_, cls) in enumerate(sorted(v2.mavlink_map.items())):
        old = number % 5 == 4 and id_ in v1.mavlink_map
        dialect = v1 if old else v2
        link = dialect.MAVLink(None, srcSystem=1 + number % 3, srcComponent=1 + number % 2)
        link.seq = number % 256
        if not old and number % 3 == 0:
            link.signing.secret_key = bytes(range(32))
            link.signing.link_id = 5
            link.signing.timestamp = 10_000 + number
            link.signing.sign_outgoing = True
        made = message(dialect, dialect.mavlink_map[id_] if old else cls, number)
        packed = made.pack(link, force_mavlink1=old)
        target = [getattr(made, name, 0) for name in (SYSTEM.get(id_, "target_system"), "target_component")]
        signed = int(bool(packed[0] == 0xFD and packed[2] & 1))
        packets.append(packed)
        lines.append(
            " ".join(map(str, [len(packed), id_, link.srcSystem, link.srcComponent, link.seq, signed, *target]))
        )
    FOLDER.mkdir(parents=True, exist_ok=True)
    (FOLDER / "pymavlink.bin").write_bytes(b"".join(packets))
    head = "# length message system component sequence signed target_system target_component\n"
    (FOLDER / "pymavlink.txt").write_text(head + "\n".join(lines) + "\n")
    (ROOT / "protocol/core/src/mavlink/distances.txt").write_text("\n".join(distances()) + "\n")
    print(len(packets), "packets,", sum(map(len, packets)), "bytes")


if __name__ == "__main__":
    main()

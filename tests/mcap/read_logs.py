"""Flies with the given program and reads its logs with other projects' packages.

Checks: a strict reader accepts the file, also after SIGKILL, unless the signal came during the write that happens once
a second: then a streaming reader gets all messages before it; every channel has a schema; Foxglove's messages decode
with the schemas in the file; colour is a JPEG that Pillow opens, of the calibration's size; poses are unit quaternions;
replaying a full log twice gives the same bytes and the flight's own answers; a reduced log stays within 60 MB a minute
and has every observation's head.
"""

import filecmp
import io
import json
import os
import pathlib
import re
import signal
import subprocess
import sys
import tempfile
import time

from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader, make_reader
from mcap_protobuf.decoder import DecoderFactory
from PIL import Image

FOXGLOVE = {
    "/pose": "foxglove.PoseInFrame",
    "/pose_at_image": "foxglove.PoseInFrame",
    "/tf": "foxglove.FrameTransform",
    "/event": "foxglove.Log",
    "/plugin/output": "foxglove.Log",
    "/camera/front/image": "foxglove.CompressedImage",
    "/camera/front/calibration": "foxglove.CameraCalibration",
}
OURS = ["/setpoint/asked", "/setpoint/sent", "/timing", "/image/timing", "/observation",
        "/plugin/messages", "/telemetry", "/motion", "/log", "/imu", "/camera/front/stamps"]
checks = 0


def check(condition, what):
    global checks
    checks += 1
    if not condition:
        sys.exit(f"failed: {what}")


def fly(program, folder, seconds, images, kill):
    """Flies a demo; kills its runtime in flight if requested. Returns the log."""
    command = [program, "demo", "--headless", "--seed", "7", "--seconds", str(seconds),
               f"--log={images}", f"--log-dir={folder}"]
    demo = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    printed = []
    for line in demo.stdout:
        printed.append(line)
        if kill and "plugin flies" in line:
            logs = list(folder.glob("*.mcap"))
            check(len(logs) == 1, f"one log: {logs}")
            # Wait for some chunks, then kill at once after a chunk has begun to appear, so that the signal often
            # arrives during its write: the worst case.
            want = logs[0].stat().st_size + 2_000_000
            while logs[0].stat().st_size < want and demo.poll() is None:
                time.sleep(0.001)
            os.kill(runtime(demo.pid), signal.SIGKILL)
            kill = False
    demo.wait()
    logs = list(folder.glob("*.mcap"))
    check(len(logs) == 1, f"one log: {logs} {printed}")
    return logs[0]


def runtime(parent):
    """Returns the process id of `vizflyt fly` below `parent`."""
    for entry in pathlib.Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            command = (entry / "cmdline").read_bytes().split(b"\0")
            status = (entry / "status").read_text()
        except OSError:
            continue
        if b"fly" in command and f"PPid:\t{parent}\n" in status:
            return int(entry.name)
    sys.exit("failed: there is no runtime")


def messages(file, is_cut):
    """Returns all messages; for a truncated file, those before the end."""
    if not is_cut:
        yield from make_reader(file, validate_crcs=True).iter_messages(log_time_order=False)
        return
    try:
        yield from NonSeekingReader(file).iter_messages(log_time_order=False)
    except McapError:
        return
    sys.exit("failed: a file without an end reads to its end")


def read(path, is_whole, is_full):
    """Reads a log; returns the number of messages by topic, its duration [s], and whether its end is missing."""
    found, times, with_images = {}, [], 0
    is_cut = not path.read_bytes().endswith(b"\x89MCAP0\r\n")
    check(not (is_cut and is_whole), f"a log that was closed has an end: {path}")
    if not is_cut:
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            summary = reader.get_summary()
            check((summary is not None) == is_whole, f"an index if it was closed: {path}")
            flights = [record.metadata for record in reader.iter_metadata()
                       if record.name == "vizflyt.flight"]
            images = "full" if is_full else "reduced"
            check([flight["images"] for flight in flights] == [images], f"{flights}")
    size, shown = None, {}
    with path.open("rb") as file:
        for schema, channel, message in messages(file, is_cut):
            topic = channel.topic
            is_first = topic not in found
            times.append(message.log_time)
            found[topic] = found.get(topic, 0) + 1
            check(schema is not None, f"{topic} has a schema")
            if topic in FOXGLOVE:
                check(schema.name == FOXGLOVE[topic], f"{topic} is {schema.name}")
            if channel.message_encoding == "json":
                check(isinstance(json.loads(message.data), dict), f"{topic} is an object")
                check(schema.encoding == "jsonschema", f"{topic} has its schema")
                json.loads(schema.data)
                if topic == "/camera/front/stamps":
                    shown[message.log_time] = json.loads(message.data)
                continue
            check((channel.message_encoding, schema.encoding) == ("protobuf", "protobuf"), topic)
            decoded = DecoderFactory().decoder_for("protobuf", schema)(message.data)
            if topic == "/camera/front/calibration":
                size = (decoded.width, decoded.height)
                check(len(decoded.K) == 9 and decoded.K[0] > 0, "the camera matrix is there")
            elif topic == "/camera/front/image" and found[topic] % 20 == 1:
                at = decoded.timestamp.seconds * 10**9 + decoded.timestamp.nanos
                stamps = shown[message.log_time]
                check(at == stamps["shown_ns"] > stamps["pose_ns"], f"the instant that it shows: {at} {stamps}")
                image = Image.open(io.BytesIO(decoded.data))
                image.load()
                check(image.format == "JPEG" and image.size == size, f"{image} {size}")
                check(image.getextrema()[1][1] > 60, "there is something in the picture")
            elif topic == "/pose":
                q = decoded.pose.orientation
                norm = q.x**2 + q.y**2 + q.z**2 + q.w**2
                check(abs(norm - 1) < 1e-6, f"unit quaternion: {norm}")
            elif topic == "/observation":
                check(decoded.head[:4] == b"VZOB", "the head is an observation's")
                check(all(i.is_color_apart and i.bitstream for i in decoded.images), "images")
                check(decoded.images or not is_full, "a full log leaves no image out")
                with_images += bool(decoded.images)
            elif is_first and topic == "/event":
                check(decoded.message != "", "an event has a sentence")
    # A truncated file may end before messages that are written once a second, or before the first setpoint. A plugin
    # may print nothing.
    rare = {"/plugin/output"}
    if is_cut:
        rare |= {"/setpoint/sent", "/timing", "/log", "/event"}
    for topic in [*FOXGLOVE, *OURS]:
        if topic not in rare:
            check(found.get(topic, 0) > 0, f"{topic} is in {path}: {found}")
    check(found["/camera/front/image"] == with_images, f"an image each: {found}")
    seconds = (max(times) - min(times)) / 1e9
    if not is_full:
        # A log starts with one second of budget, and its last image may exceed the budget.
        most = 1e6 * (seconds + 1) + 300_000
        check(path.stat().st_size <= most, f"{path.stat().st_size} bytes in {seconds} s")
    return found, seconds, is_cut


def replay(program, log, name):
    answers, report = log.with_suffix(f".{name}.jsonl"), log.with_suffix(f".{name}.json")
    done = subprocess.run([program, "replay", str(log), "--answers", str(answers), "--report",
                           str(report)], capture_output=True, text=True)
    check(done.returncode == 0, f"replay: {done.stdout} {done.stderr}")
    return answers, json.loads(report.read_text())["found"]


def follow_guide(log):
    """Runs the guide's Python code on a log."""
    guide = (pathlib.Path(__file__).parents[2] / "docs/guides/logs.md").read_text()
    scripts = re.findall(r"^```python\n(.*?)^```$", guide, re.M | re.S)
    # The other script needs this project's own package: tests/python runs it.
    [script] = [script for script in scripts if "from mcap" in script]
    done = subprocess.run([sys.executable, "-c", script.replace("flight.mcap", str(log))],
                          capture_output=True, text=True)
    check(done.returncode == 0, f"the guide's script runs: {done.stderr}")
    topics = {line.split()[1] for line in done.stdout.splitlines() if line[:1].isdigit()}
    check({"/pose", "/motion"} <= topics, f"it decodes protobuf and JSON: {topics}")


def main():
    program = str(pathlib.Path(sys.argv[1]).resolve())
    with tempfile.TemporaryDirectory() as scratch:
        folder = pathlib.Path(scratch)
        whole = fly(program, folder / "whole", 8, "full", kill=False)
        found, _, _ = read(whole, is_whole=True, is_full=True)
        minute = whole.stat().st_size / found["/observation"] * 60 * 60 / 1e6
        print(f"full: {sum(found.values())} messages, {whole.stat().st_size / 1e6:.1f} MB; "
              f"a minute at 60 Hz would be {minute:.0f} MB")
        follow_guide(whole)
        one, first = replay(program, whole, "one")
        two, _ = replay(program, whole, "two")
        check(filecmp.cmp(one, two, shallow=False), "two replays answer the same, byte by byte")
        check(first["compared"] > 100 and first["plugin_failed"] is None, str(first))
        check(first["differ"] == 0 or first["images_missing"] > 0, f"as in flight: {first}")
        print(f"replayed: {first['compared']} answers, {first['differ']} differ, "
              f"{first['images_missing']} images missing")
        killed = fly(program, folder / "killed", 60, "reduced", kill=True)
        found, seconds, is_cut = read(killed, is_whole=False, is_full=False)
        print(f"reduced and killed: {sum(found.values())} messages, "
              f"{killed.stat().st_size / 1e6:.1f} MB in {seconds:.1f} s, "
              f"{found['/camera/front/image']} of {found['/observation']} images"
              f"{', within a write' if is_cut else ''}")
        _, report = replay(program, killed, "killed")
        check(report["compared"] > 0, str(report))
        check(report["images_left_out"] > 0, f"a reduced log reports so: {report}")
        print(f"{checks} checks passed")


if __name__ == "__main__":
    main()

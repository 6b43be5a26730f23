"""Flies every MAVLink client against its own simulator, all in parallel, and then each one through its own bridge;
prints the output of each client and the number of passed checks.

Usage: all.py [--soak SECONDS] COMMAND...   (COMMAND starts the simulator)
    The bridge is `vizflyt bridge emulate`, from the folder of COMMAND.
    --soak    instead: run for SECONDS through the bridge, whose memory must not grow
"""

import json
import os
import re
import subprocess
import sys
import threading

from bridge import Rig
from square import Checks

HERE = os.path.dirname(os.path.abspath(__file__))
# Timeout of one client; more than twice the time that any needs on a loaded machine. [s]
LIMIT = 400
# Client, and its notation for the address of a TCP server.
SQUARES = [
    ("square_pymavlink.py", "tcp:%s"),
    ("square_mavproxy.py", "tcp:%s"),
    ("square_mavsdk.py", "tcpout://%s"),
]
# The same clients through a bridge: over UDP or TCP.
BRIDGED = [
    ("square_pymavlink.py", "udpout:%s", "udp"),
    ("square_mavproxy.py", "tcp:%s", "tcp"),
    ("square_mavsdk.py", "udpout://%s", "udp"),
]
BAUDS = [921600, 115200]


def python(script, *args, **options):
    return subprocess.Popen(
        [sys.executable, os.path.join(HERE, script), *args],
        text=True,
        stdout=subprocess.PIPE,
        **options,
    )


def square(command, script, address, seed, results):
    """Flies one client on a simulator with two links: one for the feed of poses, one for the client."""
    feed = python("feed.py", "0", "-", stdin=subprocess.PIPE)
    vicon = feed.stdout.readline().strip()
    endpoints = ["--mavlink", "udpin:127.0.0.1:0", "--mavlink", "tcpin:127.0.0.1:0"]
    simulator = subprocess.Popen(
        [*command, "--json", "--lifeline", "--realistic-startup", *endpoints, "--vicon", vicon, "--seed", str(seed)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    client = None
    try:
        net, port = json.loads(simulator.stdout.readline())["links"]
        feed.stdin.write("udpout:%s\n" % net)
        feed.stdin.flush()
        client = python(script, address % port)
        watchdog = threading.Timer(LIMIT, client.kill)
        watchdog.start()
        lines = []
        for line in client.stdout:
            print(line, end="", flush=True)
            lines.append(line)
        status = client.wait()
        watchdog.cancel()
        # The simulator's own record: the vehicle flew a square of four metres and landed.
        simulator.stdin.close()
        report = [json.loads(line) for line in simulator.stdout][-1]["report"]
        good = report["landed"] and report["path_m"] > 5.0
        print("%s  %s: the referee agrees" % ("ok  " if good else "FAIL", script), flush=True)
        results.append((script, status == 0 and good, counted(lines) + good, not good))
    finally:
        for process in (client, simulator, feed):
            if process:
                process.kill()
                process.wait()


def bridged(vizflyt, command, row, seed, results):
    """Flies one client through a bridge, together with a listener that counts packets and one that never reads."""
    script, address, way = row
    rig = Rig(vizflyt, BAUDS[0], command, seed)
    client = None
    try:
        client = python(script, address % getattr(rig, way), "--lossless")
        watchdog = threading.Timer(LIMIT, client.kill)
        watchdog.start()
        lines = []
        for line in client.stdout:
            print("%s (through a bridge)" % line.rstrip(), flush=True)
            lines.append(line)
        watchdog.cancel()
        check = Checks("%s through a bridge" % script, keeps_going=True)
        rig.judge(check)
        report, _ = rig.report()
        check("the referee agrees", report["landed"] and report["path_m"] > 5.0, report)
        passed = counted(lines) + check.passed
        results.append((script, client.wait() == 0 and not check.failed, passed, check.failed))
    finally:
        if client:
            client.kill()
            client.wait()
        rig.close()


def transfers(vizflyt, command, baud, results):
    """Transfers parameters and a mission at one baud rate."""
    client = python("bridge.py", vizflyt, str(baud), *command)
    lines = []
    for line in client.stdout:
        print(line, end="", flush=True)
        lines.append(line)
    results.append(("bridge.py at %d" % baud, client.wait() == 0, counted(lines), False))


def counted(lines):
    """Returns the number of checks that a client reports as passed."""
    found = re.search(r"(\d+) passed", lines[-1]) if lines else None
    return int(found.group(1)) if found else 0


def behaviour(command, results):
    """Runs the long check of the autopilot's behaviour and of the commands it refuses."""
    client = python("behaviour.py", *command)
    lines = []
    for line in client.stdout:
        print(line, end="", flush=True)
        lines.append(line)
    results.append(("behaviour.py", client.wait() == 0, counted(lines), False))


def together(threads):
    """Runs threads in parallel; returns their number."""
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return len(threads)


def main():
    command = sys.argv[1:]
    soak = command[:1] == ["--soak"]
    if len(command) <= 2 * soak:
        sys.exit(__doc__)
    vizflyt = os.path.join(os.path.dirname(command[2 * soak]), "vizflyt")
    if soak:
        args = [*command[:2], vizflyt, str(BAUDS[0]), *command[2:]]
        return subprocess.call([sys.executable, os.path.join(HERE, "bridge.py"), *args])
    # The clients receive other messages of the simulators by MAVLink.
    os.environ.setdefault("RUST_LOG", "warn")
    results = []
    started = together(
        [threading.Thread(target=behaviour, args=(command, results))]
        + [
            threading.Thread(target=square, args=(command, script, address, seed, results))
            for seed, (script, address) in enumerate(SQUARES, 11)
        ]
    )
    started += together(
        [
            threading.Thread(target=bridged, args=(vizflyt, command, row, seed, results))
            for seed, row in enumerate(BRIDGED, 31)
        ]
        + [
            threading.Thread(target=transfers, args=(vizflyt, command, baud, results))
            for baud in BAUDS
        ]
    )
    failed = [script for script, good, _, _ in results if not good]
    # A thread that ended with an exception left no result.
    missing = started - len(results)
    passed = sum(count for _, _, count, _ in results)
    print("%d checks passed; failed: %s" % (passed, ", ".join(failed) or "none"))
    return bool(failed or missing)


if __name__ == "__main__":
    sys.exit(main())

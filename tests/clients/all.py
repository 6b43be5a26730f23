"""Runs every client against a simulator of its own, all at once, and then each through a bridge of its
own; prints what they print, and how many checks passed.

Usage: all.py [--soak SECONDS] COMMAND...   (what starts the simulator)
    The bridge is `vizflyt bridge emulate`; vizflyt lies beside COMMAND.
    --soak    instead: so long through the bridge, whose memory must stay as it was
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
# Nothing here takes half as long, however loaded the machine is. [s]
LIMIT = 400
# A client, and how it writes the address of a TCP server.
SQUARES = [
    ("square_pymavlink.py", "tcp:%s"),
    ("square_mavproxy.py", "tcp:%s"),
    ("square_mavsdk.py", "tcpout://%s"),
]
# The same through a bridge: over UDP, or TCP.
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
    """Flies one client on a simulator with two links: one for what a net gives, one for it."""
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
        # What the referee saw: it flew a square of four metres, and landed.
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
    """Flies one client through a bridge, beside a listener that counts and one that never reads."""
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
    """Moves parameters and a mission at one speed."""
    client = python("bridge.py", vizflyt, str(baud), *command)
    lines = []
    for line in client.stdout:
        print(line, end="", flush=True)
        lines.append(line)
    results.append(("bridge.py at %d" % baud, client.wait() == 0, counted(lines), False))


def counted(lines):
    """Returns how many checks a client reports as passed."""
    found = re.search(r"(\d+) passed", lines[-1]) if lines else None
    return int(found.group(1)) if found else 0


def behaviour(command, results):
    """The long one, of what an autopilot does and refuses."""
    client = python("behaviour.py", *command)
    lines = []
    for line in client.stdout:
        print(line, end="", flush=True)
        lines.append(line)
    results.append(("behaviour.py", client.wait() == 0, counted(lines), False))


def together(threads):
    """Runs threads side by side; returns how many there were."""
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
    # What the simulators say beside, the clients hear anyway.
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
    # A thread that ended by an exception has left no result.
    missing = started - len(results)
    passed = sum(count for _, _, count, _ in results)
    print("%d checks passed; failed: %s" % (passed, ", ".join(failed) or "none"))
    return bool(failed or missing)


if __name__ == "__main__":
    sys.exit(main())

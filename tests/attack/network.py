"""Attacks from the network on `vizflyt serve` and `vizflyt fly`: an unauthenticated client, a team that targets
another's vehicle, a foreign page in the instructor's browser. See `run`."""

import base64
import contextlib
import hashlib
import json
import os
import pathlib
import resource
import selectors
import shutil
import socket
import ssl
import tempfile
import threading
import time

from checks import Program, check, end, run, scene

# Address of the attackers; the instructor's page is at 127.0.0.1.
ELSEWHERE = "127.0.0.2"
# The goal is 0.2 s; a loaded machine gets five times as long.
STOP_WITHIN_S = 1.0
PRESSES = 20
SECRETS = ("heron", "wasp", "hidden-course")


class Lab(Program):
    """`vizflyt serve` with two vehicles and a leaderboard of two teams."""

    def __init__(self, folder, *more, limits=None):
        arena = folder / SECRETS[2] / "arena.toml"
        if not arena.exists():
            vehicles = "".join(f'\n[[vehicles]]\nname = "{name}"\n' for name in SECRETS[:2])
            scene(folder, vehicles, SECRETS[2])
        super().__init__("serve", "--json", "--lifeline", "--print-page-keys", "--login=always", "--renderer=cpu",
                         "--quic=127.0.0.1:0", "--http=127.0.0.1:0", "--vicon=127.0.0.1:0", "--keys", folder / "server",
                         *(more or ["--leaderboard=none"]), arena, limits=limits)
        self.ready = self.line(lambda line: "ready" in line)
        host, port = self.ready["http"].split("://")[1].rsplit(":", 1)
        self.address = (host, int(port))
        self.host = f"{host}:{port}"
        self.keys = {}
        while len(self.keys) < 3:
            key = self.line(lambda line: "page_key" in line)["page_key"]
            self.keys[key["for"]] = key["link"].split("key=")[1]
        self.instructor = f"vizflyt_key={self.keys['instructor']}"
        self.team = f"vizflyt_team_key={self.keys['team of ' + repr(SECRETS[0])]}"

    def connect(self, source="127.0.0.1"):
        return socket.create_connection(self.address, 10, (source, 0))

    def ask(self, request, *headers, cookie="", body="", source="127.0.0.1"):
        """Returns the answer's status, head, body, and duration [s]. `headers` may replace `Host`."""
        own = [] if any(header.startswith("Host:") for header in headers) else [f"Host: {self.host}"]
        lines = [f"{request} HTTP/1.1", *own, *headers, "Connection: close", f"Content-Length: {len(body)}"]
        if cookie:
            lines.append(f"Cookie: {cookie}")
        began = time.monotonic()
        with self.connect(source) as stream:
            stream.sendall(("\r\n".join(lines) + "\r\n\r\n" + body).encode())
            answer = b""
            while more := stream.recv(65536):
                answer += more
        took_s = time.monotonic() - began
        head, _, text = answer.decode(errors="replace").partition("\r\n\r\n")
        return int(head.split(" ")[1]) if head else 0, head, text, took_s

    def put(self, request, body, cookie="", source="127.0.0.1"):
        status, _, text, _ = self.ask(request, f"Origin: http://{self.host}", "Content-Type: application/json",
                                      cookie=cookie, body=json.dumps(body), source=source)
        return status, text

    def stop(self, during):
        """Presses the instructor's stop button many times, each on a new connection."""
        took_s = []
        wrong = []
        for _ in range(PRESSES):
            time.sleep(0.02)
            try:
                origin = f"Origin: http://{self.host}"
                status, _, _, each_s = self.ask("POST /api/estop", origin, cookie=self.instructor)
            except OSError as error:
                status, each_s = str(error), float("inf")
            took_s.append(each_s)
            # No runtime is connected; only an instructor gets this answer.
            if status != 409:
                wrong.append(status)
        took_s.sort()
        print(f"      {during}: within {took_s[PRESSES // 2] * 1e3:.1f} ms, at most {took_s[-1] * 1e3:.1f} ms")
        check(f"STOP answers beside {during}", not wrong and took_s[-1] < STOP_WITHIN_S, f"{wrong} {took_s[-1]:.2f} s")

    def watch(self, cookie, vehicle=SECRETS[0]):
        """Opens a page's WebSocket."""
        stream = self.connect()
        key = base64.b64encode(os.urandom(16)).decode()
        stream.sendall(f"GET /ws?vehicle={vehicle} HTTP/1.1\r\nHost: {self.host}\r\nOrigin: http://{self.host}\r\n"
                       f"Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
                       f"Sec-WebSocket-Key: {key}\r\nCookie: {cookie}\r\n\r\n".encode())
        return stream


def lives(stream, for_s=1.5):
    """Returns whether a WebSocket receives data and is not closed."""
    stream.settimeout(for_s)
    until, got = time.monotonic() + for_s, 0
    with contextlib.suppress(TimeoutError):
        while time.monotonic() < until:
            more = stream.recv(65536)
            if not more:
                return False
            got += len(more)
    return got > 1000


class Drain:
    """Reads and discards the data of many sockets."""

    def __init__(self, streams):
        self.selector = selectors.DefaultSelector()
        self.is_over = False
        for stream in streams:
            stream.setblocking(False)
            self.selector.register(stream, selectors.EVENT_READ, stream)
        self.thread = threading.Thread(target=self.read, daemon=True)
        self.thread.start()

    def read(self):
        while not self.is_over:
            for key, _ in self.selector.select(0.1):
                with contextlib.suppress(OSError):
                    if key.data.recv(65536):
                        continue
                self.selector.unregister(key.fileobj)

    def end(self):
        self.is_over = True
        self.thread.join()
        self.selector.close()


def the_stop_button(folder):
    """Many open connections must not block the stop button."""
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    most = min(10_000, (hard if hard > 0 else 1 << 20) - 300)
    # Limit of a login shell.
    lab = Lab(folder, limits="-S -n 1024")
    try:
        lab.stop("nobody else")
        watching = lab.watch(lab.instructor)
        idle = []
        with contextlib.suppress(OSError):
            while len(idle) < most:
                idle.append(lab.connect(ELSEWHERE))
        check(f"one address opens {len(idle)} idle connections", len(idle) >= min(most, 1100), len(idle))
        lab.stop(f"{len(idle)} idle connections")
        for stream in idle:
            stream.close()

        team = [lab.watch(lab.team) for _ in range(64)]
        drain = Drain(team)
        lab.stop("64 WebSockets of a team")
        late = lab.watch(lab.instructor)
        check("an instructor's page opens beside 64 of a team", lives(late), "closed")
        drain.end()
        for stream in [*team, late]:
            stream.close()

        is_over = threading.Event()
        posted = []

        def post():
            while not is_over.wait(0.01):
                with contextlib.suppress(OSError):
                    stream = lab.connect(ELSEWHERE)
                    stream.sendall(f"POST /api/login HTTP/1.1\r\nHost: {lab.host}\r\nOrigin: http://{lab.host}\r\n"
                                   "Content-Length: 9000\r\n\r\n{".encode())
                    posted.append(stream)

        thread = threading.Thread(target=post, daemon=True)
        thread.start()
        time.sleep(2)
        lab.stop("100 slow posts a second")
        is_over.set()
        thread.join()
        for stream in posted:
            stream.close()
        check("the page that watched all that still does", lives(watching, 3.0), "closed")
        watching.close()
    finally:
        lab.end()


def the_page(folder):
    """An unauthenticated client, a foreign page in the instructor's browser, and a team."""
    run("password", "--keys", folder / "server", input="of the instructor\n")
    lab = Lab(folder)
    try:
        told = []
        for request in ("GET /api/vehicles", "GET /api/map", "GET /api/shell", "GET /api/splats/0", "GET /api/twin",
                        "GET /api/stats", "GET /api/session", "GET /api/leaderboard", "GET /api/pairing",
                        "GET /ws?vehicle=heron", "GET /nothing", "GET /", "POST /api/estop", "PUT /api/scene",
                        "GET /api/vehicles/heron/crash"):
            status, _, text, _ = lab.ask(request, "X-Forwarded-For: 127.0.0.1", source=ELSEWHERE)
            allowed = request in ("GET /api/session", "GET /")
            if (status != 200) if allowed else (status not in (401, 404, 405)):
                told.append((request, status))
            told += [(request, secret) for secret in SECRETS if secret in text]
        check("a stranger learns nothing from the page", not told, told)

        key = lab.keys["instructor"]
        for name, headers in {
            "another Host": ["Host: evil.example"],
            "a page elsewhere": ["Origin: http://evil.example"],
        }.items():
            status, head, _, _ = lab.ask(f"GET /enter?key={key}", *headers)
            check(f"/enter is closed to {name}", status == 403 and "set-cookie" not in head.lower(), head)
            status, head, text, _ = lab.ask("GET /api/vehicles", *headers[:1], cookie=lab.instructor)
            if name == "another Host":
                check("a name that resolves to the server reads nothing", status == 403, text)
        for path in ("/enter", "/enter?key=", "/enter?key=wrong"):
            _, head, _, _ = lab.ask(f"GET {path}", cookie=lab.instructor)
            check(f"{path} takes no cookie away", "set-cookie" not in head.lower(), head)
        _, head, _, _ = lab.ask(f"GET /enter?key={lab.team.split('=')[1]}", cookie=lab.instructor)
        names = [line.split(":", 1)[1].split("=")[0].strip() for line in head.splitlines()
                 if line.lower().startswith("set-cookie:")]
        check("a team's link leaves the instructor's cookie", names == ["vizflyt_team_key"], head)
        _, _, text, _ = lab.ask("GET /api/session", cookie=f"{lab.team}; {lab.instructor}")
        check("who has both keys stays the instructor", json.loads(text)["role"] == "instructor", text)
        status, _, text, _ = lab.ask("POST /api/estop", "Origin: http://evil.example", cookie=lab.instructor)
        check("a page elsewhere presses no button", status == 403, text)

        for request in ("GET /api/shell", "GET /api/splats/0", "GET /api/twin", "GET /api/vehicles/wasp/cameras",
                        "GET /ws?vehicle=wasp", "POST /api/estop", "POST /api/vehicles/wasp/estop"):
            status, _, text, _ = lab.ask(request, f"Origin: http://{lab.host}", cookie=lab.team)
            check(f"a team gets no {request}", status == 403, f"{status} {text}")
        guesses = [lab.put("POST /api/login", {"password": f"guess {n}"}, source=ELSEWHERE)[0] for n in range(14)]
        check("passwords are not guessed for long", set(guesses) == {401, 429} and guesses[-1] == 429, guesses)
    finally:
        lab.end()


def the_check_in(folder):
    """Team B checks in with its own token before team A takes off."""
    board = folder / "runs.sqlite"
    tokens = {}
    for team in ("ants", "bees"):
        added = run("leaderboard", "team", "add", team, "--database", board)
        words = [word for word in added.stdout.split() if len(word) == 32]
        tokens[team] = words[0] if words else added.stdout + added.stderr
    lab = Lab(folder, f"--leaderboard={board}")
    try:
        where = "PUT /api/vehicles/heron/team"
        by = {team: {"token": token, "attempt": "official"} for team, token in tokens.items()}
        status, text = lab.put(where, by["bees"], source=ELSEWHERE)
        check("a token alone checks nobody in", status == 403, text)
        status, text = lab.put("PUT /api/vehicles/wasp/team", by["bees"], cookie=lab.team, source=ELSEWHERE)
        check("a token checks in at its own vehicle alone", status == 403, text)
        status, text = lab.put(where, by["ants"], cookie=lab.team)
        check("a team checks in at its vehicle", status == 200, text)
        for cookie in ("", lab.team):
            status, text = lab.put(where, by["bees"], cookie=cookie, source=ELSEWHERE)
            check("another team's token takes no check-in over", status == 403, text)
        _, _, text, _ = lab.ask("GET /api/leaderboard", cookie=lab.instructor)
        check("the check-in is whose it was", "ants" in [v["team"] for v in json.loads(text)["vehicles"]], text)
    finally:
        lab.end()


def plain_http(folder):
    """Keys and pictures on a public network."""
    arena = folder / SECRETS[2] / "arena.toml"
    command = ["serve", "--leaderboard=none", "--renderer=cpu", "--quic=127.0.0.1:0", "--vicon=127.0.0.1:0", "--keys",
               folder / "server", arena]
    # Address for documentation (RFC 5737), which no computer has: public, and never bound.
    done = run(*command, "--http=203.0.113.7:8080", within_s=60)
    is_refused = done.returncode != 0 and "add --tls auto" in done.stderr
    check("plain HTTP is refused on a public address", is_refused, done.stderr)
    done = run(*command, "--http=203.0.113.7:8080", "--plain-http", within_s=60)
    check("unless it is asked for", done.returncode != 0 and "cannot listen" in done.stderr, done.stderr)

    lab = Lab(folder, "--leaderboard=none", "--tls=auto")
    try:
        with lab.connect() as stream:
            request = f"GET /api/session HTTP/1.1\r\nHost: {lab.host}\r\nCookie: {lab.instructor}\r\n\r\n"
            stream.sendall(request.encode())
            answer = stream.recv(65536).decode()
        check("who speaks plain HTTP to HTTPS gets no page", "role" not in answer and "https" in answer.lower(), answer)
        context = ssl.create_default_context()
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
        with lab.connect() as plain, context.wrap_socket(plain) as stream:
            version, shown = stream.version(), hashlib.sha256(stream.getpeercert(True)).hexdigest()
        check("HTTPS is TLS 1.3", version == "TLSv1.3", version)
        printed = json.dumps(lab.ready)
        check("and has the certificate whose fingerprint was printed", shown in printed, f"{shown} {printed}")
        context.maximum_version = ssl.TLSVersion.TLSv1_2
        try:
            with lab.connect() as plain, context.wrap_socket(plain) as stream:
                version = stream.version()
        except OSError:
            version = None
        check("nothing older is spoken", version is None, version)
    finally:
        lab.end()


def the_unpaired(folder):
    """A runtime that is not paired with the server."""
    lab = Lab(folder, "--leaderboard=none", f"--pair=team:{SECRETS[0]}")
    try:
        code = lab.line(lambda line: "pairing" in line)["pairing"]["code"].replace(" ", "")
        server = lab.ready["quic"]
        said = []
        for vehicle in (SECRETS[0], "not-there"):
            done = run("fly", "avoid", "--server", server, "--fingerprint", lab.ready["fingerprint"], "--keys",
                       folder / "stranger", "--mavlink=udpin:127.0.0.1:0", "--ready-within=3", "--no-config",
                       "--vehicle", vehicle, "--log-dir", folder / "flights", within_s=60)
            text = done.stdout + done.stderr
            said.append("not paired with the server" in text and not any(s in text for s in SECRETS if s != vehicle))
            check(f"an unpaired runtime is sent away, for '{vehicle}'", said[-1] and done.returncode != 0, text)
        wrong = "000000" if code != "000000" else "111111"
        for _ in range(3):
            run("pair", server, "--keys", folder / "stranger", "--code", wrong, within_s=60)
        done = run("pair", server, "--keys", folder / "stranger", "--code", code, within_s=60)
        text = done.stdout + done.stderr
        check("three wrong codes close a pairing, for the right one too", done.returncode != 0, text)
    finally:
        lab.end()


def the_autopilots_port(folder):
    """An attacker sends to the runtime's MAVLink port before the autopilot, and at a higher rate."""
    lab = Lab(folder, "--leaderboard=none", f"--pair=team:{SECRETS[0]}")
    programs: list[Program] = [lab]
    try:
        code = lab.line(lambda line: "pairing" in line)["pairing"]["code"].replace(" ", "")
        paired = run("pair", lab.ready["quic"], "--keys", folder / "jetson", "--code", code, within_s=60)
        check("the runtime is paired", paired.returncode == 0, paired.stderr)
        runtime = Program("fly", "avoid", "--json", "--lifeline", "--server", lab.ready["quic"], "--keys",
                          folder / "jetson", "--vehicle", SECRETS[0], "--mavlink=udpin:127.0.0.1:0",
                          "--ready-within=60", "--seconds=2", "--no-config", "--log-dir", folder / "flights")
        programs.append(runtime)
        port = runtime.line(lambda line: "ready" in line)["mavlink"].rsplit(":", 1)[1]
        is_over = threading.Event()
        # MAVLink 2: COMMAND_ACK of system 1 with a wrong checksum; one byte; noise.
        packets = [b"x", bytes.fromhex("fd0300000001014d0000900100") + b"\x00\x00", os.urandom(300)]

        def flood():
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stream:
                stream.bind((ELSEWHERE, 0))
                number = 0
                while not is_over.wait(0.005):
                    with contextlib.suppress(OSError):
                        stream.sendto(packets[number % len(packets)], ("127.0.0.1", int(port)))
                    number += 1

        thread = threading.Thread(target=flood, daemon=True)
        thread.start()
        time.sleep(1)
        programs.append(Program("sim", "--json", "--lifeline", f"--mavlink=udpout:127.0.0.1:{port}", "--spawn",
                                ",".join(map(str, lab.ready["spawn"])), "--object", SECRETS[0],
                                f"--vicon={lab.ready['vicon']}"))
        named = []

        def flies(line):
            text = json.dumps(line)
            if ELSEWHERE in text and "are ignored" in text:
                named.append(text)
            return '"phase": "flying"' in text

        try:
            flew = runtime.line(flies, within_s=60)
        except (EOFError, OSError, TimeoutError) as error:
            flew = None
            check("the autopilot is heard beside a flood", False, error)
        else:
            check("the autopilot is heard beside a flood", bool(flew))
        noted = named or [line for line in runtime.errors if ELSEWHERE in line and "are ignored" in line]
        check("the intruder is named", bool(noted), "".join(runtime.errors[-5:]))
        is_over.set()
        thread.join()
    finally:
        for program in reversed(programs):
            program.end()


def main():
    folder = pathlib.Path(tempfile.mkdtemp(prefix="vizflyt-attack-", dir="/var/tmp"))
    # A runtime that is root starts plugins as another user.
    folder.chmod(0o755)
    try:
        for attack in (the_stop_button, the_page, the_check_in, plain_http, the_unpaired, the_autopilots_port):
            attack(folder)
    finally:
        shutil.rmtree(folder)
    end()


main()

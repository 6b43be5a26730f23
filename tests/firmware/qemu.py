"""Runs the ESP8266's bridge in QEMU and passes MAVLink through it in both directions.

The emulator's radio is a socket of Ethernet frames, with the small network below at its other end. It implements ARP,
IPv4 and UDP independently of the bridge's stack. The serial line is a pty. Packets come from pymavlink: every message
of the dialect in turn with random fields, MAVLink 1 and 2, some signed. The output must equal the input byte by byte:
no packet lost, altered, or duplicated. Before that the network's other end behaves like a computer that joins: it
requests an address, and resolves the bridge's name.

    qemu.py [--packets N] [--seed N] IMAGE
"""

import argparse
import collections
import itertools
import os
import pty
import random
import select
import socket
import struct
import subprocess
import sys
import tempfile
import termios
import time
import tty

from pymavlink.dialects.v20 import ardupilotmega as dialect

FLASH_BYTES = 4 << 20
OUR_MAC = bytes.fromhex("025646000002")
BRIDGE_MAC = bytes.fromhex("025646826601")
BRIDGE_PORT = 14550
# Timeout after which a packet counts as lost. The emulator is a few times slower than the chip and shares the machine
# with other tests.
PATIENCE_S = 20.0
# Packets in flight in each direction; UDP has no flow control. This many fit into a pty at once at any size: the bridge
# rightly drops a packet interrupted by a pause of this program.
WINDOW = 12
# The bridge forgets a companion soon after this time without packets.
SILENCE_S = 1.0


def checksum(data):
    """Returns the Internet checksum (RFC 1071) of bytes."""
    if len(data) % 2:
        data += b"\0"
    total = sum(struct.unpack(f"!{len(data) // 2}H", data))
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return ~total & 0xFFFF


class Network:
    """The other end of the emulated radio: one host with UDP."""

    def __init__(self, wire, address, bridge):
        self.wire = wire
        self.address = socket.inet_aton(address)
        self.listens = {self.address}
        self.bridge = socket.inet_aton(bridge)
        self.identification = 0

    def _frame(self, kind, payload):
        self.wire.send(BRIDGE_MAC + OUR_MAC + struct.pack("!H", kind) + payload)

    def send(self, port, payload, source=None, to=None, to_port=BRIDGE_PORT):
        """Sends a datagram from our `port`; to the bridge by default."""
        source = source or self.address
        to = socket.inet_aton(to) if to else self.bridge
        length = 8 + len(payload)
        pseudo = source + to + struct.pack("!BBH", 0, 17, length)
        header = struct.pack("!HHHH", port, to_port, length, 0)
        total = checksum(pseudo + header + payload) or 0xFFFF
        udp = header[:6] + struct.pack("!H", total) + payload
        self.identification = (self.identification + 1) & 0xFFFF
        ip = struct.pack("!BBHHHBBH", 0x45, 0, 20 + length, self.identification, 0x4000, 64, 17, 0)
        ip += source + to
        ip = ip[:10] + struct.pack("!H", checksum(ip)) + ip[12:]
        self._frame(0x0800, ip + udp)

    def receive(self):
        """Receives one frame; returns (destination port, payload), or None if it is not a datagram."""
        frame = self.wire.recv(2048)
        if not frame:
            raise SystemExit("the emulator closed its radio")
        kind, packet = struct.unpack("!H", frame[12:14])[0], frame[14:]
        if kind == 0x0806:
            operation, asked = struct.unpack("!H", packet[6:8])[0], packet[24:28]
            if operation == 1 and asked == self.address:
                self._frame(0x0806, struct.pack("!HHBBH", 1, 0x0800, 6, 4, 2)
                            + OUR_MAC + self.address + packet[8:14] + packet[14:18])
            return None
        if kind != 0x0800 or packet[9] != 17:
            return None
        header, length = (packet[0] & 15) * 4, struct.unpack("!H", packet[2:4])[0]
        assert checksum(packet[:header]) == 0, "the bridge sent a wrong IPv4 checksum"
        if packet[16:20] not in self.listens:
            return None
        assert packet[12:16] == self.bridge, "the bridge sent from a wrong address"
        udp = packet[header:length]
        pseudo = packet[12:20] + struct.pack("!BBH", 0, 17, len(udp))
        assert checksum(pseudo + udp) == 0, "the bridge sent a wrong UDP checksum"
        return struct.unpack("!H", udp[2:4])[0], udp[8:]


    def expect(self, port, what):
        """Waits for a datagram to our `port`."""
        ends = time.monotonic() + PATIENCE_S
        while time.monotonic() < ends:
            if select.select([self.wire], [], [], 0.2)[0]:
                datagram = self.receive()
                if datagram and datagram[0] == port:
                    return datagram[1]
        raise SystemExit(f"no {what} within {PATIENCE_S} s")


def join(network):
    """Joins the network as a computer does: requests an address (RFC 2131), and resolves a name (RFC 6762)."""
    everybody = "255.255.255.255"
    network.listens |= {socket.inet_aton(everybody), socket.inet_aton("224.0.0.251")}

    def ask(kind, options=b""):
        head = struct.pack("!BBBBIHH", 1, 1, 6, 0, 0x56495A46, 0, 0x8000) + bytes(16) + OUR_MAC
        request = head.ljust(236, b"\0") + b"\x63\x82\x53\x63" + bytes([53, 1, kind]) + options + b"\xff"
        network.send(68, request, source=bytes(4), to=everybody, to_port=67)
        answer = network.expect(68, "answer of the bridge's DHCP")
        assert answer[4:8] == b"VIZF" and answer[28:34] == OUR_MAC and answer[240:242] == b"\x35\x01"
        return answer[242], answer[16:20]

    assert ask(1) == (2, network.address), "the offer"
    assert ask(3, b"\x32\x04" + network.address + b"\x36\x04" + network.bridge) == (5, network.address)
    name = b"\x07vizflyt\x05local\0"
    query = struct.pack("!6H", 0, 0, 1, 0, 0, 0) + name + b"\0\x01\0\x01"
    network.send(5353, query, to="224.0.0.251", to_port=5353)
    answer = network.expect(5353, "answer to the bridge's name")
    assert answer[12:12 + len(name)] == name and answer[-4:] == network.bridge


class Sender:
    """Generates packets of one MAVLink system, all different."""

    def __init__(self, rng, system, component, target):
        self.rng = rng
        self.target = target
        self.plain = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
        self.signed = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
        self.signed.signing.secret_key = bytes(range(32))
        self.signed.signing.sign_outgoing = True
        self.kinds = [kind for number, kind in sorted(dialect.mavlink_map.items())
                      if number not in EXCLUDED]
        self.count = 0

    def _field(self, name, kind, length):
        if name == "target_system":
            return self.target[0]
        if name == "target_component":
            return self.target[1]
        if kind == "char":
            return bytes(self.rng.randrange(1, 128) for _ in range(max(length, 1)))
        one = {
            "float": lambda: struct.unpack("<f", struct.pack("<f", self.rng.uniform(-1e6, 1e6)))[0],
            "double": lambda: self.rng.uniform(-1e6, 1e6),
        }.get(kind)
        if one is None:
            bits = int(kind.rstrip("_t").lstrip("uint").split("_")[0])
            low = 0 if kind.startswith("u") else -(1 << bits - 1)
            one = lambda: self.rng.randrange(low, low + (1 << bits))
        return [one() for _ in range(length)] if length else one()

    def packet(self):
        kind = self.kinds[self.count % len(self.kinds)]
        self.count += 1
        fields = [self._field(name, kind.fieldtypes[kind.fieldnames.index(name)], length)
                  for name, length in zip(kind.ordered_fieldnames, kind.array_lengths)]
        by_name = dict(zip(kind.ordered_fieldnames, fields))
        message = kind(*[by_name[name] for name in kind.fieldnames])
        chance = self.rng.random()
        if chance < 0.15 and kind.id < 256:
            return bytes(message.pack(self.plain, force_mavlink1=True))
        return bytes(message.pack(self.signed if chance < 0.3 else self.plain))


# Answered by the bridge itself, or broadcast packets that it reads as well, so not only forwarded.
EXCLUDED = set()
BRIDGE_COMPONENT = 240


def split(data):
    """Splits complete packets off the front of bytes; returns (packets, rest)."""
    packets = []
    while len(data) >= 3:
        if data[0] == 0xFD:
            length = 12 + data[1] + (13 if data[2] & 1 else 0)
        elif data[0] == 0xFE:
            length = 8 + data[1]
        else:
            raise SystemExit(f"a packet was cut: {data[:24].hex()}")
        if len(data) < length:
            break
        packets.append(data[:length])
        data = data[length:]
    return packets, data


def is_bridge(packet):
    """Returns whether the bridge itself sent a packet."""
    return packet[6 if packet[0] == 0xFD else 4] == BRIDGE_COMPONENT


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--packets", type=int, default=10_000, help="in each direction")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("image")
    options = parser.parse_args()

    ours, radio = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    for end in (ours, radio):
        end.setblocking(False)
    line, serial = pty.openpty()
    tty.setraw(serial, termios.TCSANOW)
    os.set_blocking(line, False)
    os.set_blocking(serial, False)
    flash = tempfile.TemporaryFile()
    flash.write(b"\xff" * FLASH_BYTES)
    flash.flush()
    for number, descriptor in ((100, radio.fileno()), (101, serial), (102, flash.fileno())):
        os.dup2(descriptor, number, inheritable=True)
    # Its clock counts instructions, 62.5 million a second: a busy machine slows the clock, and cannot cause a false
    # pause within a packet.
    emulator = subprocess.Popen(
        ["qemu-system-xtensa", "-M", "sim", "-cpu", "lx106", "-semihosting", "-display", "none",
         "-monitor", "none", "-serial", "none", "-icount", "shift=4", "-kernel", options.image],
        stdin=subprocess.DEVNULL, pass_fds=(100, 101, 102))
    radio.close()
    try:
        network = Network(ours, "192.168.4.2", "192.168.4.1")
        join(network)
        rate = exercise(options, network, line, emulator)
    except BaseException:
        emulator.kill()
        raise
    for number in (100, 101, 102):
        os.close(number)
    ours.close()
    status = emulator.wait(timeout=PATIENCE_S)
    if status != 0:
        raise SystemExit(f"the emulator ended with status {status}")
    print(f"{options.packets} packets each way, none lost, altered or twice; {rate:.0f} packets/s")


def exercise(options, network, line, emulator):
    """Passes the packets; returns packets per second, both directions together."""
    rng = random.Random(options.seed)
    companion = Sender(rng, 255, 190, (1, 1))
    vehicle = Sender(rng, 1, 1, (255, 190))
    # Send time of each packet in flight, oldest first.
    sent = {"down": {}, "up": {}}
    under_way = {"down": 0, "up": 0}
    left = {"down": options.packets, "up": options.packets}
    own = collections.Counter()
    from_line, to_line = b"", b""
    greeted = False

    def arrived(way, packet):
        if is_bridge(packet):
            own[packet[7] if packet[0] == 0xFD else packet[5]] += 1
            return
        times = sent[way].get(packet)
        if not times:
            raise SystemExit(f"{way}: nobody sent this, or it came twice: {packet.hex()}")
        times.pop(0)
        if not times:
            del sent[way][packet]
        under_way[way] -= 1

    def send(way, packet):
        sent[way].setdefault(packet, []).append(time.monotonic())
        under_way[way] += 1

    start = spoke = time.monotonic()
    while any(left.values()) or any(under_way.values()):
        extra = time.monotonic() - spoke > SILENCE_S
        if extra or (left["down"] and under_way["down"] < WINDOW):
            # One to three packets per datagram, as companions batch them.
            batch = [companion.packet()
                     for _ in range(min(rng.randrange(1, 4), max(left["down"], 1)))]
            for packet in batch:
                send("down", packet)
            left["down"] = max(left["down"] - len(batch), 0)
            spoke = time.monotonic()
            network.send(14555, b"".join(batch))
        # The vehicle sends after the bridge has a destination address.
        while greeted and left["up"] and under_way["up"] < WINDOW:
            packet = vehicle.packet()
            send("up", packet)
            left["up"] -= 1
            to_line += packet
        ready, _, _ = select.select([network.wire, line], [], [], 0.0 if to_line else 0.2)
        if network.wire in ready:
            datagram = network.receive()
            if datagram and datagram[0] == 14555:
                packets, rest = split(datagram[1])
                if rest:
                    raise SystemExit(f"a datagram ends within a packet: {datagram[1].hex()}")
                for packet in packets:
                    arrived("up", packet)
        if line in ready:
            packets, from_line = split(from_line + os.read(line, 4096))
            for packet in packets:
                arrived("down", packet)
            greeted = True
        if to_line:
            try:
                # The bridge reads 128 bytes at a time, which rarely end at a packet boundary.
                to_line = to_line[os.write(line, to_line):]
            except BlockingIOError:
                pass
        if emulator.poll() is not None:
            raise SystemExit(f"the emulator ended with status {emulator.returncode}")
        for way, packets in sent.items():
            for packet, times in itertools.islice(packets.items(), 1):
                if time.monotonic() - times[0] > PATIENCE_S:
                    raise SystemExit(f"{way}: lost, one of {under_way[way]} under way: {packet.hex()}")
    print("of the bridge itself:", dict(own) or "nothing")
    return 2 * options.packets / (time.monotonic() - start)


if __name__ == "__main__":
    sys.exit(main())

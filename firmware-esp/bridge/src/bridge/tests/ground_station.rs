//! QGroundControl's page for Wi-Fi bridges: names, types and bytes as in its ESP8266ComponentController. Also the
//! transparent mode.

use std::collections::BTreeMap;
use std::string::{String, ToString};

use vizflyt_protocol::mavlink::dialect::MavParamType;

use super::configuration::{KEY, ask, request, sign};
use super::*;
use crate::access::{Op, Status};

fn chars(part: &[u8]) -> u32 {
    let mut bytes = [0; 4];
    bytes[..part.len()].copy_from_slice(part);
    u32::from_le_bytes(bytes)
}

/// QGroundControl with the key, and with the bridge's page open.
struct Station {
    bridge: Bridge,
    now: u64,
    values: BTreeMap<String, (u32, MavParamType)>,
    stamp: u64,
}

impl Station {
    fn new() -> Self {
        let settings = Settings { key: Some(KEY), ..quiet() };
        Self { bridge: bridge(settings), now: 0, values: BTreeMap::new(), stamp: 100 }
    }

    fn send(&mut self, packet: &[u8]) {
        self.now += 10;
        self.bridge.handle_datagram(at(self.now), address(2), packet);
        for (_, datagram) in datagrams(&mut self.bridge, at(self.now + 5)) {
            for packet in decode(&datagram) {
                if let MavMessage::PARAM_VALUE(value) = packet.message {
                    let name = value.param_id.to_str().unwrap().to_string();
                    self.values.insert(name, (value.param_value.to_bits(), value.param_type));
                }
            }
        }
    }

    fn set(&mut self, name: &str, bits: u32) {
        let set = MavMessage::PARAM_SET(PARAM_SET_DATA {
            param_value: f32::from_bits(bits),
            target_system: 1,
            target_component: COMPONENT_ID,
            param_id: name.into(),
            param_type: MavParamType::MAV_PARAM_TYPE_UINT32,
        });
        self.stamp += 1;
        let packet = sign(&bytes(0, RUNTIME, &set), &KEY, self.stamp);
        self.send(&packet);
    }

    /// Writes a text as the page does: only the parts that differ from those it has read.
    fn set_text(&mut self, prefix: &str, text: &str) {
        let mut whole = [0; 16];
        whole[..text.len()].copy_from_slice(text.as_bytes());
        for (part, bytes) in whole.chunks(4).enumerate() {
            let name = std::format!("{prefix}{}", part + 1);
            if self.values[&name].0 != chars(bytes) {
                self.set(&name, chars(bytes));
            }
        }
    }
}

#[test]
fn qgroundcontrol_finds_all_parameters_and_the_version() {
    let mut station = Station::new();
    station.bridge.set_address(Some(Ipv4Addr::new(192, 168, 4, 1)));
    let list = MavMessage::default_message_from_id(21).unwrap();
    station.send(&bytes(0, RUNTIME, &list));
    let numbered = ["WIFI_SSID", "WIFI_PASSWORD", "WIFI_SSIDSTA", "WIFI_PWDSTA"];
    let parts =
        numbered.iter().flat_map(|name| (1..=4).map(move |part| std::format!("{name}{part}")));
    let single = ["SW_VER", "DEBUG_ENABLED", "WIFI_MODE", "WIFI_IPADDRESS", "WIFI_UDP_HPORT"];
    let more = ["WIFI_UDP_CPORT", "UART_BAUDRATE"];
    for name in parts.chain(single.iter().chain(&more).map(ToString::to_string)) {
        let (_, kind) = station.values[&name];
        assert_eq!(kind, MavParamType::MAV_PARAM_TYPE_UINT32, "{name}");
    }
    let (version, _) = station.values["SW_VER"];
    let shown = std::format!("{}.{}.{}", version >> 24, (version >> 16) & 0xFF, version & 0xFFFF);
    assert_eq!(shown, env!("CARGO_PKG_VERSION"));
    assert_eq!(station.values["UART_BAUDRATE"].0, 921_600);
    assert_eq!(station.values["WIFI_UDP_CPORT"].0, 14550);
    assert_eq!(station.values["WIFI_SSID1"].0, chars(b"vizf"));
    assert_eq!(station.values["WIFI_IPADDRESS"].0.to_le_bytes(), [192, 168, 4, 1]);
    // The channel is one of the bridge's own parameters with the same name.
    assert_eq!(station.values["WIFI_CHANNEL"].0, 6f32.to_bits());
}

#[test]
fn stores_texts_written_by_qgroundcontrol_and_hides_passwords() {
    let mut station = Station::new();
    let list = MavMessage::default_message_from_id(21).unwrap();
    station.send(&bytes(0, RUNTIME, &list));
    station.set("UART_BAUDRATE", 115_200);
    station.set("WIFI_MODE", 1);
    station.set_text("WIFI_SSID", "drone-3");
    station.set_text("WIFI_PASSWORD", "correct horse");
    station.set_text("WIFI_SSIDSTA", "lab");
    station.set_text("WIFI_PWDSTA", "12345678");
    let settings = station.bridge.settings();
    assert_eq!((settings.baud, settings.wifi_role), (115_200, crate::settings::WifiRole::Station));
    assert_eq!((&*settings.ap_ssid, &*settings.ap_password), ("drone-3", "correct horse"));
    assert_eq!((&*settings.ssid, &*settings.password), ("lab", "12345678"));
    // Replace a text by a shorter one, part by part.
    station.set_text("WIFI_SSID", "d4");
    assert_eq!(&*station.bridge.settings().ap_ssid, "d4");
    station.bridge.handle_timeout(at(station.now + 1100));
    assert_eq!(station.bridge.poll_event(), Some(Event::Save));
    assert_eq!(station.bridge.poll_event(), None, "one save for all changes");
    // Read-only and out-of-range values stay.
    station.set("SW_VER", 9);
    station.set("UART_BAUDRATE", 1);
    assert_eq!(station.bridge.settings().baud, 115_200);
    station.send(&bytes(0, RUNTIME, &list));
    for part in 1..=4 {
        for name in ["WIFI_PASSWORD", "WIFI_PWDSTA"] {
            assert_eq!(station.values[&std::format!("{name}{part}")].0, 0);
        }
    }
}

#[test]
fn announces_a_generated_password_only_to_the_wire() {
    let mut bridge = bridge(quiet());
    bridge.handle_uart(at(0), &bytes(0, AUTOPILOT, &heartbeat(false, 0)));
    bridge.handle_datagram(at(0), address(2), &bytes(0, RUNTIME, &setpoint(0.0)));
    bridge.ensure_password(at(1));
    let password = bridge.settings().ap_password.to_string();
    assert_eq!(password.len(), 19);
    assert_eq!(bridge.settings().page_key, password.as_str());
    assert_eq!(bridge.poll_event(), Some(Event::Save));
    bridge.handle_timeout(at(1001));
    let texts = |packets: Vec<Packet>| -> Vec<String> {
        packets
            .into_iter()
            .filter_map(|packet| match packet.message {
                MavMessage::STATUSTEXT(text) => Some(text.text.to_str().unwrap().to_string()),
                _ => None,
            })
            .collect()
    };
    let wire = uart(&mut bridge, at(1001)).iter().flat_map(|packet| decode(packet)).collect();
    assert_eq!(texts(wire), [std::format!("bridge: its network's key: {password}")]);
    let air = datagrams(&mut bridge, at(1010)).iter().flat_map(|(_, b)| decode(b)).collect();
    assert_eq!(texts(air), Vec::<String>::new());
    // The public nonce does not reveal the password.
    assert_ne!(access::nonce(&[7; 16]), access::key_bytes(&[7; 16]));
    // Another start keeps the password; an open network stays without one.
    bridge.ensure_password(at(2));
    assert_eq!(bridge.settings().ap_password, password.as_str());
    let mut open = super::bridge(Settings { wifi_open: true, ..quiet() });
    open.ensure_password(at(1));
    assert!(open.settings().ap_password.is_empty());
}

proptest! {
    /// A transparent bridge forwards any bytes in both directions, in order, and adds none.
    #[test]
    fn transparent_mode_forwards_all_bytes_unchanged(
        parts in prop::collection::vec((any::<bool>(), prop::collection::vec(any::<u8>(), 1..300)), 1..20),
    ) {
        let mut bridge = bridge(Settings { transparent: true, ..Settings::default() });
        bridge.handle_datagram(at(0), address(2), b"hello");
        let (mut up, mut down) = (b"hello".to_vec(), Vec::new());
        let (mut up_out, mut down_out) = (Vec::new(), Vec::new());
        for (number, (is_up, part)) in parts.into_iter().enumerate() {
            let now = at(10 + 1000 * number as u64);
            if is_up {
                bridge.handle_datagram(now, address(2), &part);
                up.extend(part);
            } else {
                bridge.handle_datagram(now, address(2), b"!");
                up.push(b'!');
                bridge.handle_uart(now, &part);
                down.extend(part);
            }
            bridge.handle_timeout(now);
            up_out.extend(uart(&mut bridge, now).concat());
            let datagrams = datagrams(&mut bridge, now.plus_ns(20_000_000));
            down_out.extend(datagrams.into_iter().flat_map(|(_, bytes)| bytes));
        }
        prop_assert_eq!(up_out, up);
        prop_assert_eq!(down_out, down);
    }
}

#[test]
fn transparent_mode_is_configurable_and_sends_no_land() {
    let mut bridge = bridge(Settings { transparent: true, key: Some(KEY), ..quiet() });
    for ms in (0..5000).step_by(20) {
        if ms % 1000 == 0 {
            bridge.handle_uart(at(ms), &bytes(0, AUTOPILOT, &heartbeat(true, 4)));
        }
        if ms < 1000 {
            bridge.handle_datagram(at(ms), address(2), &bytes(0, RUNTIME, &setpoint(0.0)));
        }
        bridge.handle_timeout(at(ms));
    }
    let up = uart(&mut bridge, at(5000));
    assert!(up.iter().flat_map(|bytes| decode(bytes)).all(|packet| packet.header.system_id == 255));
    datagrams(&mut bridge, at(5001));
    let (status, hello) = ask(&mut bridge, 5100, &request(Op::Hello, 0, b"", None));
    assert_eq!((status, hello[20]), (Status::Done, 0b101), "claimed, transparent");
    let change = request(Op::Set, 1, b"TRANSPARENT=0", Some(&KEY));
    assert_eq!(ask(&mut bridge, 5200, &change).0, Status::Done);
    assert!(
        bridge.is_transparent() && !bridge.settings().transparent,
        "takes effect at the next start"
    );
    assert_eq!(uart(&mut bridge, at(5300)), Vec::<Vec<u8>>::new(), "requests are not forwarded");
}

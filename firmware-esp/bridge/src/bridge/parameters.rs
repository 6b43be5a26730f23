//! Settings of the bridge as MAVLink parameters: its own numbers, and the names that QGroundControl's page for Wi-Fi
//! bridges uses (its ESP8266ComponentController).
//!
//! The bridge's own numbers are floats. QGroundControl's parameters are 32 bits stored in the bytes of the value field;
//! a text is four of them, 16 characters. Passwords are write-only: they read as empty.

use vizflyt_protocol::mavlink::MAX_PACKET;
use vizflyt_protocol::mavlink::dialect::{MavParamType, PARAM_VALUE_DATA};
use vizflyt_protocol::time::HostTime;

use super::component::{PARAM_REQUEST_LIST, PARAM_REQUEST_READ, PARAM_SET};
use super::fields::Fields;
use super::router::PacketRouter;
use crate::mavlink_writer::{BridgeMessage, write_message};
use crate::packet::Raw;
use crate::settings::{NUMBERS, Refused, WifiRole};

/// Meaning of a QGroundControl parameter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Station {
    /// Major, minor and patch in 8, 8 and 16 bits. QGroundControl shows the page if this parameter exists.
    Version,
    /// Debug output on a wire: not available.
    Debug,
    /// 0 access point, 1 station.
    Mode,
    /// Address of the bridge.
    Address,
    /// Port to which heartbeats are broadcast.
    HostPort,
    ClientPort,
    Baud,
    /// Four characters of a text: part number `.1`.
    Text(StationText, u8),
}

/// Texts of QGroundControl's page.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum StationText {
    OwnName = 0,
    OwnPassword = 1,
    JoinedName = 2,
    JoinedPassword = 3,
}

impl StationText {
    const ALL: [Self; 4] =
        [Self::OwnName, Self::OwnPassword, Self::JoinedName, Self::JoinedPassword];

    /// Returns the setting's name, and whether it is a secret.
    fn setting(self) -> (&'static str, bool) {
        match self {
            Self::OwnName => ("wifi.ap_ssid", false),
            Self::OwnPassword => ("wifi.ap_password", true),
            Self::JoinedName => ("wifi.ssid", false),
            Self::JoinedPassword => ("wifi.password", true),
        }
    }

    fn prefix(self) -> &'static str {
        match self {
            Self::OwnName => "WIFI_SSID",
            Self::OwnPassword => "WIFI_PASSWORD",
            Self::JoinedName => "WIFI_SSIDSTA",
            Self::JoinedPassword => "WIFI_PWDSTA",
        }
    }
}

const SINGLE: [(&str, Station); 7] = [
    ("SW_VER", Station::Version),
    ("DEBUG_ENABLED", Station::Debug),
    ("WIFI_MODE", Station::Mode),
    ("WIFI_IPADDRESS", Station::Address),
    ("WIFI_UDP_HPORT", Station::HostPort),
    ("WIFI_UDP_CPORT", Station::ClientPort),
    ("UART_BAUDRATE", Station::Baud),
];
const PARTS: usize = 4;
/// Number of all parameters; the bridge's own are first.
const COUNT: usize = NUMBERS.len() + SINGLE.len() + PARTS * StationText::ALL.len();
/// Port of ground stations.
const STATION_PORT: u32 = 14550;

/// Length of a text on QGroundControl's page.
const TEXT: usize = 16;

/// Partially received texts; their parts arrive one after the other.
#[derive(Clone, Debug)]
pub(super) struct TypedTexts([Option<[u8; TEXT]>; StationText::ALL.len()]);

impl TypedTexts {
    pub(super) const NONE: Self = Self([None; StationText::ALL.len()]);
}

impl PacketRouter {
    /// Answers a parameter request or change.
    pub(super) fn handle_parameter(&mut self, now: HostTime, from: Option<usize>, packet: Raw<'_>) {
        let field = Fields(packet.payload());
        match packet.id() {
            PARAM_REQUEST_LIST => {
                for index in 0..COUNT {
                    self.send_param(now, from, index);
                }
            }
            PARAM_REQUEST_READ => {
                let index = match field.u16(0).cast_signed() {
                    -1 => find(field.text(4)),
                    index => usize::try_from(index).ok().filter(|&index| index < COUNT),
                };
                if let Some(index) = index {
                    self.send_param(now, from, index);
                }
            }
            PARAM_SET => {
                let Some(index) = find(field.text(6)) else { return };
                if self.may_change(now, packet) {
                    let is_float = field.byte(22) == MavParamType::MAV_PARAM_TYPE_REAL32 as u8;
                    let number = if is_float { whole(field.f32(0)) } else { Some(field.u32(0)) };
                    // A value out of range is ignored; the reply shows the old value.
                    if let Some(number) = number
                        && self.set_param(index, number, field.f32(0)).is_ok()
                    {
                        self.apply_settings(now);
                        self.save_soon(now);
                    }
                    let told = station(index).filter(|what| matches!(what, Station::Text(..)));
                    if let (Some(_), Some(number)) = (told, number) {
                        // Confirm a secret only to the client that set it.
                        return self.send_value(now, from, index, number);
                    }
                }
                self.send_param(now, from, index);
            }
            _ => {}
        }
    }

    fn set_param(&mut self, index: usize, bits: u32, value: f32) -> Result<(), Refused> {
        let Some(what) = station(index) else {
            let value = whole(value).ok_or(Refused::Malformed)?;
            return NUMBERS[index].set(&mut self.settings, value);
        };
        let mut set = |name: &str| {
            let number = NUMBERS.iter().find(|number| number.name == name);
            number.ok_or(Refused::Unknown)?.set(&mut self.settings, bits)
        };
        match what {
            Station::Version | Station::Debug | Station::Address | Station::HostPort => {
                Err(Refused::OutOfRange)
            }
            Station::Mode => set("WIFI_STATION"),
            Station::ClientPort => set("UDP_PORT"),
            Station::Baud => set("UART_BAUD"),
            Station::Text(text, part) => {
                let typed = &mut self.typed.0[text as usize];
                let (setting, secret) = text.setting();
                let whole = typed.get_or_insert_with(|| {
                    if secret {
                        // A secret cannot be read, so it is typed from the first part on.
                        [0; TEXT]
                    } else {
                        first_characters(&self.settings.read(setting).unwrap_or_default())
                    }
                });
                let from = usize::from(part) * 4;
                whole[from..from + 4].copy_from_slice(&bits.to_le_bytes());
                let len = whole.iter().position(|&byte| byte == 0).unwrap_or(TEXT);
                let text = core::str::from_utf8(&whole[..len]).map_err(|_| Refused::Malformed)?;
                // A password of fewer than 8 characters is rejected until more parts arrive.
                self.settings.set(setting, text)
            }
        }
    }

    fn station_value(&self, what: Station) -> u32 {
        let settings = &self.settings;
        match what {
            Station::Version => version(),
            Station::Debug => 0,
            Station::Mode => u32::from(settings.wifi_role == WifiRole::Station),
            Station::Address => {
                self.own_address.map_or(0, |address| u32::from_le_bytes(address.octets()))
            }
            Station::HostPort => STATION_PORT,
            Station::ClientPort => settings.udp_port.into(),
            Station::Baud => settings.baud,
            Station::Text(text, part) => {
                let whole = match text {
                    StationText::OwnName => first_characters(&self.network_name()),
                    StationText::JoinedName => first_characters(&settings.ssid),
                    StationText::OwnPassword | StationText::JoinedPassword => [0; TEXT],
                };
                Fields(&whole).u32(usize::from(part) * 4)
            }
        }
    }

    fn send_param(&mut self, now: HostTime, to: Option<usize>, index: usize) {
        let bits = match station(index) {
            Some(what) => self.station_value(what),
            None => (NUMBERS[index].value(&self.settings) as f32).to_bits(),
        };
        self.send_value(now, to, index, bits);
    }

    /// Sends a parameter with these bits in its value field.
    fn send_value(&mut self, now: HostTime, to: Option<usize>, index: usize, bits: u32) {
        let param_type = match station(index) {
            Some(_) => MavParamType::MAV_PARAM_TYPE_UINT32,
            None => MavParamType::MAV_PARAM_TYPE_REAL32,
        };
        let message = BridgeMessage::PARAM_VALUE(PARAM_VALUE_DATA {
            param_value: f32::from_bits(bits),
            param_count: COUNT as u16,
            param_index: index as u16,
            param_id: name(index).as_str().into(),
            param_type,
        });
        let mut packet = [0; MAX_PACKET];
        let len = write_message(&mut packet, self.address(), 0, &message);
        self.deliver(now, to, message.id(), &packet[..len]);
    }
}

/// Returns the meaning of a QGroundControl parameter; `None` for the bridge's own.
fn station(index: usize) -> Option<Station> {
    let index = index.checked_sub(NUMBERS.len())?;
    if let Some(&(_, what)) = SINGLE.get(index) {
        return Some(what);
    }
    let index = index - SINGLE.len();
    let text = *StationText::ALL.get(index / PARTS)?;
    Some(Station::Text(text, (index % PARTS) as u8))
}

fn name(index: usize) -> heapless::String<16> {
    let mut name = heapless::String::new();
    // All names have at most 16 characters.
    let _ = match station(index) {
        None => name.push_str(NUMBERS[index].name),
        Some(Station::Text(text, part)) => {
            name.push_str(text.prefix()).and_then(|()| name.push((b'1' + part) as char))
        }
        Some(_) => name.push_str(SINGLE[index - NUMBERS.len()].0),
    };
    name
}

/// Returns the index of a parameter by name.
fn find(wanted: &str) -> Option<usize> {
    (0..COUNT).find(|&index| name(index) == wanted)
}

/// Returns the value of a float that is a whole number.
fn whole(value: f32) -> Option<u32> {
    ((0.0..=1e7).contains(&value) && value % 1.0 == 0.0).then_some(value as u32)
}

fn first_characters(text: &str) -> [u8; TEXT] {
    let bytes = text.as_bytes();
    core::array::from_fn(|at| bytes.get(at).copied().unwrap_or(0))
}

/// Returns the version in QGroundControl's format.
fn version() -> u32 {
    let mut parts = env!("CARGO_PKG_VERSION").split('.').map(|part| part.parse().unwrap_or(0));
    let mut next = || parts.next().unwrap_or(0u32);
    next() << 24 | next() << 16 | next()
}

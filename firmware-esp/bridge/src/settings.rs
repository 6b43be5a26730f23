//! Settings of a bridge, by name. Numbers are also MAVLink parameters of the bridge's component. Texts (networks,
//! passwords, addresses) are set by `vizflyt bridge configure` and the web page; QGroundControl's parameters contain
//! the networks and their passwords. Passwords and keys are write-only.

mod numbers;

use core::fmt::Write as _;
use core::net::{Ipv4Addr, SocketAddrV4};
use core::str::FromStr;

use heapless::String;

pub use numbers::{NUMBERS, Number};

/// Role in the Wi-Fi network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WifiRole {
    /// Opens an access point.
    AccessPoint,
    /// Joins a network; opens an access point if that fails for [`Settings::fallback_s`].
    Station,
}

/// Key that authorizes changes of the configuration.
pub type Key = [u8; 32];

/// UART pins of an ESP32-C3, as GPIO numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UartPins {
    /// Output to the autopilot's RX.
    pub tx: u8,
    /// Input from the autopilot's TX.
    pub rx: u8,
    /// Output to the autopilot's CTS.
    pub rts: u8,
    /// Input from the autopilot's RTS.
    pub cts: u8,
}

impl UartPins {
    /// Default pins, as in the wiring of `hardware/bridge`.
    pub const USUAL: Self = Self { tx: 4, rx: 5, rts: 6, cts: 7 };

    /// Returns the pins, or the defaults if two are the same. The bridge then stays reachable over its network, even if
    /// its wires do not work.
    pub fn or_usual(self) -> Self {
        let [a, b, c, d] = [self.tx, self.rx, self.rts, self.cts];
        let distinct = a != b && a != c && a != d && b != c && b != d && c != d;
        if distinct { self } else { Self::USUAL }
    }
}

/// All settings of a bridge, stored in flash by [`crate::storage`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Settings {
    /// Baud rate of the autopilot's port, 57600 to 3000000.
    pub baud: u32,
    /// Whether RTS and CTS are wired.
    pub flow_control: bool,
    /// Maximum delay of a packet for batching, 0 to 20000 [us].
    pub batch_us: u32,
    /// Maximum length of a datagram, 300 to 1400 [bytes].
    pub batch_bytes: u16,
    /// Silence after which a client is removed, unless it is the fixed one, 2 to 600 [s].
    pub client_timeout_s: u16,
    /// UDP port for packets from and to clients.
    pub udp_port: u16,
    /// TCP port; 0 closes it.
    pub tcp_port: u16,
    /// TCP port of the web page; 0 closes it.
    pub page_port: u16,
    /// Silence of the companion after which the bridge sends LAND, while the vehicle follows it, 200 to 10000 [ms]. 0
    /// turns this off.
    pub loss_ms: u16,
    /// Whether RADIO_STATUS is sent each second.
    pub radio_status: bool,
    /// Whether heartbeats are broadcast to port 14550 each second until a client connects.
    pub beacon: bool,
    /// Role in the Wi-Fi network.
    pub wifi_role: WifiRole,
    /// Channel of the bridge's own network, 1 to 13.
    pub wifi_channel: u8,
    /// Time without connection after which a station opens its access point, 5 to 600 [s].
    pub fallback_s: u16,
    /// Name of the network to join.
    pub ssid: String<32>,
    /// Password of the network to join.
    pub password: String<64>,
    /// Name of the bridge's own network. If empty: `vizflyt-` and three bytes of the chip's address.
    pub ap_ssid: String<32>,
    /// Password of the bridge's own network, at least 8 characters. If empty, the bridge generates one at its first
    /// start and announces it only by wire; see [`Self::wifi_open`].
    pub ap_password: String<64>,
    /// Whether the bridge's own network has no password; only by explicit request.
    pub wifi_open: bool,
    /// Country code of the radio's rules, two letters. If empty, only what all countries allow is used.
    pub country: String<2>,
    /// Host name: the bridge is found as `NAME.local`.
    pub hostname: String<32>,
    /// Fixed address and prefix length as a station; `None` uses DHCP.
    pub address: Option<(Ipv4Addr, u8)>,
    /// Gateway that belongs to a fixed address.
    pub gateway: Option<Ipv4Addr>,
    /// Fixed client, which receives packets even if it never sent any.
    pub client: Option<SocketAddrV4>,
    /// Key of the bridge; `None` until it is claimed.
    pub key: Option<Key>,
    /// MAVLink signing key of the vehicle, for packets that the bridge sends to the autopilot.
    pub vehicle_key: Option<Key>,
    /// Key of the web page's settings form, at least 8 characters. If empty, only `key` is accepted.
    pub page_key: String<64>,
    /// Whether bytes are forwarded unparsed: no priorities, no LAND, no packets of the bridge.
    pub transparent: bool,
    /// UART pins, on an ESP32-C3.
    pub pins: UartPins,
}

impl Default for Settings {
    fn default() -> Self {
        Self { hostname: text("vizflyt"), ..Self::unnamed() }
    }
}

impl Settings {
    /// Restores the defaults.
    #[inline(never)] // Why: the copy occupies the stack only during this call.
    pub(crate) fn restore(&mut self) {
        *self = Self::default();
    }

    /// Defaults without a host name; `const`, for a chip's static memory.
    pub(crate) const fn unnamed() -> Self {
        Self {
            baud: 921_600,
            flow_control: false,
            batch_us: 2500,
            batch_bytes: 1400,
            client_timeout_s: 10,
            udp_port: 14550,
            tcp_port: 5760,
            page_port: 80,
            loss_ms: 1000,
            radio_status: true,
            beacon: true,
            wifi_role: WifiRole::AccessPoint,
            wifi_channel: 6,
            fallback_s: 30,
            ssid: String::new(),
            password: String::new(),
            ap_ssid: String::new(),
            ap_password: String::new(),
            wifi_open: false,
            country: String::new(),
            hostname: String::new(),
            address: None,
            gateway: None,
            client: None,
            key: None,
            vehicle_key: None,
            page_key: String::new(),
            transparent: false,
            pins: UartPins::USUAL,
        }
    }
}

/// Why a value was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refused {
    /// Unknown setting.
    Unknown,
    /// The value is not a number, an address, or a text of valid length.
    Malformed,
    /// The number is out of range.
    OutOfRange,
}

/// Names of the texts, and whether they may be read back.
pub const TEXTS: &[(&str, bool)] = &[
    ("wifi.ssid", true),
    ("wifi.password", false),
    ("wifi.ap_ssid", true),
    ("wifi.ap_password", false),
    ("hostname", true),
    ("address", true),
    ("gateway", true),
    ("client", true),
    ("key", false),
    ("vehicle.key", false),
    ("page.key", false),
    ("wifi.country", true),
];

impl Settings {
    /// Sets a number or text by its name. An empty text removes an address or key.
    ///
    /// # Errors
    /// See [`Refused`].
    pub fn set(&mut self, name: &str, value: &str) -> Result<(), Refused> {
        if let Some(number) = NUMBERS.iter().find(|number| number.name == name) {
            let value = value.parse().map_err(|_| Refused::Malformed)?;
            return number.set(self, value);
        }
        match name {
            "wifi.ssid" => put(&mut self.ssid, value),
            "wifi.password" => put_password(&mut self.password, value),
            "wifi.ap_ssid" => put(&mut self.ap_ssid, value),
            "wifi.ap_password" => put_password(&mut self.ap_password, value),
            "hostname" => {
                let letter = |c: char| c.is_ascii_alphanumeric() || c == '-';
                if value.is_empty() || !value.chars().all(letter) {
                    return Err(Refused::Malformed);
                }
                put(&mut self.hostname, value)
            }
            "address" => {
                self.address = maybe(value, |value| {
                    let (address, prefix) = value.split_once('/').ok_or(Refused::Malformed)?;
                    let prefix = parsed(prefix)?;
                    if prefix > 30 {
                        return Err(Refused::OutOfRange);
                    }
                    Ok((parsed(address)?, prefix))
                })?;
                Ok(())
            }
            "gateway" => {
                self.gateway = maybe(value, parsed)?;
                Ok(())
            }
            "client" => {
                self.client = maybe(value, parsed)?;
                Ok(())
            }
            "key" => {
                self.key = maybe(value, key_from_hex)?;
                Ok(())
            }
            "vehicle.key" => {
                self.vehicle_key = maybe(value, key_from_hex)?;
                Ok(())
            }
            "page.key" => put_password(&mut self.page_key, value),
            "wifi.country" => {
                let letters = value.chars().all(|c| c.is_ascii_uppercase());
                if !(value.is_empty() || (value.len() == 2 && letters)) {
                    return Err(Refused::Malformed);
                }
                put(&mut self.country, value)
            }
            _ => Err(Refused::Unknown),
        }
    }

    /// Calls `sink` with the name and value of every setting, secrets included, for storage in flash.
    pub(crate) fn each(&self, mut sink: impl FnMut(&str, &str)) {
        let secrets: [(&str, &str); 3] = [
            ("wifi.password", &self.password),
            ("wifi.ap_password", &self.ap_password),
            ("page.key", &self.page_key),
        ];
        for (name, value) in secrets {
            sink(name, value);
        }
        for (name, key) in [("key", &self.key), ("vehicle.key", &self.vehicle_key)] {
            if let Some(key) = key {
                sink(name, &key_to_hex(key));
            }
        }
        let readable = TEXTS.iter().filter(|(_, readable)| *readable).map(|(name, _)| *name);
        for name in readable.chain(NUMBERS.iter().map(|number| number.name)) {
            sink(name, &self.read(name).unwrap_or_default());
        }
    }

    /// Returns the value of a setting as text; `***` for secrets.
    pub fn read(&self, name: &str) -> Option<String<64>> {
        let mut out = String::new();
        let shown = |out: &mut String<64>, value: &dyn core::fmt::Display| {
            // The longest value is a name of 32 characters, so it fits.
            let _ = write!(out, "{value}");
        };
        if let Some(number) = NUMBERS.iter().find(|number| number.name == name) {
            shown(&mut out, &number.value(self));
            return Some(out);
        }
        let secret = |out: &mut String<64>, set: bool| {
            let _ = out.push_str(if set { "***" } else { "" });
        };
        match name {
            "wifi.ssid" => shown(&mut out, &self.ssid),
            "wifi.password" => secret(&mut out, !self.password.is_empty()),
            "wifi.ap_ssid" => shown(&mut out, &self.ap_ssid),
            "wifi.ap_password" => secret(&mut out, !self.ap_password.is_empty()),
            "hostname" => shown(&mut out, &self.hostname),
            "address" => {
                if let Some((address, prefix)) = self.address {
                    shown(&mut out, &format_args!("{address}/{prefix}"));
                }
            }
            "gateway" => {
                if let Some(gateway) = self.gateway {
                    shown(&mut out, &gateway);
                }
            }
            "client" => {
                if let Some(client) = self.client {
                    shown(&mut out, &client);
                }
            }
            "key" => secret(&mut out, self.key.is_some()),
            "vehicle.key" => secret(&mut out, self.vehicle_key.is_some()),
            "page.key" => secret(&mut out, !self.page_key.is_empty()),
            "wifi.country" => shown(&mut out, &self.country),
            _ => return None,
        }
        Some(out)
    }
}

/// Parses a key of 64 hexadecimal digits.
///
/// # Errors
/// [`Refused::Malformed`].
pub const fn key_from_hex(text: &str) -> Result<Key, Refused> {
    let digits = text.as_bytes();
    if digits.len() != 64 {
        return Err(Refused::Malformed);
    }
    let mut key = [0; 32];
    let mut at = 0;
    // No iterators: chips call this in a constant for their firmware key.
    while at < 64 {
        let digit = match digits[at] {
            digit @ b'0'..=b'9' => digit - b'0',
            digit @ b'a'..=b'f' => digit - b'a' + 10,
            digit @ b'A'..=b'F' => digit - b'A' + 10,
            _ => return Err(Refused::Malformed),
        };
        key[at / 2] = (key[at / 2] << 4) | digit;
        at += 1;
    }
    Ok(key)
}

/// Returns a key as 64 hexadecimal digits.
pub fn key_to_hex(key: &Key) -> String<64> {
    let mut hex = String::new();
    for byte in key {
        // 32 bytes are 64 digits, so it fits.
        let _ = write!(hex, "{byte:02x}");
    }
    hex
}

/// Returns a key for typing, with 80 random bits: four groups of four letters and digits that are easy to distinguish.
/// The key is used as network password and as key of the web page.
pub fn typed_key(random: &[u8; 16]) -> String<19> {
    const LETTERS: &[u8; 32] = b"abcdefghijkmnpqrstuvwxyz23456789";
    let mut key = String::new();
    for (place, byte) in random.iter().enumerate() {
        let dash = if place > 0 && place % 4 == 0 { "-" } else { "" };
        // 16 letters and 3 dashes fit.
        let _ = write!(key, "{dash}{}", LETTERS[usize::from(byte % 32)] as char);
    }
    key
}

pub(crate) fn text<const N: usize>(value: &str) -> String<N> {
    let mut out = String::new();
    // Why: all callers pass constants that fit.
    let _ = out.push_str(value);
    out
}

fn put<const N: usize>(to: &mut String<N>, value: &str) -> Result<(), Refused> {
    // Each setting is one line in flash.
    if value.chars().any(char::is_control) {
        return Err(Refused::Malformed);
    }
    *to = String::try_from(value).map_err(|_| Refused::Malformed)?;
    Ok(())
}

/// WPA2 requires 8 to 63 characters.
fn put_password(to: &mut String<64>, value: &str) -> Result<(), Refused> {
    if value.is_empty() || (8..=63).contains(&value.len()) {
        put(to, value)
    } else {
        Err(Refused::Malformed)
    }
}

fn maybe<T>(
    value: &str,
    read: impl FnOnce(&str) -> Result<T, Refused>,
) -> Result<Option<T>, Refused> {
    if value.is_empty() { Ok(None) } else { read(value).map(Some) }
}

fn parsed<T: FromStr>(value: &str) -> Result<T, Refused> {
    value.parse().map_err(|_| Refused::Malformed)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_number_has_a_unique_name_and_a_checked_range() {
        for (index, number) in NUMBERS.iter().enumerate() {
            assert!(number.name.len() <= 16, "{}", number.name);
            assert!(NUMBERS[..index].iter().all(|other| other.name != number.name));
            let mut settings = Settings::default();
            let default = number.value(&settings);
            assert!((number.least..=number.most).contains(&default), "{}", number.name);
            for value in [number.least, number.most] {
                number.set(&mut settings, value).unwrap();
                assert_eq!(number.value(&settings), value, "{}", number.name);
            }
            for value in (0..32).filter(|value| number.except & (1 << value) != 0) {
                assert_eq!(number.set(&mut settings, value), Err(Refused::OutOfRange));
            }
            assert_eq!(number.set(&mut settings, number.most + 1), Err(Refused::OutOfRange));
            assert_eq!(number.set(&mut settings, 0).is_ok(), number.least == 0 || number.zero);
        }
    }

    #[test]
    fn texts_are_validated_and_secrets_hidden() {
        let check = |name: &str, value: &str, expected: Result<&str, Refused>| {
            let mut settings = Settings::default();
            let result = settings.set(name, value);
            let read = settings.read(name).unwrap_or_default();
            assert_eq!(result.map(|()| read.as_str()), expected, "{name}={value}");
        };
        check("wifi.ssid", "lab net", Ok("lab net"));
        check("wifi.ssid", "a name of more than thirty-two bytes", Err(Refused::Malformed));
        check("wifi.ssid", "two\nkey=", Err(Refused::Malformed));
        check("wifi.password", "12345678", Ok("***"));
        check("wifi.ap_password", "short", Err(Refused::Malformed));
        check("wifi.ap_password", "", Ok(""));
        check("hostname", "drone-3", Ok("drone-3"));
        check("hostname", "drone 3", Err(Refused::Malformed));
        check("address", "192.168.10.7/24", Ok("192.168.10.7/24"));
        check("address", "192.168.10.7", Err(Refused::Malformed));
        check("address", "192.168.10.7/31", Err(Refused::OutOfRange));
        check("address", "", Ok(""));
        check("gateway", "192.168.10.1", Ok("192.168.10.1"));
        check("client", "192.168.10.2:14550", Ok("192.168.10.2:14550"));
        check("client", "somewhere", Err(Refused::Malformed));
        check("key", "00112233445566778899aabbccddeeff00112233445566778899aabbccddeeff", Ok("***"));
        check("key", "0011", Err(Refused::Malformed));
        check("vehicle.key", "0011", Err(Refused::Malformed));
        check("page.key", "abcd-efgh", Ok("***"));
        check("page.key", "short", Err(Refused::Malformed));
        check("wifi.country", "DE", Ok("DE"));
        check("wifi.country", "de", Err(Refused::Malformed));
        check("wifi.country", "DEU", Err(Refused::Malformed));
        check("wifi.country", "", Ok(""));
        check("UART_TX_PIN", "21", Ok("21"));
        check("UART_TX_PIN", "18", Err(Refused::OutOfRange));
        check("UART_BAUD", "57600", Ok("57600"));
        check("UART_BAUD", "9600", Err(Refused::OutOfRange));
        check("LOSS_MS", "0", Ok("0"));
        check("NO_SUCH", "1", Err(Refused::Unknown));
    }

    #[test]
    fn typed_keys_are_valid_passwords() {
        let key = typed_key(&[0, 1, 2, 3, 4, 5, 6, 7, 28, 29, 30, 31, 32, 33, 255, 254]);
        assert_eq!(key, "abcd-efgh-6789-ab98");
        let mut settings = Settings::default();
        settings.set("wifi.ap_password", &key).unwrap();
        settings.set("page.key", &key).unwrap();
    }

    #[test]
    fn equal_pins_fall_back_to_the_defaults() {
        let usual = UartPins::USUAL;
        assert_eq!(UartPins { tx: 21, rx: 20, ..usual }.or_usual().tx, 21);
        assert_eq!(UartPins { tx: 5, ..usual }.or_usual(), usual);
        assert_eq!(UartPins { rts: 7, ..usual }.or_usual(), usual);
    }
}
